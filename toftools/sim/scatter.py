"""Lens scatter (veiling glare): a share of the light is spread over its neighbourhood.

The kernel is ``(1 - s) delta + s G`` with G a Gaussian of standard deviation `scatter_px`, mirrored
at the image borders: light that would leave the image stands for what comes in from outside, and no
energy is lost. It acts on complex light and on its mean alike, so that a bright near object drags
the phase of dark pixels around it towards its own (J. Mure-Dubois, H. Huegli, "Real-time scattering
compensation for time-of-flight camera", ICVS 2007: scattering is linear in the complex image). One
Gaussian is the simplest kernel in use; real lenses have longer tails, which measured kernels show
(T. Kavli et al., "Modelling and compensating measurement errors caused by scattering in
time-of-flight cameras", 2008).
"""

import numpy as np
from numpy.typing import NDArray

from toftools.types import Defects


def scattered(
    light: NDArray[np.complex128] | NDArray[np.float64], defects: Defects
) -> NDArray[np.complex128] | NDArray[np.float64]:
    """An image of light behind a lens that scatters.

    Parameters
    ----------
    light : ndarray, (H, W), real or complex
        Light per pixel.
    defects : Defects
        `scatter` and `scatter_px`; without scatter the image comes back as it is.

    Returns
    -------
    ndarray, (H, W)
        Image with the same sum.

    Examples
    --------
    >>> spot = np.zeros((9, 9)); spot[4, 4] = 1
    >>> veiled = scattered(spot, Defects(scatter=0.1, scatter_px=2))
    >>> bool(np.isclose(veiled.sum(), 1)), round(float(veiled[4, 4]), 3)
    (True, 0.904)
    """
    if defects.scatter == 0:
        return light
    from scipy.fft import dctn, idctn

    # Cosine waves are the eigenvectors of every even kernel between mirrors half a pixel outside.
    decay = [
        np.exp(-0.5 * (np.pi * np.arange(n) / n * defects.scatter_px) ** 2) for n in light.shape
    ]
    kept = (1 - defects.scatter) + defects.scatter * np.outer(*decay)
    return np.asarray(idctn(dctn(light) * kept))
