"""Picture of the equal-time comparison: error against time, one panel per scene and question."""

import numpy as np

COLOURS = ("#d55e00", "#cc79a7", "#0072b2", "#009e73", "#e69f00")  # as in the other charts
MARKERS = ("s", "D", "o", "^", "v")


def draw(panels, stem):
    """Write ``stem.png`` and ``stem.svg``; `panels` are rows of (title, note, {engine: points})."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context({"svg.fonttype": "none", "svg.hashsalt": "toftools", "font.size": 10}):
        size = (6.4 * len(panels[0]), 4.4 * len(panels))
        fig, axes = plt.subplots(len(panels), len(panels[0]), figsize=size, squeeze=False,
                                 layout="constrained")  # fmt: skip
        names = list(dict.fromkeys(n for row in panels for panel in row for n in panel[2]))
        looks = dict(zip(names, zip(COLOURS, MARKERS, strict=False), strict=False))
        for axis, panel in zip(axes.flat, (p for row in panels for p in row), strict=True):
            _panel(axis, *panel, looks)
        for kind, extra in (("png", {"dpi": 110}), ("svg", {"metadata": {"Date": None}})):
            fig.savefig(stem.with_suffix(f".{kind}"), **extra)
        plt.close(fig)


def _panel(axis, title, note, curves, looks):
    for name, points in curves.items():
        colour, marker = looks[name]
        time = 1e3 * np.array([min(p.seconds) for p in points])
        runs = [1e3 * np.sqrt(np.maximum(p.mean_square_m2, 0)) for p in points]
        error = 1e3 * np.sqrt([max(np.mean(p.mean_square_m2), 0) for p in points])
        axis.errorbar(time, error, yerr=[np.std(r) for r in runs], color=colour, marker=marker,
                      ms=5, lw=1.4, capsize=2)  # fmt: skip
        axis.annotate(name, (time[-1], error[-1]), xytext=(7, 0), textcoords="offset points",
                      color=colour, va="center")  # fmt: skip
        for p, x, y in zip(points, time, error, strict=True):
            axis.annotate(str(p.samples), (x, y), xytext=(0, 7), textcoords="offset points",
                          fontsize=7, color=colour, ha="center")  # fmt: skip
    axis.set(xscale="log", yscale="log", xlabel="time per frame, ms",
             ylabel="root mean square range error, mm")  # fmt: skip
    low, high = axis.get_xlim()
    axis.set_xlim(low, high * (high / low) ** 0.35)  # room for the names
    axis.set_title(title, loc="left", fontsize=11, fontweight="bold")
    axis.text(0, 1.0, note, transform=axis.transAxes, fontsize=8, color="#666", va="bottom")
    axis.title.set_position((0, 1.05))
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(color="#eee", which="both", lw=0.6)
    axis.set_axisbelow(True)
