"""Page and pictures of the learned corrections, out of the figures kept in results.json."""

import numpy as np
from correction_draw import COLOURS, MARKERS, figure
from learned_held_out import EDGES_M

SHOWN = ("raw, 20 MHz", "fuchs2010, 20 MHz", "deeptof2017", "phasornet_20", "raw, 40 + 70 MHz",
         "fuchs2010, 40 + 70 MHz", "auto, 40 + 70 MHz", "phasornet_40_70")  # fmt: skip


def cm(value):
    """Centimetres of a number of metres."""
    return "–" if value is None or not np.isfinite(value) else f"{100 * value:.2f}"


def table(head, rows):
    """A Markdown table; the first column is text."""
    lines = ["| " + " | ".join(head) + " |", "|---" + "|---:" * (len(head) - 1) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def held_out(found):
    """Errors on scenes that no training has seen."""
    head = ["method", "MAE cm", "25 %", "median", "75 %", "95 %", "> 0.5 m, %", "captures", "ms"]
    rows = [
        [f"`{label}`", *(cm(f[k]) for k in ("mae_m", "p25_m", "median_m", "p75_m", "p95_m")),
         f"{100 * f['wrong']:.2f}", str(f["captures"]), f"{f['ms']:.1f}"]
        for label, f in found.items()
    ]  # fmt: skip
    groups = sorted({g for f in found.values() for g in f["groups"]})
    by_group = [[f"`{label}`", *(cm(f["groups"].get(g, {}).get("mae_m")) for g in groups)]
                for label, f in found.items()]  # fmt: skip
    return (
        table(head, rows)
        + "\n\nMean absolute error, cm, by family:\n\n"
        + table(["method", *groups], by_group)
    )


def albedo(found):
    """Mean absolute error per set of albedos."""
    groups = sorted({g for f in found.values() for g in f["groups"]})
    rows = [[f"`{label}`", *(cm(f["groups"][g]["mae_m"]) for g in groups)]
            for label, f in found.items()]  # fmt: skip
    return table(["method", *groups], rows)


def su(found):
    """Frames of another renderer."""
    frames = sorted({name for f in found.values() for name in f})
    rows = []
    for label, f in found.items():
        mean = np.mean([f[n]["mae_m"] for n in frames])
        rows.append((mean, [f"`{label}`", cm(mean), *(cm(f[n]["mae_m"]) for n in frames),
                            *(cm(f[n]["median_m"]) for n in frames),
                            " / ".join(f"{100 * f[n]['wrong']:.2f}" for n in frames)]))  # fmt: skip
    head = ["method", "mean MAE cm", *(f"MAE {i + 1}" for i in range(len(frames))),
            *(f"median {i + 1}" for i in range(len(frames))), "> 0.5 m, %"]  # fmt: skip
    return table(head, [row for _, row in sorted(rows, key=lambda r: r[0])])


def speed(found, errors):
    """Milliseconds of the parts, and the error where it is known."""
    sizes = [k for k in next(iter(found.values())) if "x" in k]
    head = ["network", "kB", "held-out MAE cm"]
    head += [f"{size}: {part}" for size in sizes for part in ("network", "input", "whole")]
    rows = []
    for label, f in found.items():
        told = errors.get(label, {}).get("mae_m")
        times = [f"{f[size][part]:.1f}" for size in sizes for part in ("network", "input", "whole")]
        rows.append([f"`{label}`", f"{f['bytes'] / 1e3:.0f}", cm(told), *times])
    return table(head, rows)


def steady(found):
    """Flicker of the error of a camera that moves slowly."""
    rows = [[f"`{label}`", cm(f["mae_m"]), cm(f["bias_m"]), f"{1000 * f['flicker_m']:.2f}"]
            for label, f in found.items()]  # fmt: skip
    return table(["method", "MAE cm", "median error cm", "frame to frame, mm"], rows)


def distributions(found, stem):
    """Error distributions with their quartiles, as in thesis figure 7.10."""
    names = [n for n in SHOWN if n in found] or list(found)
    with figure(stem, 1, 1, (9, 4.2)) as (_, axes):
        axis = axes[0, 0]
        for name, colour in zip(names, COLOURS, strict=False):
            counts = np.array(found[name]["histogram"], float)
            total = np.cumsum(counts) / counts.sum()
            axis.plot(100 * EDGES_M[1:], 100 * total, color=colour, label=name, lw=1.6)
            for quarter in ("p25_m", "median_m", "p75_m"):
                at = found[name][quarter]
                axis.plot(100 * at, 100 * np.interp(at, EDGES_M[1:], total), "o", ms=3.5,
                          color=colour)  # fmt: skip
        axis.set_xscale("log")
        axis.set_xlim(0.1, 200)
        axis.set_xlabel("absolute error, cm (dots: quartiles)")
        axis.set_ylabel("share of pixels below, %")
        axis.set_title("Held-out scenes", loc="left")
        axis.grid(alpha=0.3)
        axis.legend(frameon=False, fontsize=8)


def albedo_bars(found, stem):
    """Mean absolute error per set of albedos, as in thesis figure 7.12."""
    names = [n for n in SHOWN if n in found] or list(found)
    groups = sorted({g for f in found.values() for g in f["groups"]})
    width = 0.8 / len(names)
    with figure(stem, 1, 1, (11, 3.6)) as (_, axes):
        axis = axes[0, 0]
        for number, (name, colour) in enumerate(zip(names, COLOURS, strict=False)):
            heights = [100 * found[name]["groups"][g]["mae_m"] for g in groups]
            places = np.arange(len(groups)) + (number - len(names) / 2 + 0.5) * width
            axis.bar(places, heights, width, color=colour, label=name)
        axis.set_xticks(range(len(groups)), groups)
        axis.set_ylabel("mean absolute error, cm")
        axis.set_title("Three unseen rooms in six sets of albedos", loc="left")
        axis.grid(alpha=0.3, axis="y")
        axis.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def pareto(found, errors, stem):
    """Error against time of the whole correction, both sizes."""
    sizes = [k for k in next(iter(found.values())) if "x" in k]
    with figure(stem, 1, len(sizes), (11, 3.8)) as (_, axes):
        for axis, size, limit in zip(axes[0], sizes, (10, 33), strict=False):
            named = [n for n in found if n in errors]
            for number, name in enumerate(named):
                x, y = found[name][size]["whole"], 100 * errors[name]["mae_m"]
                eight = name.endswith("int8")
                colour, mark = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
                axis.plot(x, y, mark, color=colour, ms=7, mfc="none" if eight else None,
                          label=name)  # fmt: skip
            axis.axvline(limit, color="#98a2b3", ls="--", lw=1)
            axis.set_xlabel("ms per frame, whole correction")
            axis.set_ylabel("held-out MAE, cm")
            axis.set_title(f"{size} pixels (dashed: {limit} ms)", loc="left")
            axis.grid(alpha=0.3)
        axes[0, -1].legend(frameon=False, fontsize=7)


INTRO = """# Learned corrections

Made by `python benchmarks/learned.py`; do not edit. Errors are absolute, in cm, of pixels whose
truth is known and within reach. What a network is and how one is trained: [training](training.md).
The data: [datasets](../datasets.md) and [its likeness to real captures](likeness.md). What the
shipped networks can and cannot do: [model card](model_card.md).
"""
HELD_OUT = """## Held-out scenes
Scenes of the data set that no training has seen (split by scene), with the noise of the capture.
"""
ALBEDO = """## The same rooms in other colours
Mean absolute error, cm, of three rooms that are in no data set.
"""
SU = """## Another renderer: frames of Su et al. (CVPR 2018)
40 and 70 MHz, never trained or tuned on; truth up to 9.9 m.
"""
SPEED = """## Time
Median milliseconds of 25 frames on two cores: the network, its input, and the whole correction.
"""
STEADY = """## Steadiness
A camera goes 2 cm aside and 2 cm ahead from frame to frame, eight frames, each with noise of its
own; frame to frame is the median change of a pixel's error, as a standard deviation.
"""


def write(kept, folder):
    """The page, from the parts that were measured."""
    parts = [INTRO]
    if "held_out" in kept:
        distributions(kept["held_out"], folder / "errors")
        parts += [HELD_OUT, held_out(kept["held_out"]), "\n![Error distributions](errors.png)\n"]
    if "albedo" in kept:
        albedo_bars(kept["albedo"], folder / "albedo")
        parts += [ALBEDO, albedo(kept["albedo"]), "\n![Albedos](albedo.png)\n"]
    if "su" in kept:
        parts += [SU, su(kept["su"]), ""]
    if "speed" in kept:
        errors = kept.get("held_out", {})
        parts += [SPEED, speed(kept["speed"], errors)]
        if any(name in errors for name in kept["speed"]):
            pareto(kept["speed"], errors, folder / "speed")
            parts.append("\n![Error against time](speed.png)\n")
    if "steady" in kept:
        parts += [STEADY, steady(kept["steady"]), ""]
    (folder / "index.md").write_text("\n".join(parts), encoding="utf-8")
