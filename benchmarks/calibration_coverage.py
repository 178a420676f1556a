"""Are the intervals honest? Many virtual cameras, each fitted; how often the truth lies inside.

Per seed: another unit (patterns, offsets), other noise, board poses and check set. The lens is
fitted at 320x240 (section `lens` of the benchmark), so here its truth is given: 32x24 pixels show
no board. Stages are fitted one after another and then refined together, as `calibrate all` does.
"""

from dataclasses import replace

import numpy as np
from calibration_truth import cyclic, surface
from calibration_workers import workers
from scipy.stats import t

from toftools.calib._phase_surface import design
from toftools.calib.chain import chain_for, extended
from toftools.calib.fit import fit_stage
from toftools.calib.refine import refine
from toftools.conditions import conditions_of
from toftools.sensors import sensor
from toftools.sim._rig_unit import unit_of
from toftools.sim.rig import PLANS, Errors, rig

SENSOR = "opt8241:width=32,height=24"
SLOTS = ("response", "wiggling", "common_phase", "fixed_pattern", "amplitude", "temperature")
FRAMES = 16
PLAN = replace(
    PLANS["full"], boards=0, check=0, rail=41,
    gray_m=(0.6, 1.0, 1.4, 1.85, 2.3, 2.8, 3.3, 3.7),
)  # fmt: skip
NORMAL = 1.96
LEVELS = (0.3, 0.5, 2.0, 3.0)
"""Amplitudes at which the surface is compared, times the reference."""
PHASES = 32


def calibrated(device, errors, seed, *, joint=True, plan=PLAN):
    """A chain of a camera whose optics are known."""
    true = unit_of(errors, device).sensor.camera
    captures = [
        replace(capture, sensor=replace(capture.sensor, camera=true))
        for _, capture in rig(device, errors, plan=plan, seed=seed, frames=FRAMES)
    ]
    chain = chain_for(captures[0].sensor)
    for slot in SLOTS:
        mine = [c for c in captures if conditions_of(c).kind in NEEDED[slot]]
        chain = extended(chain, fit_stage(chain, slot, slot, mine))
    return refine(chain, captures) if joint else chain


NEEDED = {
    "response": ("dark", "flat"),
    "wiggling": ("delay",),
    "common_phase": ("wall",),
    "fixed_pattern": ("wall",),
    "amplitude": ("gray", "wall"),
    "temperature": ("warmup", "wall"),
}


def one(seed, joint=True):
    """Name of every coefficient to its distance from the truth in half intervals."""
    device, errors = sensor(SENSOR), Errors(unit=seed)
    chain = calibrated(device, errors, seed, joint=joint)
    camera, out = unit_of(errors, device), {}
    wave, bend = chain.stage("wiggling"), chain.stage("amplitude")
    common, drift = chain.stage("common_phase"), chain.stage("temperature")
    wide = float(t.ppf(0.975, max(wave.dof, 1)))
    for f, freq in enumerate(device.modulation.freqs_hz):
        mhz = f"{freq / 1e6:g} MHz"
        reference = bend.reference_amplitude[f]
        cos, sin, mean = cyclic(camera, f, reference)
        for order in range(wave.harmonics[f]):
            for name, truth in (("cos", cos), ("sin", sin)):
                got = getattr(wave, f"{name}_rad")[f, order] - truth[order]
                half = wide * getattr(wave, f"{name}_sd_rad")[f, order]
                out[f"wiggling {name} {order + 1}, {mhz}"] = got / half
        constant = common.phase_rad[f] - mean - camera.sensor.maps.phase_rad[f].mean()
        out[f"common phase, {mhz}"] = constant / (NORMAL * common.sigma_rad[f])
        for k, name in enumerate(("sensor", "light")):
            if f"{name}_c" in drift.needs:
                truth = getattr(camera, f"{name}_rad_per_k")[f]
                half = NORMAL * drift.sigma_rad_per_k[f, k]
                out[f"drift {name}, {mhz}"] = (drift.slope_rad_per_k[f, k] - truth) / half
        out |= surfaces(camera, bend, f, mhz)
        out[f"pixels, {mhz}"] = pixels(camera, chain.stage("fixed_pattern"), f)
    return out


def surfaces(camera, bend, f, mhz):
    """The amplitude error's mean over phase (planted: a x + b x^2) and its cosine (c x)."""
    reference, out = bend.reference_amplitude[f], {}
    shape = bend.knot_rad.shape[1:]
    phi = np.arange(PHASES) * (2 * np.pi / PHASES)
    knots, covariance = bend.knot_rad[f].ravel(), bend.covariance_rad2[f]
    for level in LEVELS:
        seen, truth = surface(camera, f, reference, level * reference, phi)
        rows = design(np.full(PHASES, level * reference), seen, bend.span[f], shape)
        for name, weights in (("mean", np.ones(PHASES) / PHASES),
                              ("cosine", 2 * np.cos(phi) / PHASES)):  # fmt: skip
            along = weights @ rows
            half = NORMAL * np.sqrt(max(along @ covariance @ along, 0.0))
            if half > 1e-9:
                out[f"amplitude x {level:g}, {name}, {mhz}"] = (
                    along @ knots - weights @ truth
                ) / half
    return out


def pixels(camera, stage, f):
    """Share of the pixels whose planted offset lies inside its interval."""
    truth = camera.sensor.maps.phase_rad[f]
    off = stage.map_rad[f] - (truth - truth.mean())
    known = np.isfinite(off)
    return float((np.abs(off[known]) < NORMAL * stage.sigma_rad[f][known]).mean())


def table(results):
    """Per coefficient: share of seeds with the truth inside, and the spread of what is off."""
    names = list(dict.fromkeys(name for result in results for name in result))
    rows = []
    for name in names:
        values = np.array([result[name] for result in results if name in result])
        if name.startswith("pixels"):
            rows.append((name, float(values.mean()), float("nan"), float("nan"), len(values)))
        else:
            inside = float((np.abs(values) < 1).mean())
            rows.append((name, inside, float(values.mean() * NORMAL), float(values.std() * NORMAL),
                         len(values)))  # fmt: skip
    return rows


def run(seeds, joint=True):
    with workers() as pool:
        return table(list(pool.map(one, range(seeds), [joint] * seeds)))
