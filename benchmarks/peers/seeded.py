"""Seeded scenes whose indirect light is known otherwise, and the statistics of how they came out.

Closed forms: a wall and a tilted one, where no light comes back; the sphere cavity, all bounces;
the corner, one bounce. Without one: Cornell boxes, vees, prisms and furnished rooms, held against
runs of `path` whose own noise is taken off.
"""

from dataclasses import dataclass

import numpy as np

CLOSED, PATH = "closed form", "path"
SIZE = (48, 36)
# On a square box an even number of rows puts the pixels of the diagonals exactly on seams, where
# neither engine knows which of the two walls it looks at: one row less.
HEIGHT = {"cornell": 35}
RUNS = 4
# Family: how many of 200, what its scenes are held against, and samples of each of RUNS runs.
# Flat scenes are few: without indirect light there is nothing to get wrong.
FAMILIES = {
    "wall": (4, CLOSED, 0),
    "tilted": (4, CLOSED, 0),
    "cavity": (38, CLOSED, 0),
    "corner": (38, CLOSED, 0),
    "cornell": (44, PATH, 1024),
    "vshape": (34, PATH, 256),
    "prism": (22, PATH, 256),
    "room": (16, PATH, 2048),
}


@dataclass(frozen=True)
class Sample:
    """One scene with its camera; `bounces` None means all of them."""

    number: int
    family: str
    scene: str
    sensor: str
    bounces: int | None
    against: str
    samples: int


def samples(count):
    """The first `count` samples: families take turns, in proportion."""
    order = np.concatenate([
        np.stack([(np.arange(many) + 0.5) / many, np.full(many, i)], axis=1)
        for i, (many, _, _) in enumerate(FAMILIES.values())
    ])  # fmt: skip
    order = order[np.lexsort((order[:, 1], order[:, 0]))][:, 1].astype(int)
    names = list(FAMILIES)
    return [_sample(number, names[order[number % len(order)]]) for number in range(count)]


def _sample(number, family):
    rng = np.random.default_rng([6, number])
    freq_hz = 1e6 * round(float(np.exp(rng.uniform(np.log(10), np.log(100)))), 1)
    view, params = _draw(family, rng, number)
    scene = f"{family}:" + ",".join(f"{k}={v}" for k, v in params.items())
    size = f"width={SIZE[0]},height={HEIGHT.get(family, SIZE[1])}"
    sensor = f"deeptof:{size},hfov_deg={view},freqs={freq_hz:g}"
    _, against, paths = FAMILIES[family]
    bounces = 1 if family == "corner" else None  # as far as its closed form goes
    return Sample(number, family, scene, sensor, bounces, against, paths)


def _draw(family, rng, number):
    """Field of view in degrees, and parameters of the scene."""

    def within(low, high):
        return round(float(rng.uniform(low, high)), 3)

    if family in ("wall", "tilted"):
        tilt = {"tilt": within(5, 60)} if family == "tilted" else {}
        return 50, {"range": within(0.5, 6), "albedo": within(0.1, 0.9), **tilt}
    if family == "cavity":
        return 60, {"radius": within(0.5, 4), "albedo": within(0.1, 0.9)}
    if family == "corner":
        return 50, {
            "range": within(1, 4), "angle": within(45, 150), "albedo": within(0.2, 0.9),
        }  # fmt: skip
    if family == "cornell":
        return 39.3077, {"size": within(0.4, 4)}
    if family == "vshape":
        return 60, {
            "range": within(1, 2.4), "angle": within(50, 130), "albedo": within(0.4, 0.9),
        }  # fmt: skip
    if family == "prism":
        return 45, {"range": within(0.6, 1.5), "albedo": within(0.4, 0.9)}
    return 70, {"seed": 100 + number}


def wilson(hits, count, z=1.96):
    """95 % interval of a share, after E. B. Wilson (1927)."""
    share, extra = hits / count, z * z / count
    middle = (share + extra / 2) / (1 + extra)
    half = z * np.sqrt(share * (1 - share) / count + extra / (4 * count)) / (1 + extra)
    return float(max(middle - half, 0)), float(min(middle + half, 1))


def exponent(pixels, seconds):
    """Power of the pixels with which time grows, by least squares of the logarithms."""
    return float(np.polyfit(np.log(pixels), np.log(seconds), 1)[0])


def summary(rows, tol_mm):
    """Share within the tolerance, its interval, and the same by family; `rows` are dicts."""
    families = []
    for family, against in dict.fromkeys((r["family"], r["against"]) for r in rows):
        some = [r for r in rows if (r["family"], r["against"]) == (family, against)]
        errors = [r["rms_mm"] for r in some]
        families.append({
            "family": family,
            "against": against,
            "count": len(some),
            "within": sum(_within(r, tol_mm) for r in some),
            "median_mm": float(np.median(errors)),
            "largest_mm": max(errors),
            "bias_mm": float(np.mean([r["bias_mm"] for r in some])),
            "seconds": float(np.mean([r["seconds"] for r in some])),
        })  # fmt: skip
    hits = sum(f["within"] for f in families)
    out = [r for r in rows if not _within(r, tol_mm)]
    return {
        "count": len(rows),
        "tol_mm": tol_mm,
        "share": hits / len(rows),
        "interval": wilson(hits, len(rows)),
        "families": families,
        "worst": sorted(out, key=lambda r: -r["rms_mm"])[:10],
        "unsure": sum(abs(r["rms_mm"] - tol_mm) < 2 * r["se_mm"] for r in rows),
    }


def _within(row, tol_mm):
    return row["rms_mm"] <= tol_mm


def draw(rows, cost, tol_mm, stem):
    """Histogram of the actual errors, and time against pixels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context({"svg.fonttype": "none", "svg.hashsalt": "toftools", "font.size": 10}):
        fig, axes = plt.subplots(1, 2, figsize=(12, 4.4), layout="constrained")
        _histogram(axes[0], rows, tol_mm, plt.get_cmap("tab10").colors)
        _cost(axes[1], cost)
        for axis in axes:
            axis.spines[["top", "right"]].set_visible(False)
            axis.set_axisbelow(True)
        for kind, extra in (("png", {"dpi": 110}), ("svg", {"metadata": {"Date": None}})):
            fig.savefig(stem.with_suffix(f".{kind}"), **extra)
        plt.close(fig)


LEAST_MM = 0.01


def _histogram(axis, rows, tol_mm, colours):
    families = list(dict.fromkeys(r["family"] for r in rows))
    errors = [[max(r["rms_mm"], LEAST_MM) for r in rows if r["family"] == f] for f in families]
    top = max(10 * tol_mm, 1.01 * max(max(e) for e in errors))
    bins = np.geomspace(LEAST_MM, top, 40)
    axis.hist(errors, bins, stacked=True, label=families, color=colours[: len(families)])
    axis.axvline(tol_mm, color="#333", lw=1)
    axis.set(xscale="log", ylabel="scenes",
             xlabel=f"actual error, mm rms (below {LEAST_MM:g}: at {LEAST_MM:g})")  # fmt: skip
    axis.xaxis.set_major_formatter("{x:g}")
    axis.set_title(f"{len(rows)} scenes at a tolerance of {tol_mm:g} mm", loc="left",
                   fontsize=11, fontweight="bold")  # fmt: skip
    axis.legend(frameon=False, fontsize=8)


def _cost(axis, cost):
    for name in dict.fromkeys(c["scene"] for c in cost):
        some = [c for c in cost if c["scene"] == name]
        pixels = np.array([c["size"][0] * c["size"][1] for c in some])
        seconds = np.array([c["seconds"] for c in some])
        [line] = axis.plot(pixels, seconds, "o-", label=name)
        axis.plot(pixels, seconds[0] * pixels / pixels[0], ":", lw=1, color=line.get_color())
    axis.set(xscale="log", yscale="log", xlabel="pixels", ylabel="time per frame, s")
    axis.grid(color="#eee", which="both", lw=0.6)
    axis.set_title("Cost (dotted: in proportion)", loc="left", fontsize=11, fontweight="bold")
    if cost:
        axis.legend(frameon=False, fontsize=8)
