"""Captures with truth, and every method on them: shared by the sections su, auto and speed."""

import os
from pathlib import Path

import numpy as np
from correction_methods import Answer, answer, methods

import toftools.bench
from toftools.io.open import open_capture
from toftools.phasor import phasors_of

NEAR_M, FAR_M = 0.1, 9.9
WRAP_M = 0.5
END_M = 10.0  # all these scenes end before
HINTS = {"max_range_m": END_M}
SU_HINTS = {**HINTS, "albedo_gain": 0.0}  # their amplitudes have no scale
FIRST = Path(toftools.bench.__file__).parent / "suites" / "first"


def data_folder():
    """Captures of others, or None."""
    text = os.environ.get("TOFTOOLS_DATA", "")
    return Path(text) if text and Path(text).is_dir() else None


def su_frames(job):
    """The three rendered frames of Su et al. by name."""
    folder = data_folder()
    files = sorted((folder / "su2018_synth_40_70MHz").glob("im_pair_*.mat")) if folder else []
    return {f"Su {f.stem[-1]}": open_capture(f) for f in files[: 1 if job.quick else None]}


def first_set(job):
    """Our own first set: small rendered captures with taps and noise."""
    files = sorted(FIRST.glob("*.h5"))
    return {f.stem: open_capture(f) for f in files[: 1 if job.quick else None]}


def limits(capture):
    """Pixels that count."""
    truth = capture.truth.range_m
    with np.errstate(invalid="ignore"):
        return (truth > NEAR_M) & (truth < FAR_M) & phasors_of(capture).valid


def score(range_m, truth, mask):
    """Error figures of an answer."""
    error = np.abs(range_m.astype(float) - truth)[mask]
    given = np.isfinite(error)
    if not given.any():
        return {"mae_m": np.nan, "median_m": np.nan, "wraps": np.nan, "valid": 0.0}
    return {
        "mae_m": error[given].mean(),
        "median_m": np.median(error[given]),
        "wraps": (error[given] > WRAP_M).mean(),
        "valid": given.mean(),
    }


def scored(job, captures, *, grid=False, budget_s=1.0, **hints):
    """Rows: one per capture and method; kept, since several sections ask for the same."""
    key = ("scored", tuple(captures), grid, tuple(sorted(hints.items())))
    if key in job.made:
        return job.made[key]
    rows = []
    asked = methods(job, grid=grid, **hints)
    for name, capture in captures.items():
        job.log(f"{name}: {len(asked)} settings")
        phasors, mask = phasors_of(capture), limits(capture)
        for method in asked:
            found = answer(job, method, capture.sensor, phasors, budget_s=budget_s)
            row = {"capture": name, "method": method.label, "name": method.name}
            if isinstance(found, Answer):
                s = found.stride
                cut = (slice(None, None, s),) * 2
                figures = score(found.depth.range_m, capture.truth.range_m[cut], mask[cut])
                row |= {**figures, "ms_frame": found.ms_frame, "stride": s}
            else:
                row["unsuited"] = found
            rows.append(row)
    job.made[key] = rows
    return rows


def unsuited(rows):
    """Methods none of whose settings answered on any capture, with their sentence."""
    answered = {row["name"] for row in rows if "mae_m" in row}
    found = {}
    for row in rows:
        if row["name"] not in answered:
            found.setdefault(row["name"], row["unsuited"])
    return found


def by_method(rows):
    """Rows of each method that answered, in order."""
    found = {}
    for row in rows:
        if "mae_m" in row:
            found.setdefault(row["method"], []).append(row)
    return found


def means(rows, key):
    """Mean of a figure over captures; NaN where one has no answer."""
    values = [row[key] for row in rows]
    return np.nan if any(v is None for v in values) else float(np.mean(values))
