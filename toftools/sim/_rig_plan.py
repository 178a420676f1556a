"""What a virtual rig captures: one `Take` per capture, in the order of a working day."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from toftools.conditions import Conditions
from toftools.sim._rig_boards import CELLS, corners_m, pose_at
from toftools.sim._rig_unit import Unit, level_e
from toftools.sim.target import FACING
from toftools.types import F64
from toftools.units import ambiguity_m

RAIL_M = (0.5, 5.5)
"""Where a rail begins, and where it ends at the latest."""
TURNS = 1.1
"""Length of a rail in turns of the lowest frequency, where it is long enough."""
LAMP = (0.04, 0.08, 0.16, 0.32, 0.5, 0.7)
"""Exposures of the flats, share of the full well."""


@dataclass(frozen=True, eq=False)
class Take:
    """One capture to be made.

    Parameters
    ----------
    name : str
        Name of its file.
    conditions : Conditions
        What the bench will say about it.
    albedo : float
        Of the plane; 0 for no light at all.
    lamp_e : float
        Unmodulated charge per tap instead of the camera's own light, electrons, exposure included.
    pose : tuple of (ndarray (3, 3), ndarray (3,)) or None
        Rotation and origin of the board.
    """

    name: str
    conditions: Conditions
    albedo: float = 0.5
    lamp_e: float = 0.0
    pose: tuple[F64, F64] | None = None


@dataclass(frozen=True)
class Plan:
    """How many captures of every kind, and where.

    Parameters
    ----------
    rail, delay, boards, warmup, dark, flats, check : int
        Number of captures; flats are as many of `LAMP`.
    walls_m : tuple of float
        Distances of the wall, m.
    repeats : int
        Captures at each of them.
    albedos, gray_m : tuple of float
        Brightnesses of the gray targets and their distances, m: one capture each.
    """

    rail: int
    delay: int
    boards: int
    warmup: int
    dark: int
    flats: int
    check: int
    walls_m: tuple[float, ...]
    repeats: int
    albedos: tuple[float, ...]
    gray_m: tuple[float, ...]


PLANS: Mapping[str, Plan] = MappingProxyType(
    {
        "small": Plan(12, 12, 12, 8, 2, 4, 4, (1.0, 1.6), 4, (0.1, 0.3, 0.8), (0.8, 1.7)),
        "full": Plan(
            41, 32, 20, 30, 4, 6, 12, (0.9, 1.4, 2.1), 4, (0.05, 0.1, 0.2, 0.4, 0.8),
            (0.6, 1.4, 2.2, 3.1),
        ),
    }
)  # fmt: skip
"""Plans by name."""


def takes(plan: Plan, unit: Unit, seed: int) -> list[Take]:
    """Every capture of a plan.

    Parameters
    ----------
    plan : Plan
        How many.
    unit : Unit
        Camera.
    seed : int
        Of poses, and of what the check set looks like.

    Returns
    -------
    list of Take
        In the order of `toftools.conditions.KINDS`.
    """
    parts: tuple[Callable[[Plan, Unit, int], list[Take]], ...] = (
        _boards, _lamp, _rail, _delay, _walls, _gray, _warmup, _check,
    )  # fmt: skip
    return [take for part in parts for take in part(plan, unit, seed)]


def rail_m(plan: Plan, unit: Unit) -> F64:
    """Positions of the rail, m."""
    length = TURNS * float(ambiguity_m(unit.nominal.modulation.freqs_hz.min()))
    return np.linspace(RAIL_M[0], min(RAIL_M[0] + length, RAIL_M[1]), plan.rail).round(4)


def _told(
    unit: Unit,
    kind: str,
    distance_m: float,
    *,
    albedo: float = 0.5,
    normal: tuple[float, float, float] = FACING,
    delay_s: float = 0.0,
    light: float = 1.0,
) -> Conditions:
    """Conditions of a plane, exposed so that the axis gets `level_e`, times `light`."""
    noise, errors = unit.nominal.noise, unit.errors
    exposure = light * level_e(unit.nominal) * distance_m**2 / (noise.signal_e * albedo)
    exposure = float(f"{exposure:.4g}")
    return Conditions(
        kind, distance_m=distance_m, normal=normal, delay_s=delay_s,
        sensor_c=errors.reference_sensor_c, light_c=errors.reference_light_c, exposure=exposure,
    )  # fmt: skip


def _name(kind: str, i: int) -> str:
    return f"{kind}_{i:02d}.h5"


def _rail(plan: Plan, unit: Unit, seed: int) -> list[Take]:
    places = rail_m(plan, unit).tolist()
    return [Take(_name("rail", i), _told(unit, "rail", z)) for i, z in enumerate(places)]


def _delay(plan: Plan, unit: Unit, seed: int) -> list[Take]:
    turn_s = 1 / float(unit.nominal.modulation.freqs_hz.min())
    steps = (np.arange(plan.delay) * (turn_s / max(plan.delay, 1))).tolist()
    z = plan.walls_m[0]
    return [
        Take(_name("delay", i), _told(unit, "delay", z, delay_s=delay))
        for i, delay in enumerate(steps)
    ]


def _walls(plan: Plan, unit: Unit, seed: int) -> list[Take]:
    places = [z for z in plan.walls_m for _ in range(plan.repeats)]
    return [Take(_name("wall", i), _told(unit, "wall", z)) for i, z in enumerate(places)]


def _gray(plan: Plan, unit: Unit, seed: int) -> list[Take]:
    """All at the exposure that suits the middle one at 1 m: brightness does the rest."""
    exposure = _told(unit, "gray", 1.0, albedo=0.5).exposure
    found: list[Take] = []
    for z in plan.gray_m:
        for albedo in plan.albedos:
            light = exposure / _told(unit, "gray", z, albedo=albedo).exposure
            told = _told(unit, "gray", z, albedo=albedo, light=light)
            found.append(Take(_name("gray", len(found)), told, albedo))
    return found


def _warmup(plan: Plan, unit: Unit, seed: int) -> list[Take]:
    """Frames over four of the longer time constants, closer together at first."""
    errors = unit.errors
    longest = max(errors.sensor_tau_s, errors.light_tau_s)
    time = 4 * longest * np.linspace(0, 1, plan.warmup) ** 2
    found = []
    for i, t in enumerate(time.tolist()):
        told = _told(unit, "warmup", plan.walls_m[-1])
        found.append(Take(_name("warmup", i), _at(told, *_temperatures(unit, t))))
    return found


def _temperatures(unit: Unit, time_s: float) -> tuple[float, float]:
    errors = unit.errors
    ends = (errors.reference_sensor_c, errors.reference_light_c)
    taus = (errors.sensor_tau_s, errors.light_tau_s)
    sensor_c, light_c = (
        end + (errors.room_c - end) * float(np.exp(-time_s / tau))
        for end, tau in zip(ends, taus, strict=True)
    )
    return sensor_c, light_c


def _at(told: Conditions, sensor_c: float, light_c: float) -> Conditions:
    return Conditions(
        **{**vars(told), "sensor_c": round(sensor_c, 2), "light_c": round(light_c, 2)}
    )


def _lamp(plan: Plan, unit: Unit, seed: int) -> list[Take]:
    """Dark frames, and flats in the light of a steady lamp."""
    errors, noise = unit.errors, unit.nominal.noise
    sensor_c, light_c = errors.reference_sensor_c, errors.reference_light_c
    full = min(noise.full_well_e, 8 * level_e(unit.nominal))
    unlit = Conditions("dark", sensor_c=sensor_c, light_c=light_c)
    dark = [Take(_name("dark", i), unlit, albedo=0.0) for i in range(plan.dark)]
    chosen = np.linspace(0, len(LAMP) - 1, plan.flats).round().astype(int)
    flats = [
        Take(
            _name("flat", i),
            replace(unlit, kind="flat", exposure=LAMP[k] / LAMP[0]),
            albedo=0.0, lamp_e=LAMP[k] * full,
        )
        for i, k in enumerate(chosen.tolist())
    ]  # fmt: skip
    return dark + flats


def _check(plan: Plan, unit: Unit, seed: int) -> list[Take]:
    """Planes between the positions of rail and walls, each of its own tilt, light and warmth."""
    rng = np.random.default_rng((seed, 1))
    rail = rail_m(plan, unit)
    taken = np.r_[rail, plan.walls_m, plan.gray_m]
    edges = np.linspace(rail[0], rail[-1], plan.check + 1)
    found = []
    for i in range(plan.check):
        places = rng.uniform(edges[i], edges[i + 1], 64)
        apart = np.abs(places[:, None] - taken).min(axis=1)
        z = round(float(places[np.argmax(apart)]), 4)
        tilt, way = np.radians(20 * rng.random()), 2 * np.pi * rng.random()
        across = np.round(np.sin(tilt) * np.array([np.cos(way), np.sin(way)]), 4).tolist()
        normal = (across[0], across[1], round(-float(np.cos(tilt)), 4))
        albedo, light = round(rng.uniform(0.2, 0.8), 3), float(2 ** rng.uniform(-1, 1))
        told = _told(unit, "check", z, albedo=albedo, normal=normal, light=light)
        warm = _temperatures(unit, float(rng.uniform(0.3, 4)) * unit.errors.light_tau_s)
        found.append(Take(_name("check", i), _at(told, *warm), albedo))
    return found


def _boards(plan: Plan, unit: Unit, seed: int) -> list[Take]:
    """Views of the board: all parts of the image, tilts up to 40 degrees every way."""
    rng = np.random.default_rng((seed, 0))
    camera = unit.sensor.camera
    found: list[Take] = []
    while len(found) < plan.boards:
        for cell in rng.permutation(CELLS).tolist():
            pose = pose_at(camera, cell, rng)
            middle_m = float(np.linalg.norm(corners_m(pose).mean(axis=0)))
            told = _told(unit, "board", middle_m, albedo=0.8)
            told = Conditions(**{**vars(told), "distance_m": math.nan})  # nobody measures that
            found.append(Take(_name("board", len(found)), told, pose=pose))
    return found[: plan.boards]
