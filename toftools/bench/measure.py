"""One point measured: a method made, called, timed, its answer checked and its input too."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from toftools.bench.fingerprint import capture_digest, digest
from toftools.bench.memory import forget_peak, resident_mb
from toftools.bench.methods import method_of, specs_of
from toftools.bench.references import REFERENCES
from toftools.chain import Chain
from toftools.phasor import phasors_of
from toftools.registry import Spec
from toftools.types import Capture, DepthMap, Phasors

BUDGET_S = 8.0  # steady calls stop here if the repeats are not done; at least three are made


def measure(capture: Capture, method: str, params: dict[str, Any], repeats: int) -> dict[str, Any]:
    """Build a method, run it, time it.

    Parameters
    ----------
    capture : Capture
        Input.
    method : str
        Registry name, reference name, ``module:function`` or a chain.
    params : dict
        Parameters.
    repeats : int
        Steady calls wanted.

    Returns
    -------
    dict
        ``status``, ``depth``, ``run``, the method as it was built, and, for real methods,
        ``setup_s``, ``first_call_s``, ``ms``, ``ms_iqr``, ``calls``, and ``peak_mb``, the highest
        memory above what the process held before the method was loaded; or status ``unsuited``
        and the method's reason.

    Raises
    ------
    TypeError
        If the answer is no depth map of the input's shape.
    ValueError
        If the method changed its input, or its depth map holds what no depth map may hold.
    """
    phasors = phasors_of(capture)
    before = _digest(capture, phasors)
    base_mb = forget_peak()
    start = time.perf_counter()
    wanted = method_of(method)
    for spec in specs_of(wanted):
        spec.load()  # what cannot be imported is a failure, not a method that does not suit
    try:
        run = wanted.build(capture if method in REFERENCES else capture.sensor, **params)
    except ValueError as error:
        # A method looks at the sensor when it is made: this one does not suit it.
        return {"status": "unsuited", "error": sentence(error, named=False)}
    setup_s = time.perf_counter() - start
    result: dict[str, Any]
    if method in REFERENCES:
        result = {"depth": plain_answer(run(phasors), capture.sensor.camera.shape)}
    else:
        result = {"setup_s": setup_s, **_timed(run, phasors, repeats)}
        result["peak_mb"] = max(resident_mb("VmHWM") - base_mb, 0.0)
    if _digest(capture, phasors) != before:
        msg = "the method changed its input, which others see too; it must work on a copy"
        raise ValueError(msg)
    return {"status": "ok", "run": run, **result}


def prime(capture: Capture, method: Spec | Chain, params: dict[str, Any]) -> None:
    """Run a method once, untimed, so that what follows finds it loaded and compiled.

    Parameters
    ----------
    capture : Capture
        Input.
    method : Spec or Chain
        A method; not a reference row.
    params : dict
        Parameters.
    """
    method.build(capture.sensor, **params)(phasors_of(capture))


def _timed(run: Callable[[Phasors], object], phasors: Phasors, repeats: int) -> dict[str, Any]:
    """First call and steady calls; both the first answer and the last are checked."""
    shape = phasors.valid.shape
    start = time.perf_counter()
    depth = run(phasors)
    first_call_s = time.perf_counter() - start
    plain_answer(depth, shape)
    times: list[float] = []
    began = time.perf_counter()
    while len(times) < repeats:
        start = time.perf_counter()
        depth = run(phasors)
        times.append(1e3 * (time.perf_counter() - start))
        if len(times) >= 3 and time.perf_counter() - began > BUDGET_S:
            break
    low, mid, high = np.percentile(times, [25, 50, 75])
    return {
        "depth": plain_answer(depth, shape),
        "first_call_s": first_call_s,
        "ms": float(mid),
        "ms_iqr": float(high - low),
        "calls": len(times),
    }


def plain_answer(depth: object, shape: tuple[int, ...]) -> DepthMap:
    """What a method gave as a plain depth map, every field read once and checked anew.

    A subclass may say something else at every look, and fields of a frozen value can be set.

    Parameters
    ----------
    depth : object
        What the method returned.
    shape : tuple of int
        Rows and columns wanted.

    Returns
    -------
    DepthMap
        Of that very class.

    Raises
    ------
    TypeError
        If it is no depth map of that shape.
    ValueError
        If a field is none of a depth map.
    """
    got: object = type(depth).__name__
    if isinstance(depth, DepthMap):
        plain = DepthMap(
            depth.range_m, depth.sigma_m, depth.confidence, depth.amplitude, depth.info
        )
        if plain.range_m.shape == shape:
            return plain
        got = plain.range_m.shape
    msg = f"the method must return a DepthMap of shape {shape}, got {got}"
    raise TypeError(msg)


def _digest(capture: Capture, phasors: Phasors) -> str:
    """Digest of all that a method could write into."""
    sigma = b"" if phasors.sigma is None else phasors.sigma.tobytes()
    return digest(capture_digest(capture), phasors.values.tobytes(), sigma, phasors.valid.tobytes())


def sentence(error: BaseException, *, named: bool = True, most: int = 500) -> str:
    """One line about what a method raised, whatever that was.

    Parameters
    ----------
    error : BaseException
        What was raised.
    named : bool
        Begin with its class.
    most : int
        Characters that are kept.

    Returns
    -------
    str
        Its message without line breaks.
    """
    try:
        said = " ".join(str(error)[: 4 * most].split())
    except Exception:  # a method's own exception may fail to speak
        said = "its message cannot be shown"
    said = f"{type(error).__name__}: {said}" if named else said
    return said if len(said) <= most else f"{said[: most - 3]}..."
