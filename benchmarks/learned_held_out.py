"""Held-out scenes: errors of the raw range, of physics and of networks, by family and by albedo."""

import time

import numpy as np
from learned_frames import at, captures, errors_of, figures

from toftools.registry import CORRECTIONS, find
from toftools.units import ambiguity_m, joint_ambiguity_m

ONE = (20e6,)
TWO = (40e6, 70e6)
EDGES_M = np.concatenate([[0], np.geomspace(1e-3, 10, 81)])
"""Of the histograms of absolute errors."""


def methods(networks):
    """Label, method and frequencies; networks of the folder where they are there."""
    found = [
        ("raw, 20 MHz", "crt", ONE),
        ("fuchs2010, 20 MHz", "fuchs2010", ONE),
        ("raw, 40 + 70 MHz", "crt", TWO),
        ("semi_global, 40 + 70 MHz", "semi_global", TWO),
        ("fuchs2010, 40 + 70 MHz", "fuchs2010", TWO),
        ("auto, 40 + 70 MHz", "auto", TWO),
    ]
    for path in sorted(networks.glob("*.onnx")):
        freqs = TWO if "40_70" in path.stem else ONE
        found.append((path.stem, f"network:model={path}", freqs))
    return found


def measure(folder, split, networks, log, key="family", families=None):
    """Errors per method and group, and milliseconds per frame."""
    asked, sums = methods(networks), {}
    built = {}
    for number, (entry, capture) in enumerate(captures(folder, split, families)):
        log(f"held out: {number + 1}, {entry['scene']}")
        for label, name, freqs in asked:
            sensor, phasors = at(capture, freqs)
            longest = (
                ambiguity_m(freqs[0]) if len(freqs) == 1 else joint_ambiguity_m(np.array(freqs))
            )
            where = (label, entry["sensor"])
            if where not in built:
                built[where] = find(CORRECTIONS, name).build(sensor)
                built[where](phasors)
            begin = time.perf_counter()
            depth = built[where](phasors)
            ms = 1e3 * (time.perf_counter() - begin)
            error = errors_of(depth, capture.truth.range_m, float(longest))
            group = key(entry) if callable(key) else entry[key]
            sums.setdefault(label, {}).setdefault(group, []).append((error, ms))
    return {label: _told(groups) for label, groups in sums.items()}


def _told(groups):
    every = [pair for pairs in groups.values() for pair in pairs]
    whole = np.concatenate([error for error, _ in every])
    given = whole[np.isfinite(whole)]
    return {
        **figures(whole), "captures": len(every), "ms": float(np.median([ms for _, ms in every])),
        "histogram": np.histogram(np.clip(given, 0, 9.99), EDGES_M)[0].tolist(),
        "groups": {str(group): figures(np.concatenate([e for e, _ in pairs]))
                   for group, pairs in sorted(groups.items())},
    }  # fmt: skip
