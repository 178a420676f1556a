"""The lens from pictures of a board that are no captures: infrared PNG files of any camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from toftools.calib.board import DEFAULT, parse_board
from toftools.calib.chain import Chain, chain_for
from toftools.calib.lens import SIZES, Lens, fit_lens, read_view
from toftools.registry import CALIBRATIONS, find
from toftools.sensors import sensor

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
MODELS = {"lens": "pinhole", "lens_fisheye": "fisheye"}


def are_pictures(entry: str, paths: Sequence[Path], format_text: str | None) -> bool:
    """Whether these files are pictures for the lens rather than captures.

    Parameters
    ----------
    entry : str
        Stage as typed.
    paths : sequence of Path
        Files.
    format_text : str or None
        Forced format of captures.

    Returns
    -------
    bool
        True for a lens, pictures alone and no forced format.
    """
    named = entry.partition(":")[0] in MODELS
    return named and format_text is None and all(p.suffix.lower() in SUFFIXES for p in paths)


def lens_of_pictures(
    entry: str, paths: Sequence[Path], board: str | None, camera: str | None, chain: Chain | None
) -> tuple[Chain, Lens]:
    """Fit the lens to pictures.

    Parameters
    ----------
    entry : str
        ``lens`` or ``lens_fisheye`` with parameters.
    paths : sequence of Path
        Pictures.
    board : str or None
        Board as typed.
    camera : str or None
        The camera as typed: a preset with overrides.
    chain : Chain or None
        Calibration to extend.

    Returns
    -------
    tuple of Chain and Lens
        The chain so far, and the stage.

    Raises
    ------
    ValueError
        If nobody says the camera, sizes differ, or the fit refuses the pictures.
    """
    device = None if camera is None else sensor(camera)
    if chain is None and device is None:
        msg = (
            "pictures do not say which camera took them; give --sensor, such as "
            "opt8241:width=640,height=480,freqs=40e6, or extend a calibration with --from"
        )
        raise ValueError(msg)
    start = chain_for(device) if chain is None and device is not None else chain
    assert start is not None
    views = [read_view(path) for path in paths]
    for view in views:
        if view.image.shape != (start.height, start.width):
            rows, columns = view.image.shape
            msg = (
                f"{view.name} has {columns} x {rows} px, the camera {start.width} x {start.height};"
                " calibrate one resolution at a time"
            )
            raise ValueError(msg)
    spec = find(CALIBRATIONS, entry)
    params = dict(spec.params)
    count, parts = params.pop("distortion", None), params.pop("hold_out", 5)
    if params:
        msg = f"pictures take distortion and hold_out, got {', '.join(params)}"
        raise ValueError(msg)
    model = MODELS[entry.partition(":")[0]]
    sizes = (4,) if model == "fisheye" else SIZES if count is None else (int(count),)
    nominal = None if device is None else device.camera
    stage = fit_lens(
        views, parse_board(board or DEFAULT), nominal, model=model, sizes=sizes, hold_out=int(parts)
    )
    return start, stage
