"""Ours and its peers side by side, in one run: one table of errors and milliseconds.

pip install -c constraints.txt -e '.[peers]'     what is not installed is left out, and said
python benchmarks/side_by_side.py --out DIR [--quick]    or: make peers
    writes DIR/index.md, DIR/results.json, and the files of unwrapping_peers.py

Contestants of a task take turns in one process, in one thread each (light transport: a process and
all threads each), and the least time of many calls counts, so that other work on the machine is
least in it.
"""

import argparse
import json
import os
import sys
import time
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import unwrapping_peers
from peers.rows import light_between_patches, light_transport, sparse_reflections, unwrapping

from toftools.bench.machine import machine, versions
from toftools.bench.render import number

PACKAGES = ("scipy", "scikit-image", "opencv-contrib-python-headless", "mitsuba", "mitransient")
HEAD = ("task", "ours", "error", "ms", "peer", "error", "ms", "peer / ours in ms")


def measured(folder, *, quick, log):
    """Rows of all tasks, and sentences about what is not installed."""
    unwrapped = unwrapping_peers.run(quick=quick, log=log)
    unwrapping_peers.write(unwrapped, folder)
    rows, missing = [], []
    tasks = {
        "light transport": lambda: light_transport(quick=quick, log=log),
        "unwrapping": lambda: unwrapping(unwrapped),
        "sparse reflections": lambda: sparse_reflections(quick=quick),
        "light between patches": lambda: light_between_patches(quick=quick),
    }
    for name, task in tasks.items():
        log(name)
        mine, left_out = task()
        rows += mine
        missing += left_out
    return rows, missing


def installed():
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def ms(value):
    return f"{value:,.0f}" if value >= 100 else f"{value:.2f}"


def ratio(row):
    """How many times our time the peer takes: at equal error where that is known."""
    if row["equal_error_ms"] is not None:
        return f"{row['equal_error_ms'] / row['our_ms']:.3g} at our error"
    return f"{row['peer_ms'] / row['our_ms']:.3g}"


def page(about, rows):
    names = ", ".join(f"{k} {v}" for k, v in about["versions"].items())
    cpu = about["machine"]
    lines = [f"| {' | '.join(HEAD)} |", f"|---|---|---:|---:|---|---:|---:|{'---:'}|"]
    for row in rows:
        lines.append(
            f"| {row['task']} | {row['ours']} | {number(row['our_error'], 1, '.2f')} "
            f"{row['error']} | {ms(row['our_ms'])} | {row['peer']} | "
            f"{number(row['peer_error'], 1, '.2f')} {row['error']} | {ms(row['peer_ms'])} | "
            f"{ratio(row)} |"
        )
    notes = [f"- {row['task']}, {row['ours']} and {row['peer']}: ms per {row['per']}"
             + (f"; {row['note']}" if row["note"] else "") + "." for row in rows]  # fmt: skip
    parts = [
        "# Side by side with peers",
        "Made by `python benchmarks/side_by_side.py`; do not edit. Every pair of a row was "
        "measured in one run, by turns and on the same input; the least time of many calls counts, "
        "since the machine had other work. One thread each, but for light transport.",
        f"{names}; {cpu['cpu']}, {cpu['cores']} cores; the run took {about['seconds']:.0f} s.",
        *(f"{text}." for text in about["missing"]),
        "\n".join(lines),
        "\n".join(notes),
        "Read errors and times together: spatial unwrapping (scikit-image, OpenCV) needs one "
        "frequency and knows a range only up to whole turns of the frame, which are taken away "
        "before its error is counted. Whole comparisons: "
        "[unwrapping](unwrapping_peers.md), [light transport](../transport/radiosity.md).",
    ]
    return "\n\n".join(parts) + "\n"


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="small inputs, few calls")
    given = parser.parse_args(arguments)
    begin = time.perf_counter()

    def log(text):
        print(f"[{time.perf_counter() - begin:6.1f} s] {text}", file=sys.stderr, flush=True)

    given.out.mkdir(parents=True, exist_ok=True)
    rows, missing = measured(given.out, quick=given.quick, log=log)
    about = {"versions": versions() | installed(), "machine": machine(os.cpu_count() or 1),
             "missing": missing, "seconds": time.perf_counter() - begin}  # fmt: skip
    plain = unwrapping_peers.plain({"about": about, "rows": [asdict(row) for row in rows]})
    (given.out / "results.json").write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
    (given.out / "index.md").write_text(page(about, plain["rows"]), encoding="utf-8")
    print((given.out / "index.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
