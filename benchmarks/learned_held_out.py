"""Held-out scenes: errors of the raw range, of physics and of networks, by family and by albedo."""

import time

import numpy as np
from learned_frames import at, captures, errors_of, figures

from toftools.correct._net_file import read_card
from toftools.registry import CORRECTIONS, find
from toftools.units import ambiguity_m, joint_ambiguity_m

ONE = (20e6,)
TWO = (40e6, 70e6)
EDGES_M = np.concatenate([[0], np.geomspace(1e-3, 10, 81)])
"""Of the histograms of absolute errors."""


PHYSICS = (
    ("raw", "crt", (ONE, TWO)), ("semi_global", "semi_global", (TWO,)),
    ("fuchs2010", "fuchs2010", (ONE, TWO)), ("auto", "auto", (ONE, TWO)),
)  # fmt: skip


def methods(networks, physics=None):
    """Label, method and frequencies: physics, all or some of it, and the networks of a folder."""
    found = [
        (f"{label}, {' + '.join(f'{freq / 1e6:g}' for freq in freqs)} MHz", name, freqs)
        for freqs in (ONE, TWO) for label, name, sets in PHYSICS
        if freqs in sets and (physics is None or name in physics)
    ]  # fmt: skip
    for path in sorted(networks.glob("*.onnx")):
        found.append((path.stem, f"network:model={path}", read_card(path)[0].freqs_hz))
    return found


def measure(folder, split, networks, log, key="family", families=None, physics=None):
    """Errors per method and group, and milliseconds per frame."""
    asked, sums = methods(networks, physics), {}
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
            error = errors_of(depth.range_m, capture.truth.range_m, float(longest))
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
