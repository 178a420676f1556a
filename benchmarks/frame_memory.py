"""Memory and time of every correction and filter on a frame of four million pixels.

python benchmarks/frame_memory.py                    write docs/frame_memory.md
python benchmarks/frame_memory.py --only crt,kde     measure these anew, keep the other rows
python benchmarks/frame_memory.py --only sra_lp --side 64   on a smaller frame

Every entry runs in a process of its own, limited to LIMIT_GB of address space and LIMIT_S seconds,
on a tilted wall with noise; one that needs longer gets a frame of 1/16 of the pixels, and again.
What is counted is the highest resident memory while running, above what the process held with the
method made and the frame loaded: the answer is part of it.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "frame_memory.md"
SIDE, LIMIT_GB, LIMIT_S = 2048, 12, 120
HEAD = ("entry", "sensor", "pixels", "s per frame", "bytes per pixel", "answered %", "note")


def cases():
    """Entry and sensor, as the laws try them; filters on two frequencies."""
    sys.path.insert(0, str(ROOT / "tests"))
    from test_laws_correction import SENSORS, TWO

    from toftools.registry import CORRECTIONS, FILTERS

    for name in CORRECTIONS:
        yield name, SENSORS.get(name, (TWO,))[-1]
    for name in FILTERS:
        yield name, TWO


def sized(text, side):
    """The sensor with another frame size."""
    name, _, params = text.partition(":")
    kept = [p for p in params.split(",") if not p.startswith(("width=", "height="))]
    return f"{name}:{','.join([*kept, f'width={side}', f'height={side}'])}"


def measure(name, text, side):
    """One entry in this process: seconds, bytes per pixel, share of pixels with an answer."""
    import numpy as np

    from toftools.bench.memory import forget_peak, resident_mb
    from toftools.registry import CORRECTIONS, FILTERS
    from toftools.sensors import sensor
    from toftools.types import DepthMap, Phasors
    from toftools.units import range_to_phase

    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_GB << 30,) * 2)
    device = sensor(sized(text, side))
    rows = np.linspace(0.0, 0.3, side, dtype=np.float32)
    range_m = 1.5 + rows[:, None] + 0.5 * rows[None, :]
    rng = np.random.default_rng(0)
    values = np.empty((device.modulation.n_freqs, side, side), np.complex64)
    for z, freq in zip(values, device.modulation.freqs_hz, strict=True):
        z[:] = 1000 * np.exp(1j * range_to_phase(range_m, freq))
        z.real += rng.standard_normal((side, side), dtype=np.float32)
        z.imag += rng.standard_normal((side, side), dtype=np.float32)
    frame = Phasors(values, np.ones(values.shape, np.float32))
    spec = CORRECTIONS.get(name) or FILTERS[name]
    run = spec.build(device)
    given = (frame,)
    if spec.place == "after":
        given = (DepthMap(range_m, np.full(range_m.shape, 1e-3, np.float32)), frame)
    before = forget_peak()
    start = time.perf_counter()
    out = run(*given)
    seconds = time.perf_counter() - start
    answered = out.valid if isinstance(out, Phasors) else np.isfinite(out.range_m)
    per_pixel = (resident_mb("VmHWM") - before) * 2**20 / side**2
    return {"seconds": seconds, "bytes": per_pixel, "answered": float(answered.mean())}


def in_a_process(name, text, side):
    """The row of one entry; the reason in its place if there is no figure."""
    row = {"entry": name, "sensor": text.partition(":")[0], "side": side}
    command = [sys.executable, __file__, "--one", name, text, str(side)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        if side > 64:
            return in_a_process(name, text, side // 4)
        return {**row, "note": f"no answer within {LIMIT_S} s"}
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        return {**row, "note": lines[-1][:120]}
    return {**row, **json.loads(done.stdout.splitlines()[-1])}


def line_of(row):
    if "note" in row:
        figures = ("–", "–", "–", row["note"])
    else:
        figures = (f"{row['seconds']:.2f}", f"{row['bytes']:.0f}", f"{100 * row['answered']:.1f}",
                   "")  # fmt: skip
    return f"| `{row['entry']}` | {row['sensor']} | {row['side']} x {row['side']} | " + (
        " | ".join(figures) + " |"
    )


def kept_lines():
    """Rows of the page as it is, by entry."""
    if not PAGE.exists():
        return {}
    lines = [s for s in PAGE.read_text(encoding="utf-8").splitlines() if s.startswith("| `")]
    return {line.split("`")[1]: line for line in lines}


def page(lines):
    return "\n".join(
        [
            "# Memory of large frames",
            "",
            "Made by `python benchmarks/frame_memory.py`; do not edit. Every correction with "
            "default parameters, and every filter, on one noisy frame of a tilted wall in a "
            "process of its own. Bytes per pixel: highest resident memory while running above "
            "what the made method and the frame hold, the answer included. "
            "Seconds are wall clock on 2 shared cores, one call: an order of magnitude. Smaller "
            f"frames are those of entries that take more than {LIMIT_S} s for the larger ones.",
            "",
            f"| {' | '.join(HEAD)} |",
            f"|{'---|' * len(HEAD)}",
            *lines,
            "",
        ]
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="")
    parser.add_argument("--side", type=int, default=SIDE)
    parser.add_argument("--one", nargs=3)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(args.one[0], args.one[1], int(args.one[2]))))
        return
    wanted = set(filter(None, args.only.split(",")))
    known, lines = kept_lines(), []
    for name, text in cases():
        if not wanted or name in wanted:
            known[name] = line_of(in_a_process(name, text, args.side))
            print(known[name], flush=True)
        if name in known:
            lines.append(known[name])
    PAGE.write_text(page(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
