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
    import matplotlib.ticker

    ends = []
    for name, points in curves.items():
        colour, marker = looks[name]
        time = 1e3 * np.array([min(p.seconds) for p in points])
        runs = [1e3 * np.sqrt(np.maximum(p.mean_square_m2, 0)) for p in points]
        error = 1e3 * np.sqrt([max(np.mean(p.mean_square_m2), 0) for p in points])
        axis.errorbar(time, error, yerr=[np.std(r) for r in runs], color=colour, marker=marker,
                      ms=5, lw=1.4, capsize=2)  # fmt: skip
        ends.append((error[-1], time[-1], name, colour))
        for p, x, y in zip(points, time, error, strict=True):
            axis.annotate(str(p.samples), (x, y), xytext=(0, 7), textcoords="offset points",
                          fontsize=7, color=colour, ha="center")  # fmt: skip
    axis.set(xscale="log", yscale="log", xlabel="time per frame, ms",
             ylabel="root mean square range error, mm")  # fmt: skip
    low, high = axis.get_xlim()
    axis.set_xlim(low, high * (high / low) ** 0.45)  # room for the names
    _names(axis, sorted(ends))
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
        side.set_major_formatter("{x:g}")
        side.set_minor_formatter("")
    head = f"{title}\n"
    axis.set_title(head + "\n" * note.count("\n"), loc="left", fontsize=11, fontweight="bold")
    axis.text(0, 1.015, note, transform=axis.transAxes, fontsize=8, color="#666", va="bottom")
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(color="#eee", which="both", lw=0.6)
    axis.set_axisbelow(True)


def _names(axis, ends):
    """Names beside the last points, pushed apart where they would overlap."""
    to_px = axis.transData.transform
    lowest = -np.inf
    for error, time, name, colour in ends:
        y = to_px((time, error))[1]
        lowest = max(y, lowest + 15)
        axis.annotate(name, (time, error), xytext=(7, (lowest - y) * 72 / axis.figure.dpi),
                      textcoords="offset points", color=colour, va="center")  # fmt: skip
