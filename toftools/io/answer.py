"""What a capture says about its answer: the amplitude beside a range, a range where it has none."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from toftools.chain import find_method
from toftools.phasor import phasors_of
from toftools.types import F32, Capture, DepthMap


def answered(
    capture: Capture, method: str, *, before: Sequence[str] = (), after: Sequence[str] = ()
) -> DepthMap:
    """Depth map of a method, with the capture's amplitude where the method gives none.

    Parameters
    ----------
    capture : Capture
        What to correct.
    method : str
        ``name:key=val,...``, ``mypkg.mine:make``, or a chain with filters, joined by ``>``.
    before, after : sequence of str
        Further steps around it, as `toftools.chain.find_method` takes them.

    Returns
    -------
    DepthMap
        The answer.

    Raises
    ------
    ValueError
        If the method is unknown, does not suit the capture, or gives something else.
    """
    chosen = find_method(method, before=before, after=after)
    depth: object = chosen.build(capture.sensor)(phasors_of(capture))
    if not isinstance(depth, DepthMap):
        msg = f"the method {method!r} gave {type(depth).__name__}, wanted a DepthMap"
        raise ValueError(msg)
    return with_amplitude(depth, capture)


def with_amplitude(depth: DepthMap, capture: Capture) -> DepthMap:
    """The same depth map; one without amplitude takes that of the capture.

    Parameters
    ----------
    depth : DepthMap
        Any depth of the capture.
    capture : Capture
        Where it comes from.

    Returns
    -------
    DepthMap
        With amplitude, if the capture measured any.
    """
    if depth.amplitude is not None:
        return depth
    return replace(depth, amplitude=measured_amplitude(capture))


def measured_amplitude(capture: Capture) -> F32 | None:
    """Amplitude that came with a depth, or else of the first frequency.

    Parameters
    ----------
    capture : Capture
        Any capture.

    Returns
    -------
    ndarray, (H, W), or None
        Amplitude in the capture's unit; None if nothing but ranges was measured.
    """
    # First, since some formats hold unit phasors and keep the signal strength with the depth.
    if capture.depth is not None and capture.depth.amplitude is not None:
        return capture.depth.amplitude
    if capture.phasors is None and capture.taps is None:
        return None
    return np.asarray(np.abs(phasors_of(capture).values[0]), dtype=np.float32)


def depth_of(capture: Capture) -> tuple[DepthMap, str | None]:
    """Depth of a capture; one that holds none is unwrapped.

    Parameters
    ----------
    capture : Capture
        Any capture.

    Returns
    -------
    tuple of DepthMap and str or None
        The depth with amplitude, and the method that made it if it was not in the capture.
    """
    if capture.depth is not None:
        return with_amplitude(capture.depth, capture), None
    method = "single" if capture.sensor.modulation.n_freqs == 1 else "crt"
    return answered(capture, method), method
