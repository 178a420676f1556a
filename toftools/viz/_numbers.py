"""Numbers as people read them."""

import math


def figure(value: float) -> str:
    """A number with three significant digits; a dash for none, 0 below a millionth.

    Parameters
    ----------
    value : float
        Number.

    Returns
    -------
    str
        Text.

    Examples
    --------
    >>> figure(31.42), figure(0.01234), figure(1234.5), figure(float("nan"))
    ('31.4', '0.0123', '1234', '–')
    """
    if not math.isfinite(value):
        return "–"
    if abs(value) < 1e-6:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{digits}f}"
