"""Boards: what is typed, what is printed at which size, and that a print is found again."""

import json
import re
import struct

import cv2
import numpy as np
import pytest

from toftools.calib._board_sheet import PAPERS_MM, laid_out, write_sheet
from toftools.calib._corners import find_board
from toftools.calib._lens_views import read_view
from toftools.calib.board import DEFAULT, DICTIONARIES, Board, charuco, dark_at, parse_board
from toftools.cli import main

CHARUCO = "charuco:columns=8,rows=6,square_m=0.03,marker_m=0.022,dictionary=DICT_5X5_100"
BOARDS = [DEFAULT, CHARUCO, CHARUCO + ",legacy=true"]


@pytest.mark.parametrize("text", BOARDS)
def test_text_is_read_back(text):
    board = parse_board(text)
    assert parse_board(board.text()) == board


@pytest.mark.parametrize("text", BOARDS[1:])
def test_charuco_is_that_of_opencv(text):
    board = parse_board(text)
    twin, px = charuco(board), 60
    theirs = twin.generateImage((board.columns * px, board.rows * px), marginSize=0)
    v, u = (np.mgrid[0 : board.rows * px, 0 : board.columns * px] + 0.5) * board.square_m / px
    # A marker of 44 px does not divide into 7 cells: edges differ by a pixel.
    assert (dark_at(board, u, v) == (theirs < 128)).mean() > 0.97
    corners = np.asarray(twin.getChessboardCorners()).reshape(-1, 3)
    np.testing.assert_allclose(board.points(), corners, atol=1e-7)


def test_dictionaries_have_as_many_markers_as_opencv_says():
    for name, size in DICTIONARIES.items():
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        assert len(words.bytesList) == size, name


def call(capsys, *args):
    with pytest.raises(SystemExit) as caught:
        main(["board", *map(str, args)])
    out = capsys.readouterr()
    return caught.value.code, out.out, out.err


@pytest.mark.parametrize("paper", ["A4", "A3", "letter"])
def test_pdf_page_is_the_paper(capsys, tmp_path, paper):
    board = parse_board("chessboard:columns=8,rows=5,square_m=0.025")
    code, out, _ = call(capsys, board.text(), "--out", tmp_path / "b.pdf", "--paper", paper)
    assert code == 0
    assert "850 and 940 nm" in out
    assert "25 mm" in out
    page = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (tmp_path / "b.pdf").read_bytes())
    size_mm = sorted(float(side) / 72 * 25.4 for side in page.groups())
    assert size_mm == pytest.approx(sorted(PAPERS_MM[paper]), abs=0.01)


@pytest.mark.parametrize("text", BOARDS)
def test_png_has_its_scale_and_the_board_on_it_has_its_size(capsys, tmp_path, text):
    path, dpi = tmp_path / "b.png", 150
    code, out, _ = call(capsys, text, "--out", path, "--dpi", dpi, "--json")
    assert code == 0
    assert json.loads(out)["paper"] == "A4"
    data = path.read_bytes()
    at = data.index(b"pHYs") + 4
    per_metre = struct.unpack(">II", data[at : at + 8])
    assert per_metre == pytest.approx((dpi / 0.0254,) * 2, abs=1)
    board = parse_board(text)
    seen = find_board(read_view(path), board)
    assert len(seen.ids) == len(board.points())
    places = board.points()[seen.ids, :2]
    metres = seen.corners * 0.0254 / dpi
    offset = (metres - places).mean(axis=0)
    assert np.abs(metres - places - offset).max() < 5e-5  # a twentieth of a millimetre
    sheet = laid_out(board, "A4")
    pixel = 0.5 * 0.0254 / dpi  # pixel centres lie at whole numbers
    np.testing.assert_allclose(offset + pixel, np.array(sheet.origin_mm) / 1e3, atol=5e-5)


def test_a_sheet_is_the_same_every_time(tmp_path):
    sheet = laid_out(parse_board(CHARUCO), "A4")
    for name in ("a.pdf", "b.pdf"):
        write_sheet(tmp_path / name, sheet)
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


@pytest.mark.parametrize("args, words", [
    (["chessboard:columns=9,rows=6,square_m=0.04"], "400 x 280 mm and does not fit on A4; squares "
     "of up to 26.0 mm would (got 40), or --paper A2"),
    ([DEFAULT, "--paper", "B5"], "paper 'B5'"),
    ([DEFAULT, "--dpi", "9"], "dpi must be"),
    (["checker"], "board 'checker'"),
    (["chessboard:columns=2,rows=5"], "3 to 64 inner corners"),
    (["chessboard:square=3"], "no parameter 'square'"),
    (["charuco:square_m=0.03"], "without marker_m"),
    (["charuco:square_m=0.03,marker_m=0.03"], "less than square_m"),
    (["charuco:dictionary=DICT_9X9"], "dictionary 'DICT_9X9'"),
    (["charuco:columns=20,rows=10"], "need 100 markers, DICT_4X4_50 has 50"),
])  # fmt: skip
def test_bad_boards_are_refused_and_nothing_is_written(capsys, tmp_path, args, words):
    code, _, err = call(capsys, *args, "--out", tmp_path / "b.pdf")
    assert code == 2
    assert words in err
    assert list(tmp_path.iterdir()) == []


def test_only_pdf_and_png(capsys, tmp_path):
    code, _, err = call(capsys, DEFAULT, "--out", tmp_path / "b.svg")
    assert code == 2
    assert "written as .pdf or .png" in err
    with pytest.raises(ValueError, match="no markers"):
        Board("chessboard", 8, 5, 0.03, marker_m=0.02)
