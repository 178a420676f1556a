"""Frames that others rendered (Su et al., CVPR 2018), 40 and 70 MHz, truth without multipath."""

import numpy as np
from correction_frames import SU_HINTS, by_method, limits, means, score, scored, su_frames, unsuited
from correction_methods import number, sentences, table

from toftools.bench.references import REFERENCES
from toftools.phasor import phasors_of

MISSING = "Left out: no su2018_synth_40_70MHz in TOFTOOLS_DATA."
ORACLES = (("oracle_wrap", {"freq_index": 0}), ("oracle_wrap", {"freq_index": 1}))


def references(captures):
    """What somebody published, and each frequency with the wrap count taken from the truth."""
    rows = []
    for name, capture in captures.items():
        freqs = capture.sensor.modulation.freqs_hz
        asked = [(f"{f / 1e6:g} MHz, wraps from the truth", "oracle_wrap", {"freq_index": i})
                 for i, f in enumerate(freqs)]  # fmt: skip
        asked += [(f"{label}, as published", "reported", {"name": label})
                  for label in capture.reported]  # fmt: skip
        for label, reference, params in asked:
            depth = REFERENCES[reference].build(capture, **params)(phasors_of(capture))
            figures = score(depth.range_m, capture.truth.range_m, limits(capture))
            rows.append({"capture": name, "method": label, **figures})
    return rows


def measure(job):
    captures = su_frames(job)
    if not captures:
        return {"missing": MISSING}
    rows = scored(job, captures, **SU_HINTS)
    return {"rows": rows, "references": references(captures)}


def write(result, folder):
    """Markdown table, the best mean first."""
    if "missing" in result:
        return result["missing"]
    lines = []
    for label, rows in by_method(result["references"]).items():
        lines.append((means(rows, "mae_m"), f"*{label}*", rows))
    for label, rows in by_method(result["rows"]).items():
        lines.append((means(rows, "mae_m"), f"`{label}`", rows))
    lines.sort(key=lambda line: np.inf if np.isnan(line[0]) else line[0])
    body = []
    for mean, label, rows in lines:
        timed = "ms_frame" in rows[0]
        body.append([
            label, number(mean, ".2f", 100), each(rows, "mae_m", 100), each(rows, "median_m", 100),
            each(rows, "wraps", 100), number(means(rows, "valid"), ".1f", 100),
            number(means(rows, "ms_frame"), ".3g") if timed else "–",
            pixels(rows) if timed else "all",
        ])  # fmt: skip
    head = ["method", "mean MAE cm", "MAE cm, frames", "median cm", "off by > 0.5 m, %",
            "valid %", "ms per 320 x 240", "pixels"]  # fmt: skip
    text = (
        "Frames of S. Su et al., CVPR 2018 (MIT licence); truth between 0.1 and 9.9 m. The methods "
        "know that the scenes end within 10 m, if they ask, and that amplitudes have no scale. "
        "In italics what no method can have: the true wrap count, or somebody's network."
    )
    parts = [text, table(head, body)]
    refused = unsuited(result["rows"])
    parts.append(sentences(refused))
    return "\n\n".join(filter(None, parts))


def each(rows, key, factor):
    return " / ".join(number(row[key], ".2f", factor) for row in rows)


def pixels(rows):
    """Which share of the pixels a method was given."""
    most = max(row["stride"] for row in rows)
    return "all" if most == 1 else f"1 in {most**2}"
