"""Is a data set like the world? Depth statistics of thesis 7.B between a set and real captures.

    python benchmarks/likeness.py --data DIR --out docs/learned

Real: all captures of TOFTOOLS_DATA that hold a range image of a scene, a handful; every image is
thinned until a pixel is about a quarter of a degree. Ranges of the set are those a camera would
tell, multipath included. The weights of the families are those, none negative, that bring the
mixture's statistics closest to the real ones: what the generator should draw more of.
"""

import argparse
import json
import os
from pathlib import Path

import numpy as np
from learned_frames import at, captures
from scipy.optimize import nnls

from toftools.io.open import open_capture
from toftools.metrics.distributions import histogram, normalised
from toftools.metrics.statistics import compare
from toftools.phasor import phasors_of
from toftools.registry import CORRECTIONS

STATISTICS = ("range", "gradient_h", "gradient_v", "cooccurrence", "haar_hv", "haar_hd")
SHOWN = ("range", "gradient_h", "gradient_v")
PIXEL_DEG = 0.25
REAL = ("su2018_tintin_40_70MHz/im_pair_*.mat", "snapshot_lidar_mlx75027_60MHz/CVPRScene_phase0*",
        "azure_kinect_pyk4a/*.mkv", "adi_adtf3175/*depth_.bin", "ifm_o3r/*.data")  # fmt: skip
FREQS = (40e6, 70e6)


def real_images(folder):
    """Range images of real scenes by name."""
    found = {}
    for pattern in REAL:
        for path in sorted(folder.glob(pattern)):
            try:
                capture = open_capture(path)
            except ValueError:
                continue
            found[path.parent.name + " " + path.stem[-10:]] = thinned(capture, ranges(capture))
    return found


def ranges(capture):
    """What the camera told, or would have told: unwrapped, nothing corrected."""
    if capture.depth is not None:
        return capture.depth.range_m
    several = capture.sensor.modulation.n_freqs > 1
    run = CORRECTIONS["semi_global" if several else "crt"].build(capture.sensor)
    return run(phasors_of(capture)).range_m


def thinned(capture, range_m):
    """Every n-th pixel, so that all cameras have about the same angle between pixels."""
    step = max(round(np.radians(PIXEL_DEG) * capture.sensor.camera.K[0, 0]), 1)
    return np.where(range_m > 0, range_m, np.nan)[::step, ::step]


def families(folder, most=40):
    """Range images of each family of a data set, up to `most`."""
    found = {}
    for entry, capture in captures(folder, "train"):
        if len(found.setdefault(entry["family"], [])) < most:
            sensor, phasors = at(capture, FREQS)
            range_m = CORRECTIONS["semi_global"].build(sensor)(phasors).range_m
            found[entry["family"]].append(thinned(capture, range_m))
    return found


def shares(images, statistic):
    """Normalised histogram over images."""
    usable = [image for image in images if np.isfinite(image).sum() > 100]
    return normalised(histogram(usable, statistic, [np.isfinite(i) for i in usable]))


def weighed(sets, real):
    """Weights of the families, and the comparison of their mixture and of even parts."""
    names = sorted(sets)
    tables = {s: np.stack([shares(sets[n], s).ravel() for n in names], axis=1) for s in STATISTICS}
    goals = {s: shares(real, s).ravel() for s in STATISTICS}
    # Roots of shares: differences count as in Hellinger's distance, not by the fullest bin alone.
    rows = np.concatenate([tables[s] / np.sqrt(goals[s] + 1e-4)[:, None] for s in STATISTICS])
    goal = np.concatenate([goals[s] / np.sqrt(goals[s] + 1e-4) for s in STATISTICS])
    best = nnls(rows, goal)[0]
    best = best / best.sum()
    mixtures = {"as the recipe draws": _sizes(sets, names), "weighed": best}
    told = {label: {s: compare(normalised(tables[s] @ w), goals[s]) for s in STATISTICS}
            for label, w in mixtures.items()}  # fmt: skip
    alone = {n: {s: compare(tables[s][:, i], goals[s]) for s in STATISTICS}
             for i, n in enumerate(names)}  # fmt: skip
    curves = {
        s: {"real": goals[s], **{k: tables[s] @ w for k, w in mixtures.items()}} for s in SHOWN
    }
    return dict(zip(names, best.round(4).tolist(), strict=True)), told, alone, curves


def _sizes(sets, names):
    counts = np.array([len(sets[n]) for n in names], float)
    return counts / counts.sum()


def within(real):
    """The same comparison between the real captures themselves: one against the others."""
    names = list(real)
    found = {s: [] for s in STATISTICS}
    for name in names:
        others = [real[other] for other in names if other != name]
        for s in STATISTICS:
            found[s].append(compare(shares([real[name]], s).ravel(), shares(others, s).ravel()))
    return {s: {key: float(np.median([c[key] for c in found[s]])) for key in found[s][0]}
            for s in STATISTICS}  # fmt: skip


def draw(curves, path):
    """Histograms of range and of slopes."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(1, len(curves), figsize=(13, 3.4), layout="constrained")
    for axis, (name, lines) in zip(axes, curves.items(), strict=True):
        for (label, line), colour in zip(
            lines.items(), ("#222222", "#98a2b3", "#0072b2"), strict=True
        ):
            axis.plot(line, color=colour, label=label, lw=1.4)
        axis.set_title(name, loc="left")
        axis.set_xlabel("bin")
        axis.set_ylabel("share of pixels")
        axis.grid(alpha=0.3)
        if name != "range":
            axis.set_yscale("log")
    axes[0].legend(frameon=False)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def text(weights, told, alone, inside, n_real, n_set):
    """Markdown."""
    head = "| | " + " | ".join(STATISTICS) + " |\n|---|" + "---:|" * len(STATISTICS)

    def line(label, values):
        cells = " | ".join(
            f"{v[s]['chi2']:.3f} / {v[s]['js']:.3f} / {v[s]['pearson']:.2f}"
            for v in [values]
            for s in STATISTICS
        )
        return f"| {label} | {cells} |"

    rows = [line(label, values) for label, values in told.items()]
    rows += [line(f"family {label}", values) for label, values in alone.items()]
    rows.append(line("one real capture against the others (median)", inside))
    parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in weights.items() if share > 0)
    return f"""# Is the data like the world?

Made by `python benchmarks/likeness.py`; do not edit. {n_set} captures of the set against {n_real}
real ones: chi-squared error / Jensen-Shannon distance / Pearson correlation of each distribution
(definitions: docs/benchmark.md). The thesis, with 48,000 real images of the camera it simulates,
reports 0.032 / 0.129 / 0.90 for the range of single pixels, and a chi-squared error of 0.051 and
0.028 for the gradients.

{head}
{chr(10).join(rows)}

Weights of the families that bring the mixture closest to the real captures: {parts}.

**How far to trust it**: {n_real} captures of five cameras, most of them of tables and of rooms from
0.4 to 3 m, are no sample of the world; the last row says how little they are like each other. Small
differences between mixtures mean nothing.

![Histograms](likeness.png)
"""


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    real = real_images(Path(os.environ["TOFTOOLS_DATA"]))
    sets = families(given.data)
    weights, told, alone, curves = weighed(sets, list(real.values()))
    inside = within(real)
    given.out.mkdir(parents=True, exist_ok=True)
    draw(curves, given.out / "likeness.png")
    count = sum(map(len, sets.values()))
    (given.out / "likeness.md").write_text(
        text(weights, told, alone, inside, len(real), count), encoding="utf-8"
    )
    kept = {"weights": weights, "mixtures": told, "families": alone, "within_real": inside}
    (given.out / "likeness.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    print(json.dumps({"weights": weights, "mixtures": told, "within_real": inside}, indent=1))


if __name__ == "__main__":
    main()
