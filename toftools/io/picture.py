"""Pictures of a colour camera."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def read_picture(path: Path | str) -> NDArray[np.uint8]:
    """Colours of an image file.

    Parameters
    ----------
    path : path
        PNG, JPEG, TIFF or what else OpenCV reads; deeper ones are brought to 8 bits.

    Returns
    -------
    ndarray, (H, W, 3), uint8
        Red, green and blue.

    Raises
    ------
    ValueError
        If the file is missing or no image.
    """
    import cv2

    path = Path(path)
    if not path.is_file():
        msg = f"{path} is not there; give the picture of the colour camera"
        raise ValueError(msg)
    data = np.frombuffer(path.read_bytes(), np.uint8)
    try:
        image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    except cv2.error as error:
        msg = f"{path.name} cannot be read as an image: {' '.join(str(error).split())}"
        raise ValueError(msg) from error
    if image is None:
        msg = f"{path.name} is no image that OpenCV knows; give a PNG, TIFF or JPEG file"
        raise ValueError(msg)
    return np.ascontiguousarray(image[..., ::-1])
