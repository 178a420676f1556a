"""Unwrapping at long range: share of right, wrong and missing pixels against distance.

python benchmarks/long_range.py --out DIR       writes DIR/long_range.md and DIR/long_range.png

Scene: a hall 10 m wide, 5 m high and 17.5 m long with ten pillars of several widths and albedos.
Floor, walls and ceiling are planes seen at a slant, every pillar is a step of metres, and pixels
spread over all distances; a lone wall would flatter a method that asks the neighbours. Pillars
are few pixels wide at the far end, where such a method has least to ask.
Shot and read noise of nominal Kinect v2 frequencies (80/16/120 MHz, joint ambiguity 18.74 m); no
multipath, no motion, no calibration error.

A pixel is right within 0.3 m of the truth (no wrap is shorter than 1.25 m), wrong beyond. The
default thresholds of the methods differ in how much they dare, so each is also run without
thresholds and its pixels are taken in the order of its confidence until 1 % of all are wrong.
"""

import argparse
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np

from toftools.camera import rays
from toftools.phasor import demodulate
from toftools.registry import CORRECTIONS, find
from toftools.sensors import sensor as preset
from toftools.sim.noise import clean_taps, expose
from toftools.units import range_to_phase

SHELL_M = np.array([5.0, 2.5, 17.5])  # half width, half height, length
ALBEDO = (0.6, 0.4, 0.7)  # walls, floor and ceiling, far end
RIGHT_M = 0.3
WRONG_SHARE = 0.01
BINS_M = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 18.75)
LAX = "residual_voting:strict_rad=9,lax_rad=9"
# Name, as it is by default, and with which thresholds its confidence may also rank the pixels.
METHODS = (
    ("crt", "crt", ()),
    ("residual_voting", "residual_voting", (LAX, f"{LAX},least_amplitude=0,least_sum=0")),
    ("kde", "kde", ("kde:threshold=0",)),
    ("kde, 4 hypotheses", "kde:hypotheses=4", ("kde:hypotheses=4,threshold=0",)),
)


def hall(camera, *, n_pillars=10, seed=0):
    """Range, cosine of incidence and albedo of every pixel, (H, W) each."""
    rng = np.random.default_rng(seed)
    ray = rays(camera)
    with np.errstate(divide="ignore"):
        reach = SHELL_M / np.abs(ray)  # (H, W, 3): range to the side, height and far planes
    face = reach.argmin(axis=-1)
    range_m = reach.min(axis=-1)
    cosine = np.abs(np.take_along_axis(ray, face[..., None], -1))[..., 0]
    albedo = np.choose(face, ALBEDO)
    for _ in range(n_pillars):
        x, half, z = rng.uniform(-4.5, 4.5), rng.uniform(0.1, 0.4), rng.uniform(1.5, 16.5)
        shade = rng.uniform(0.15, 0.85)
        front = z / ray[..., 2]
        hit = (np.abs(front * ray[..., 0] - x) < half) & (front < range_m)
        range_m = np.where(hit, front, range_m)
        cosine = np.where(hit, ray[..., 2], cosine)
        albedo = np.where(hit, shade, albedo)
    return range_m, cosine, albedo


def shoot(sensor, scene, seed):
    """Noisy phasors of direct light from the scene."""
    range_m, cosine, albedo = scene
    charge_e = sensor.noise.signal_e * albedo * cosine / range_m**2

    def light(freq_hz):
        return charge_e * np.exp(1j * range_to_phase(range_m, freq_hz))

    rng = np.random.default_rng(seed)
    return demodulate(expose(clean_taps(light, 0.0, sensor), sensor, rng), sensor)


def right_at(right, wrong, confidence, share):
    """Share of right pixels when the most trusted are taken until `share` of all are wrong."""
    order = np.argsort(-confidence, kind="stable")
    allowed = np.cumsum(wrong[order]) <= share * wrong.size
    return float(right[order][allowed].sum() / right.size)


def measure(method, sensor, truth, frames):
    """Flat arrays over all frames: range, right, wrong, confidence (least where no answer)."""
    run = find(CORRECTIONS, method).build(sensor)
    parts = []
    for frame in frames:
        depth = run(frame)
        error = np.abs(depth.range_m - truth)
        given = np.isfinite(error)
        trust = np.where(given, depth.confidence, -np.inf)
        parts.append((truth, given & (error <= RIGHT_M), given & (error > RIGHT_M), trust))
    return [np.concatenate([p.reshape(-1) for p in column]) for column in zip(*parts, strict=True)]


def evaluate(sensor, n_frames, edges):
    """Rows of shares: one dict per method and bin; the bin None is the whole frame."""
    scene = hall(sensor.camera)
    frames = [shoot(sensor, scene, seed) for seed in range(n_frames)]
    rows = []
    for name, usual, looser in METHODS:
        range_m, right, wrong, trust = measure(usual, sensor, scene[0], frames)
        ranked = [(right, wrong, trust)]
        ranked += [measure(method, sensor, scene[0], frames)[1:] for method in looser]
        for limits in [None, *itertools.pairwise(edges)]:
            at = np.ones(range_m.size, bool)
            if limits is not None:
                at = (range_m >= limits[0]) & (range_m < limits[1])
            if not at.any():
                continue
            rows.append({
                "method": name, "bin": limits, "pixels": int(at.sum()),
                "right": float(right[at].mean()), "wrong": float(wrong[at].mean()),
                "equal": max(right_at(r[at], w[at], t[at], WRONG_SHARE) for r, w, t in ranked),
            })  # fmt: skip
    return rows


def table(rows, title):
    """Markdown: one line per method, one column per bin."""
    bins = list(dict.fromkeys(row["bin"] for row in rows))
    names = ["all" if b is None else f"{b[0]:g}-{b[1]:g} m" for b in bins]
    lines = [f"### {title}", "", f"| method | share, % | {' | '.join(names)} |"]
    lines.append(f"|---|---|{'---:|' * len(bins)}")
    counts = {row["bin"]: row["pixels"] for row in rows}
    shares = (f"{100 * counts[b] / counts[None]:.1f}" for b in bins)
    lines.append(f"| (pixels of the frame) | | {' | '.join(shares)} |")
    for name, _, _ in METHODS:
        mine = {row["bin"]: row for row in rows if row["method"] == name}
        for label, key in (("valid", None), ("wrong", "wrong"), ("right, 1 % wrong", "equal")):
            cells = []
            for b in bins:
                row = mine[b]
                value = row["right"] + row["wrong"] if key is None else row[key]
                cells.append(f"{100 * value:.1f}")
            lines.append(f"| {name} | {label} | {' | '.join(cells)} |")
    whole = {row["method"]: row for row in rows if row["bin"] is None}
    for key, what in (("right", "default thresholds"), ("equal", "1 % wrong each")):
        more = whole["kde"][key] / max(whole["residual_voting"][key], 1e-9) - 1
        lines.append("")
        lines.append(f"kde against residual_voting, right pixels of the frame, {what}: "
                     f"{100 * more:+.0f} %.")  # fmt: skip
    return "\n".join(lines)


def picture(path, panels):
    """Right share against distance, one column per light level."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(2, len(panels), figsize=(5 * len(panels), 7), squeeze=False,
                             sharex=True, sharey=True, layout="constrained")  # fmt: skip
    for column, (title, rows) in zip(axes.T, panels, strict=True):
        for axis, key, what in zip(
            column, ("right", "equal"), ("default", "1 % wrong"), strict=True
        ):
            for name, _, _ in METHODS:
                mine = [r for r in rows if r["method"] == name and r["bin"] is not None]
                middle = [np.mean(r["bin"]) for r in mine]
                axis.plot(middle, [100 * r[key] for r in mine], marker="o", ms=3, label=name)
            axis.set_title(f"{title}, {what}")
            axis.set_ylabel("right pixels, %")
            axis.grid(alpha=0.3)
        column[-1].set_xlabel("range, m")
    axes[0, 0].legend()
    fig.savefig(path, dpi=120)
    plt.close(fig)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--height", type=int, default=212)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--signal-e", type=float, nargs="+", default=[20_000.0, 100_000.0])
    given = parser.parse_args(arguments)
    base = preset(f"kinect2_nominal:width={given.width},height={given.height}")
    fine = np.append(np.arange(0.0, 18.0, 1.5), 18.75)
    sections, panels = [], []
    for signal_e in given.signal_e:
        sensor = replace(base, noise=replace(base.noise, signal_e=signal_e))
        title = f"{signal_e / 1000:g} ke- per tap from white at 1 m"
        sections.append(table(evaluate(sensor, given.frames, BINS_M), title))
        panels.append((title, evaluate(sensor, given.frames, fine)))
    given.out.mkdir(parents=True, exist_ok=True)
    size = f"{given.width} x {given.height}, {given.frames} frames"
    text = "\n\n".join([f"## Unwrapping at long range ({size})", *sections]) + "\n"
    (given.out / "long_range.md").write_text(text, encoding="utf-8")
    picture(given.out / "long_range.png", panels)
    print(text)


if __name__ == "__main__":
    main()
