"""Images that may show a board: from captures, from image files, and what is wrong with them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toftools._arrays import F32, Bool, expect_shape, frozen, set_fields
from toftools.conditions import name_of
from toftools.phasor import phasors_of
from toftools.types import Capture, Phasors

CLIPPED = 0.2
"""Share of saturated pixels from which a view without a board is called saturated."""
NOISE = 0.3
"""Correlation of neighbouring pixels below which an image is noise."""


@dataclass(frozen=True, eq=False)
class View:
    """One image that may show a board.

    Parameters
    ----------
    name : str
        File, for messages.
    image : ndarray, (H, W)
        Brightness, any unit; NaN where there is none.
    saturated : ndarray, (H, W), bool
        True where the brightness is clipped.
    phasors : Phasors or None
        What a ToF camera measured at the same time.
    """

    name: str
    image: F32
    saturated: Bool = None  # type: ignore[assignment]  # filled in __post_init__
    phasors: Phasors | None = None

    def __post_init__(self) -> None:
        image = frozen(self.image, np.float32, "image", 2)
        if min(image.shape) < 16:
            msg = f"{self.name} has {image.shape[1]} x {image.shape[0]} px; too few for a board"
            raise ValueError(msg)
        clipped = np.zeros(image.shape, bool) if self.saturated is None else self.saturated
        saturated = frozen(clipped, np.bool_, "saturated", 2)
        expect_shape("saturated", saturated, image.shape)
        set_fields(self, image=image, saturated=saturated)


def view_of(capture: Capture) -> View:
    """The image of a capture in which a board shows best.

    Parameters
    ----------
    capture : Capture
        Any capture with an amplitude.

    Returns
    -------
    View
        Amplitude at the frequency that has most of it; without phasors of its own that of the
        depth.
    """
    phasors = phasors_of(capture)
    amplitude = np.abs(phasors.values)
    finite = np.where(np.isfinite(amplitude), amplitude, 0.0)
    best = int(np.argmax([np.percentile(layer, 90) for layer in finite]))
    valid = phasors.valid if capture.taps is None else capture.taps.valid
    measured = capture.taps is not None or capture.phasors is not None
    return View(name_of(capture), amplitude[best], ~valid, phasors if measured else None)


def read_view(path: Path | str) -> View:
    """An image file as a view.

    Parameters
    ----------
    path : path
        Grey or colour image of 8 or 16 bits, such as PNG.

    Returns
    -------
    View
        Its brightness; pixels at the largest value that its bits can hold are saturated.

    Raises
    ------
    ValueError
        If the file is missing or is no image.
    """
    import cv2

    path = Path(path)
    if not path.is_file():
        msg = f"{path} is not there; give the file of an image"
        raise ValueError(msg)
    data = np.frombuffer(path.read_bytes(), np.uint8)
    try:
        image = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH) if data.size else None
    except cv2.error as error:
        msg = f"{path.name} cannot be read as an image: {' '.join(str(error).split())}"
        raise ValueError(msg) from error
    if image is None:
        msg = f"{path.name} is no image that OpenCV knows; give a PNG, TIFF or JPEG file"
        raise ValueError(msg)
    full = np.iinfo(image.dtype).max if image.dtype.kind == "u" else np.inf
    return View(path.name, image, np.asarray(image >= full))


def trouble(view: View) -> str:
    """What is wrong with the light of a view that shows no board.

    Parameters
    ----------
    view : View
        Any view.

    Returns
    -------
    str
        ``black``, ``saturated`` or nothing.
    """
    if view.saturated.mean() > CLIPPED:
        return "saturated"
    image = np.nan_to_num(view.image, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float64)
    left, right = image[:, :-1] - image.mean(), image[:, 1:] - image.mean()
    power = float(np.sqrt((left**2).mean() * (right**2).mean()))
    return "black" if float((left * right).mean()) <= NOISE * power else ""
