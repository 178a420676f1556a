"""What `toftools simulate` says about a capture: what was modelled, why, and how well."""

from collections.abc import Iterator, Mapping
from math import hypot
from typing import Any

from toftools.types import Capture, Truth

LABEL = 14


def told(capture: Capture, *, wall_s: float, peak_mb: float) -> list[str]:
    """The report of one capture, a line each.

    Parameters
    ----------
    capture : Capture
        With the provenance of the engine that made it.
    wall_s : float
        Time it took, s.
    peak_mb : float
        Largest memory of the process, MB; NaN where nobody knows.

    Returns
    -------
    list of str
        Lines, of which the first is about the engine.
    """
    facts = capture.provenance
    lines = [
        ("engine", f"{facts['engine']}, because {facts['engine_why']}"),
        *_light(facts),
        *_paths(facts),
        *_lamps(facts),
        *_motion(capture),
        *((("not modelled", str(facts["not_modelled"])),) if "not_modelled" in facts else ()),
        *(("scene edit", str(note)) for note in facts.get("scene_notes", ())),
        ("pixels", _pixels(capture)),
        ("took", _cost(wall_s, peak_mb)),
    ]
    return [f"  {label:<{LABEL}}{text}" for label, text in lines]


def _light(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    from toftools.sim.radiosity import SOLVED

    bounces = facts.get("max_bounces")
    if facts.get("max_bounces_why") == SOLVED.why:
        yield "bounces", SOLVED.why
    elif "max_bounces_why" in facts:
        yield "bounces", f"{bounces}: {facts['max_bounces_why']}"
    else:
        yield "bounces", "all that the engine has" if bounces is None else f"{bounces} at most"


def _paths(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Paths and what they reached; a missed tolerance is said aloud, with what helps."""
    if "samples" not in facts:
        return
    most, mean, error = facts["samples"], facts["samples_mean"], facts["standard_error_mm"]
    yield from _virtual(facts)
    if "virtual_lights" in facts:
        if most:
            yield "paths", f"up to {most} a pixel of those left to them"
        yield from _over_the_image(facts)
        return
    if not most:
        yield "paths", "none, as direct light is computed without"
        return
    known = "" if error is None else f"; standard error of range up to {_mm(error)} in a tile"
    yield "paths", f"up to {most} a pixel, {mean:.0f} on average{known}"
    if facts["tolerance_met"]:
        yield "tolerance", f"{facts['tolerance_mm']:g} mm met in every tile"
    elif facts["tolerance_met"] is not None:
        yield "tolerance", missed(facts)


def _virtual(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Virtual lights, where they were gathered, and what they reached."""
    if "left_why" in facts:
        yield "left to path", f"{facts['left_to_path']:.1%} of the pixels: {facts['left_why']}"
    if "virtual_lights" not in facts:
        return
    lights, views, gathered = (facts[k] for k in ("virtual_lights", "viewpoints", "gathered"))
    seen = f"{views} viewpoint{'s' * (views != 1)}"
    yield "lights", f"{lights} virtual ones as seen from {seen}, gathered at {gathered} points"
    scatter, between = _mm(facts["scatter_mm"]), _mm(facts["interpolation_mm"])
    yield "error", f"{scatter} rms of range by scatter, {between} by interpolation"


def _over_the_image(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Whether virtual lights, and the paths beside them, reached the tolerance."""
    wanted, most = facts["tolerance_mm"], facts["samples"]
    if wanted is None:
        return
    reached = hypot(facts["scatter_mm"], facts["interpolation_mm"])
    if facts["tolerance_met"]:
        text = " and in every tile of paths" if most else ""
        yield "tolerance", f"{wanted:g} mm met over the image{text}"
        return
    if reached > wanted:
        what, cure = f"the image has {_mm(reached)} rms", "take paths (--engine path)"
        more = f"--tol-mm {_up(reached):g}"
    else:
        what = "not in every tile of paths"
        cure = f"allow more (--engine radiosity:max_samples={4 * most})"
        more = "a larger --tol-mm"
    yield "tolerance", f"{wanted:g} mm NOT MET, {what}; {cure} or accept more ({more})"


def missed(facts: Mapping[str, Any]) -> str:
    """One sentence about a tolerance that was not met.

    Parameters
    ----------
    facts : mapping
        Provenance of the path engine.

    Returns
    -------
    str
        What was wanted, what was reached, and what to do.
    """
    wanted, reached, most = facts["tolerance_mm"], facts["standard_error_mm"], facts["samples"]
    share = facts.get("within_tolerance")
    where = "" if share is None else f" in {1 - share:.1%} of the pixels"
    return (
        f"{wanted:g} mm NOT MET{where}, the worst tile has {_mm(reached)} after {most} paths a "
        f"pixel; allow more (--engine path:max_samples={4 * most}) or accept more "
        f"(--tol-mm {_up(reached):g})"
    )


def _lamps(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    lamps = facts.get("lamps", {})
    if sum(lamps.values()):
        off = facts["lamp_gain"] == 0
        state = "switched off" if off else f"radiance 1 counts {facts['lamp_gain']:g}"
        yield "lamps", f"{lamps['modulated']} modulated, {lamps['ambient']} ambient, {state}"
    if facts.get("ambient_e"):
        yield "ambient", f"{facts['ambient_e']:g} electrons per tap on every pixel, unmodulated"


def _motion(capture: Capture) -> Iterator[tuple[str, str]]:
    """Motion, and that it is not seen where all taps are taken at once."""
    import numpy as np

    params = capture.provenance.get("scene_params", capture.provenance)
    if not any(np.any(params.get(name, 0.0)) for name in ("velocity", "velocity_mps")):
        return
    if capture.sensor.timing.tap_interval_s > 0:
        yield "motion", "taps see the scene at their own times; truth is that of the first"
    else:
        cure = "--sensor NAME:tap_interval_s=0.001 spreads them"
        yield "motion", f"NOT SEEN, as all taps are taken at once; {cure}"


def _pixels(capture: Capture) -> str:
    import numpy as np

    parts = []
    if capture.truth is not None:
        parts.append(f"{np.isfinite(capture.truth.range_m).mean():.1%} see a surface")
        if capture.truth.direct is not None and not _total(capture.truth).any():
            parts.append("NONE gets modulated light: look for glass, at emitters and at the beam")
    if capture.taps is not None and not capture.taps.valid.all():
        parts.append(f"{(~capture.taps.valid).sum()} are saturated")
    return ", ".join(parts)


def _total(truth: Truth) -> Any:  # noqa: ANN401 - an array
    parts = (truth.direct, truth.one_bounce, truth.rest)
    return sum(part for part in parts if part is not None)


def _cost(wall_s: float, peak_mb: float) -> str:
    memory = f", at most {peak_mb:.0f} MB of memory" if peak_mb == peak_mb else ""
    return f"{wall_s:.1f} s{memory}"


def _mm(value: float) -> str:
    return f"{value:.3g} mm"


def _up(value: float) -> float:
    """The next number of two digits."""
    from math import ceil, floor, log10

    step = 10.0 ** (floor(log10(value)) - 1)
    return ceil(value / step) * step
