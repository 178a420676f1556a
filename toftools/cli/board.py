"""``toftools board KIND:key=val,... --out board.pdf|.png``."""

from pathlib import Path

import click

EPILOG = """Kinds: chessboard:columns=8,rows=5,square_m=0.03 counts inner corners;
charuco:columns=9,rows=6,square_m=0.03,marker_m=0.023,dictionary=DICT_4X4_50 counts squares
(legacy=true for prints of OpenCV before 4.6). Papers: A4, A3, A2, A1, A0, letter, tabloid.

A square should be 8 px or more in the image. A sum of columns and rows that is odd gives a
chessboard one orientation only.

Example: toftools board chessboard:columns=8,rows=5,square_m=0.03 --out board.pdf
"""


@click.command(epilog=EPILOG)
@click.argument("board_text", metavar="KIND[:k=v,...]")
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False),
              help="Sheet to print, *.pdf (vector) or *.png.")  # fmt: skip
@click.option("--paper", default="A4", show_default=True, help="Paper it must fit on.")
@click.option("--dpi", default=254, show_default=True, help="Pixels per inch of a PNG.")
@click.option("--json", "as_json", is_flag=True, help="Print what was made as JSON.")
def command(*, board_text: str, out: Path, paper: str, dpi: int, as_json: bool) -> None:
    """Write a calibration board to print at true size."""
    import json

    from toftools.calib._board_sheet import INFRARED, laid_out, write_sheet
    from toftools.calib.board import parse_board

    board = parse_board(board_text)
    sheet = laid_out(board, paper)
    write_sheet(out, sheet, dpi=dpi)
    width, height = (1e3 * side for side in board.size_m)
    if as_json:
        size = {"width_mm": sheet.width_mm, "height_mm": sheet.height_mm}
        made = {"out": str(out), "board": board.text(), "paper": sheet.paper, **size}
        click.echo(json.dumps({**made, "board_mm": [width, height], "infrared": INFRARED}))
        return
    what = "inner corners" if board.kind == "chessboard" else "squares"
    click.echo(
        f"wrote {out}: {board.kind} of {board.columns} x {board.rows} {what}, squares of "
        f"{1e3 * board.square_m:g} mm, {width:g} x {height:g} mm in all, on {sheet.paper} "
        f"{sheet.way} ({sheet.width_mm:g} x {sheet.height_mm:g} mm)"
    )
    click.echo("Print at 100 % (actual size, no fit to page), then measure the ruler: 100 mm.")
    click.echo(INFRARED)
    click.echo(f"Then: toftools calibrate lens CAPTURES... --board {board.text()} --out cal.json")
