"""Two planted returns: every method against the bound of two returns, and where it breaks.

Model: z_f = A (exp(j phi_f(d)) + ratio exp(j phi_f(d + separation))), shot and read noise of the
sensor on its taps. The first return lies 1.5 to 2.5 m away, a ramp over the frame, so that errors
average over the wrapped phase and neighbours stay neighbours. Methods know that the scene ends at
`END_M`, if they ask. Light: `SIGNAL_E` electrons per tap from white at 1 m, albedo 0.5.
"""

from dataclasses import replace

import numpy as np
from correction_methods import (
    built,
    failure,
    methods,
    number,
    plain,
    sentences,
    table,
    timed,
)

from toftools.crlb import crlb_returns_m
from toftools.phasor import demodulate
from toftools.sensors import sensor as preset
from toftools.sim.noise import capture_taps
from toftools.units import range_to_phase

SENSORS = {
    "opt8241": "opt8241",
    "kinect2_nominal": "kinect2_nominal",
    "equispaced": "deeptof:freqs=20e6+40e6+60e6+80e6+100e6",
}
# For methods that suit none of these: the first that suits one.
MADE_FOR = {
    "octave": "deeptof:freqs=40e6+80e6",
    "four_equispaced": "deeptof:freqs=20e6+40e6+60e6+80e6",
    "phasor_imaging": "phasor_imaging",
    "heide2013": "heide2013",
}
BESIDE = ("crt", "auto")
SEPARATIONS_M = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
RATIOS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
WATCHED = 0.3  # ratio at which the breaking point is told
SIZE = (24, 32)
NEAR_M, FAR_M, END_M = 1.5, 2.5, 7.0
SIGNAL_E = 100_000.0
OUTLIER_M = 0.5
USEFUL_M = 0.05
NORMAL_MEDIAN = 0.6745  # median absolute value of a unit normal
BUDGET_S, MOST_S, CALL_S = 4.0, 40.0, 0.1
COARSE_PIXELS = 48


def camera_of(text, size):
    """The sensor with as many pixels, at the light of this experiment."""
    comma = "," if ":" in text else ":"
    found = preset(f"{text}{comma}width={size[1]},height={size[0]}")
    return replace(found, noise=replace(found.noise, signal_e=SIGNAL_E))


def shoot(sensor, separation_m, ratio, seed):
    """Truth (H, W) and noisy phasors of one cell."""
    height, width = sensor.camera.shape
    steps = np.linspace(NEAR_M, FAR_M, height * width, endpoint=False)
    range_m = steps.reshape(height, width)
    charge = SIGNAL_E * 0.5 / (0.5 * (NEAR_M + FAR_M)) ** 2

    def light(freq_hz):
        first = np.exp(1j * range_to_phase(range_m, freq_hz))
        return charge * first * (1 + ratio * np.exp(1j * range_to_phase(separation_m, freq_hz)))

    return range_m, demodulate(capture_taps(light, 0.0, sensor, seed=seed), sensor), charge


def bound_m(sensor, phasors, charge, separation_m, ratio):
    """Least standard deviation of the first return; it does not depend on the range."""
    contrast = np.mean(sensor.noise.contrast)
    sigma = np.median(phasors.sigma, axis=(1, 2))
    freqs = sensor.modulation.freqs_hz
    if ratio == 0:
        return float(crlb_returns_m(freqs, [2.0], [contrast * charge], sigma)[0])
    ends, strength = [2.0, 2.0 + separation_m], contrast * charge * np.array([1.0, ratio])
    return float(crlb_returns_m(freqs, ends, strength, sigma)[0])


def statistics(truth, depth):
    """Robust error, share of outliers, and how large errors are in units of their sigma."""
    error = np.abs(depth.range_m - truth)
    given = np.isfinite(error)
    if not given.any():
        return {"error_m": np.nan, "outliers": np.nan, "spread": np.nan, "valid": 0.0}
    spread = np.nan
    if depth.sigma_m is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            scaled = (error / depth.sigma_m)[given]
        # 68.3 % of honest errors are below one sigma; outliers do not move this quantile.
        known = scaled[np.isfinite(scaled)]
        spread = float(np.quantile(known, 0.6827)) if known.size else np.nan
    return {
        "error_m": float(np.median(error[given]) / NORMAL_MEDIAN),
        "outliers": float((error[given] > OUTLIER_M).mean()),
        "spread": spread,
        "valid": float(given.mean()),
    }


def cells(quick):
    """(separation, ratio) of every cell by its place in the map; row 0 holds lone returns."""
    separations, ratios = (SEPARATIONS_M[1::3], (0.3,)) if quick else (SEPARATIONS_M, RATIOS)
    grid = {(i + 1, j): (s, r) for i, r in enumerate(ratios) for j, s in enumerate(separations)}
    return separations, ratios, {(0, 0): (1.0, 0.0), **grid}


def plan_of(run, sensor, frame, n_cells):
    """Rows of the frame that a cell may have, whether every second cell must do, ms a pixel."""
    few = sliced(frame, 1, 8)
    _, ms = timed(run, few, repeats=2)
    ms_pixel = ms / 8
    if ms < 1e3 * CALL_S:  # mostly the call itself: only more pixels tell
        ms_pixel = timed(run, sliced(frame, 4, 32), repeats=2)[1] / 128
    affordable = 1e3 * BUDGET_S / n_cells / ms_pixel
    if affordable >= COARSE_PIXELS:
        return min(max(int(affordable) // SIZE[1], 2), sensor.camera.shape[0]), False, ms_pixel
    return 2, True, ms_pixel


def sliced(frame, rows, columns):
    """Pixels of some rows, evenly spread, as a frame."""
    height, width = frame.valid.shape
    pick = np.ix_(np.linspace(0, height - 1, rows).astype(int),
                  np.linspace(0, width - 1, columns).astype(int))  # fmt: skip
    cut = (slice(None), *pick)
    return type(frame)(frame.values[cut], frame.sigma[cut], frame.valid[pick])


def one_method(job, method, sensor, frames, shape):
    """Maps (ratios + 1, separations) of one method, or a sentence."""
    run = built(job, method, sensor)
    if isinstance(run, str):
        return run
    info = run(frames[0, 0][1]).info
    if "indirect" in info and "model" not in info:
        return "models light between the surfaces it sees, and planted returns come from none"
    truth, frame = frames[0, 0]
    rows, coarse, ms_pixel = plan_of(run, sensor, frame, len(frames))
    if coarse and len(frames) / 4 * COARSE_PIXELS * ms_pixel > 1e3 * MOST_S:
        return f"takes {ms_pixel:.3g} ms a pixel: left out"
    maps = {key: np.full(shape, np.nan) for key in ("error_m", "outliers", "spread", "valid")}
    pixels, ms = 0, 0.0
    for (i, j), (truth, frame) in frames.items():
        if coarse and i and (i % 2 or j % 2):
            continue
        whole = rows == sensor.camera.shape[0]
        seen = (
            frame if whole else sliced(frame, rows, SIZE[1] if not coarse else COARSE_PIXELS // 2)
        )
        wanted = truth if whole else sliced_truth(truth, seen.valid.shape)
        depth, spent = timed(run, seen, repeats=1)
        pixels, ms = pixels + wanted.size, ms + spent
        for key, value in statistics(wanted, depth).items():
            maps[key][(i, j) if i else (0, slice(None))] = value
    return {**maps, "pixels": wanted.size, "us_pixel": 1e3 * ms / pixels, "coarse": coarse}


def sliced_truth(truth, shape):
    """The truth where `sliced` looked."""
    height, width = truth.shape
    return truth[np.ix_(np.linspace(0, height - 1, shape[0]).astype(int),
                        np.linspace(0, width - 1, shape[1]).astype(int))]  # fmt: skip


def measure(job):
    """The sensors everybody has, then those that the methods left over were made for."""
    separations, ratios, grid = cells(job.quick)
    found, left = {}, {method.name for method in methods(job)}
    for name, text in list(SENSORS.items())[: 1 if job.quick else None]:
        found[name] = one_sensor(job, text, grid, (len(ratios) + 1, len(separations)))
        left -= {shown.partition(":")[0] for shown in found[name]["methods"]}
    for name, text in () if job.quick else MADE_FOR.items():
        if not suits(job, left, text):
            continue
        asked = {*left, *BESIDE}
        entry = one_sensor(job, text, grid, (len(ratios) + 1, len(separations)), asked)
        suited = left & {shown.partition(":")[0] for shown in entry["methods"]}
        if suited:
            found[name] = {**entry, "unsuited": {}}
        left -= suited
    return plain({"separations_m": separations, "ratios": ratios, "sensors": found,
                  "left": sorted(left)})  # fmt: skip


def suits(job, names, text):
    """Whether any of these methods can be made for the sensor."""
    sensor = camera_of(text, SIZE)
    asked = [m for m in methods(job, max_range_m=END_M) if m.name in names]
    return any(not isinstance(built(job, m, sensor), str) for m in asked)


def one_sensor(job, text, grid, shape, names=None):
    """Bound and maps of the methods; `names` limits which."""
    sensor = camera_of(text, (6, 8) if job.quick else SIZE)
    frames, bound = {}, np.full(shape, np.nan)
    for seed, (place, (separation, ratio)) in enumerate(grid.items()):
        truth, frame, charge = shoot(sensor, separation, ratio, seed)
        frames[place] = truth, frame
        at = place if place[0] else (0, slice(None))
        bound[at] = bound_m(sensor, frame, charge, separation, ratio)
    kept, refused = {}, {}
    for method in methods(job, max_range_m=END_M):
        if names is not None and method.name not in names:
            continue
        job.log(f"planted, {text}: {method.label}")
        try:
            maps = one_method(job, method, sensor, frames, shape)
        except Exception as error:  # a result of this benchmark
            maps = failure(job, method, error)
        (refused if isinstance(maps, str) else kept)[method.label] = maps
    return {"sensor": text, "bound_m": bound, "methods": kept, "unsuited": refused}


def breaking_m(result, bound, maps):
    """From which separation on, ratio `WATCHED`, the median error stays below twice the bound."""
    row = result["ratios"].index(WATCHED) + 1
    error = NORMAL_MEDIAN * np.array(maps["error_m"], float)[row]
    seen = np.flatnonzero(np.isfinite(error))
    bad = [k for k in seen if error[k] >= 2 * bound[row, k]]
    good = [k for k in seen if not bad or k > bad[-1]]
    return result["separations_m"][good[0]] if good else None


def share_at_bound(bound, maps):
    """Share of the cells with a useful bound whose median error is below twice that bound."""
    error = NORMAL_MEDIAN * np.array(maps["error_m"], float)[1:]
    useful = np.isfinite(error) & (bound[1:] < USEFUL_M)
    return (error < 2 * bound[1:])[useful].mean() if useful.any() else None


def rows_of(result, entry):
    """Lines of the table of one sensor."""
    bound = np.array(entry["bound_m"], float)
    watched = result["ratios"].index(WATCHED) + 1
    column = int(np.argmin(np.abs(np.array(result["separations_m"]) - 1.0)))
    lines = []
    for label, maps in entry["methods"].items():
        error, out, spread = (np.array(maps[k], float) for k in ("error_m", "outliers", "spread"))
        near = column if np.isfinite(error[watched, column]) else column + 1 - 2 * (column % 2)
        near = min(near, error.shape[1] - 1)
        lines.append([
            f"`{label}`", number(error[0, 0], ".2f", 1e3), number(bound[0, 0] / error[0, 0]),
            number(spread[0, 0]), number(out[0, 0], ".1f", 100),
            number(error[watched, near], ".1f", 1e3), number(out[watched, near], ".1f", 100),
            number(np.nanmedian(spread[watched:]) if np.isfinite(spread[watched:]).any() else None),
            number(share_at_bound(bound, maps), ".0f", 100),
            number(breaking_m(result, bound, maps), "g"), number(maps["us_pixel"], ".3g"),
        ])  # fmt: skip
    return lines


HEAD = ["method", "lone: rms mm", "bound / rms", "error / sigma", "outliers %",
        "two, 1 m, 0.3: rms mm", "outliers %", "error / sigma", "cells at the bound %",
        "holds from, m", "us per pixel"]  # fmt: skip


def write(result, folder):
    """Markdown of the section; pictures into the folder."""
    from correction_draw import planted_figure

    parts = [
        f"Second return at every separation and ratio (to the first), {SIZE[0] * SIZE[1]} pixels a "
        f"cell, first return {NEAR_M} to {FAR_M} m away, {SIGNAL_E / 1e3:g} ke- per tap from white "
        f"at 1 m, albedo 0.5, shot and read noise of the sensor; methods that take it know "
        f"`max_range_m={END_M:g}`. *rms* is robust: median error / 0.6745. *Cells at the bound*: "
        f"share of those with a bound of two returns below {1e2 * USEFUL_M:g} cm whose median "
        f"error is below twice that. *Holds from*: the separation at ratio {WATCHED} from which on "
        "that is so at every larger one. Where the bound is large, a biased answer can beat it, "
        "for it is one of unbiased answers: efficiencies above 1 are shown as 1. "
        "*error / sigma* is the 68.3 % quantile; 1 is honest (with two returns: the median over "
        f"all separations at ratios of {WATCHED} and more). Outliers are off by more than "
        f"{OUTLIER_M} m. Slow methods ran on fewer pixels, or on every second cell.",
    ]
    for name, entry in result["sensors"].items():
        planted_figure(result, entry, name, folder / f"planted_{name}")
        parts.append(f"### {name} (`{entry['sensor']}`)")
        parts.append(table(HEAD, rows_of(result, entry)))
        parts.append(f"![Error and efficiency, {name}](planted_{name}.png)")
        parts.append(sentences(entry["unsuited"]))
    if result["left"]:
        parts.append(f"On none of these sensors: {', '.join(result['left'])}.")
    return "\n\n".join(filter(None, parts))
