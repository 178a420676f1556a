"""Every registered correction on any capture, none of them named here.

A method is asked for its answer; what does not suit a sensor says so itself, in its own sentence.
Slow methods see fewer pixels: every second, fourth or eighth along both sides, through a camera
with as many, so that methods that use geometry see the same scene, only more coarsely.
"""

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from toftools import registry
from toftools.types import Camera, DepthMap, Phasors, Sensor

STRIDES = (8, 4, 2, 1)
FRAME_PIXELS = 320 * 240
LEAST_PIXELS = 12


@dataclass(frozen=True)
class Job:
    """What a run was asked for, and what it has made so far."""

    folder: Path
    cache: Path
    log: Callable[[str], None]
    quick: bool = False
    names: tuple[str, ...] = ()
    made: dict[Any, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Method:
    """A registered method with parameters; the label is what one would type."""

    name: str
    params: dict[str, Any] = field(default_factory=dict)

    @property
    def label(self):
        text = ",".join(f"{key}={_typed(value)}" for key, value in self.params.items())
        return f"{self.name}:{text}" if text else self.name


@dataclass(frozen=True)
class Answer:
    """An answer on every `stride`-th pixel, and the least time it took."""

    depth: DepthMap
    stride: int
    ms: float

    @property
    def ms_frame(self):
        """Time for 320 x 240 pixels at this time per pixel, ms."""
        return self.ms * FRAME_PIXELS / self.depth.range_m.size


def _typed(value):
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def methods(job, *, grid=False, **hints):
    """The registry as methods; each hint is given to those that have such a parameter."""
    found = []
    for name, spec in registry.CORRECTIONS.items():
        if job.names and name not in job.names:
            continue
        try:
            known = registry.parameters_of(spec.load())
        except ValueError:  # a package is missing: `built` says which
            known = {}
        fixed = {key: value for key, value in hints.items() if key in known}
        if not grid:
            found.append(Method(name, fixed))
            continue
        dials = {key: values for key, values in spec.grid.items() if key not in fixed}
        points = list(itertools.product(*dials.values()))
        for point in points[:2] if job.quick else points:
            found.append(Method(name, {**fixed, **dict(zip(dials, point, strict=True))}))
    return found


def built(job, method, sensor):
    """The method made for a sensor, or its sentence why it does not suit."""
    mod, camera = sensor.modulation, sensor.camera
    device = (method.label, mod.freqs_hz.tobytes(), mod.steps_rad.tobytes(), repr(sensor.noise))
    if device in job.made:
        return job.made[device]
    key = (*device, camera.shape, camera.K.tobytes(), camera.dist.tobytes())
    if key not in job.made:
        try:
            job.made[key] = registry.CORRECTIONS[method.name].build(sensor, **method.params)
        except ValueError as error:
            text = " ".join(str(error).split())
            job.made[key] = text.partition(" (/")[0]  # where a module lies is no one's business
        except Exception as error:  # so is a failure, which is a result here
            job.made[key] = failure(job, method, error)
        if isinstance(job.made[key], str) or pointwise(job.made[key], mod.freqs_hz.size):
            job.made[device] = job.made[key]  # the camera does not matter
    return job.made[key]


def failure(job, method, error):
    """A method's failure as a sentence."""
    text = f"failed with {type(error).__name__}: {' '.join(str(error).split())}"
    job.log(f"{method.label} {text}")
    return text


def pointwise(run, n_freqs):
    """Whether pixels are answered one by one, so that any pixels make a frame.

    Two flat halves under noise that a neighbour's advice would help with; and with the same pixels
    shuffled each must get the same answer.
    """
    rng = np.random.default_rng(0)
    turns = np.repeat(rng.random((n_freqs, 2)), 72, axis=1)
    values = np.exp(2j * np.pi * (turns + 0.04 * rng.normal(size=turns.shape)))
    order = rng.permutation(144)
    try:
        here, there = (
            run(Phasors(v.reshape(-1, 12, 12).astype(np.complex64))).range_m.reshape(-1)
            for v in (values, values[:, order])
        )
    except Exception:  # it wants frames of its camera, or fails: the real call will say so
        return False
    told = np.isfinite(here).any()  # one that rejects everything shows nothing
    return bool(told and np.array_equal(here[order], there, equal_nan=True))


def decimated(sensor, phasors, stride):
    """Every `stride`-th pixel along both sides, as a camera of its own."""
    if stride == 1:
        return sensor, phasors
    cut = (..., slice(None, None, stride), slice(None, None, stride))
    values = phasors.values[cut]
    sigma = None if phasors.sigma is None else phasors.sigma[cut]
    scaled = np.diag([1 / stride, 1 / stride, 1.0]) @ sensor.camera.K
    height, width = values.shape[1:]
    camera = Camera(width, height, scaled, sensor.camera.dist)
    small = replace(sensor, camera=camera, maps=None)
    return small, Phasors(values, sigma, phasors.valid[cut])


def answer(job, method, sensor: Sensor, phasors: Phasors, *, budget_s=2.0):
    """The answer on as many pixels as the budget allows; a sentence if there is none.

    The strides get finer while the time of the next, told from the growth so far, is affordable.
    """
    found: Answer | None = None
    earlier = None
    for stride in STRIDES:
        if stride > 1 and min(phasors.valid.shape) < 4 * stride:
            continue
        if found is not None:
            growth = 4.0 if earlier is None else max(found.ms / max(earlier, 1e-3), 1.0)
            if found.ms * min(growth, 16.0) > 1e3 * budget_s:
                break
            earlier = found.ms
        small, seen = decimated(sensor, phasors, stride)
        run = built(job, method, small)
        if isinstance(run, str):
            return run
        try:
            depth, ms = timed(run, seen)
        except Exception as error:
            return failure(job, method, error)
        found = Answer(depth, stride, ms)
    return found


def timed(run, phasors, *, repeats=5, spend_s=0.15, once_s=0.5):
    """Answer, and the least of a few times, ms; one call does where that takes long."""
    times: list[float] = []
    while len(times) < repeats and (
        sum(times) < 1e3 * spend_s or (len(times) == 1 and times[0] < 1e3 * once_s)
    ):
        begin = time.perf_counter()
        depth = run(phasors)
        times.append(1e3 * (time.perf_counter() - begin))
    return depth, min(times)


def sentences(refused):
    """Folded Markdown list of the methods that do not suit, each with its own words."""
    if not refused:
        return ""
    lines = [f"- `{label}`: {why}" for label, why in refused.items()]
    head = f"<details><summary>Unsuited, in their own words ({len(lines)})</summary>"
    return "\n".join([head, "", *lines, "", "</details>"])


def table(head, rows):
    """Markdown table, numbers right."""
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 1)}"]
    return "\n".join(lines + [f"| {' | '.join(map(str, row))} |" for row in rows])


def number(value, form=".2f", scale=1.0):
    """Text of a figure; a dash for none."""
    if value is None or not np.isfinite(value):
        return "–"
    return format(value * scale, form)


def plain(value):
    """The value as JSON can hold it: four digits, null for what is not finite."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return float(f"{value:.4g}") if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value
