"""Shots of the path engine for tests, their statistics, and the record that the proofs table reads.

A proof compares a mean over independent seeds with what it should be. Its standard error comes
from the spread over the seeds, so that it stays honest whatever neighbouring pixels share.
"""

import os
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toftools._native import import_mitsuba
from toftools.camera import rays
from toftools.sensors import sensor
from toftools.sim.path import path
from toftools.sim.stage import load
from toftools.types import Emitter, Scene, Shot

THOROUGH = os.environ.get("TOFTOOLS_PROOFS") == "thorough"
"""Whether the costly proofs take as many seeds as their relative limit needs; benchmarks/proofs.py
says so."""
FREQS_HZ = (20e6, 50e6, 100e6)
SIGMAS = 3.0
DARK = Emitter(strength=1e-12)  # a sensor must have a source: where lamps alone are to shine
ROUNDING = 2e-6  # of complex64 phasors, float32 taps and single-precision path lengths of metres


class Mean(NamedTuple):
    """Mean over seeds, and its standard error (of the modulus, where complex)."""

    value: np.ndarray
    error: np.ndarray


def ideal(width=8, height=6, freqs=FREQS_HZ, *, more="", **fields):
    """Sensor whose noise-free phasors are those of the light: contrast and signal 1."""
    listed = "+".join(f"{f:.12g}" for f in freqs)
    text = f"deeptof:width={width},height={height},freqs={listed},contrast=1,signal_e=1{more}"
    return replace(sensor(text), **fields)


def shots(scene, device, seeds, **fields):
    """Noise-free captures of a scene name, `Scene` or world, one per seed."""
    scene = Scene(scene) if isinstance(scene, str) else scene
    run = path(scene)
    return [run(Shot(device, seed=seed, noisy=False, **fields)) for seed in seeds]


def averaged(values):
    """Mean over the first axis, seeds, with its standard error."""
    values = np.asarray(values)
    if np.iscomplexobj(values):
        spread = np.sqrt(values.real.var(axis=0, ddof=1) + values.imag.var(axis=0, ddof=1))
    else:
        spread = values.std(axis=0, ddof=1)
    return Mean(values.mean(axis=0), spread / np.sqrt(len(values)))


def phasors(captures):
    """Phasors (S, F, H, W) of captures, float64."""
    return np.array([c.phasors.values for c in captures], np.complex128)


def offset(captures):
    """Mean charge of the taps (S, H, W): the light at 0 Hz, lamps and ambient light included."""
    return np.array([c.taps.values.astype(np.float64).mean(axis=(0, 1)) for c in captures])


def prove(record, scene, what, mean, expected, *, sigmas=SIGMAS, within=None, rounding=ROUNDING):
    """Assert that a mean is what it should be, and record the figures.

    `within` is a limit on the relative error beside the one in standard errors, asserted where
    there are paths enough to tell: where three standard errors are below it.
    """
    value, expected = np.asarray(mean.value), np.asarray(expected)
    off, size = np.abs(value - expected), np.abs(expected)
    room = rounding * size.max()
    allowed = sigmas * np.asarray(mean.error) + room
    worst = np.unravel_index(np.argmax(off / np.maximum(allowed, 1e-300)), off.shape)
    figures = {
        "scene": scene,
        "what": what,
        "count": int(off.size),
        "expected": complex(expected[worst]) if expected.shape == off.shape else complex(expected),
        "measured": complex(value[worst]),
        "error": float(np.asarray(mean.error)[worst]),
        "sigmas": float((off / np.maximum(mean.error + room, 1e-300)).max()),
        "relative": float((off / np.maximum(size, 1e-300)).max()),
        "allowed": sigmas,
        "limit": within,
    }
    record("proof", figures)
    assert (off <= allowed).all(), figures
    if within is not None:
        enough = (sigmas * np.asarray(mean.error) <= within * size).all()
        assert enough or not THOROUGH, "too few seeds to tell"
        assert not enough or (off <= within * size).all(), figures


def fact(record, scene, what, wanted, found):
    """Record a figure that a test has checked in a way of its own; all are words."""
    record("fact", {"scene": scene, "what": what, "wanted": wanted, "found": found})


def steady(world, camera, seeds, *, paths, depth):
    """Pictures (S, H, W) of Mitsuba's own `path` integrator along the rays of a camera."""
    mi, stage = import_mitsuba(), load(world)
    tracer = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1 << 20})
    away = np.repeat(rays(camera).reshape(-1, 3), paths, axis=0) @ stage.to_world[:3, :3].T
    ray = mi.RayDifferential3f(
        mi.Point3f(*map(float, stage.to_world[:3, 3])),
        mi.Vector3f(np.ascontiguousarray(away.T, dtype=np.float32)),
    )
    found = []
    for seed in seeds:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, len(away))
        radiance = np.asarray(tracer.sample(stage.scene, sampler, ray)[0][0], np.float64)
        found.append(radiance.reshape(*camera.shape, paths).mean(axis=-1))
    return np.array(found)


def agree(record, scene, what, ours, theirs, *, sigmas=7):
    """Two ways' pictures (S, ..., H, W) agree in every pixel and in the mean.

    In every pixel, with 8 seeds each, errors are those of Student's t with 14 degrees of freedom:
    beyond 7 in 1 of 10^5.
    """
    for which, one, other, limit in (
        ("every pixel", averaged(ours), averaged(theirs), sigmas),
        ("mean", averaged(ours.mean(axis=(-2, -1))), averaged(theirs.mean(axis=(-2, -1))), SIGMAS),
    ):
        both = Mean(one.value, np.hypot(one.error, other.error))
        prove(record, scene, f"{what}, {which}", both, other.value, sigmas=limit)
