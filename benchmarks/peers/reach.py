"""When an engine reaches an error: between its measured points, or beyond them by 1/sqrt(N)."""

from dataclasses import dataclass

import numpy as np

MEASURED, BEYOND, BEFORE = "measured", "extrapolated", "at most"


@dataclass(frozen=True)
class Reach:
    """Seconds at which the error is `target_m`, and how that is known.

    "measured" lies between two measured points, straight in the logarithms of time and error;
    "extrapolated" goes on from the last one as 1/sqrt(time); "at most" is the first point, if
    even that is below the target.
    """

    target_m: float
    seconds: float
    how: str


def curve(points):
    """Times and root mean square errors that are known, by time: (n,) s, (n,) m."""
    known = [p for p in points if p.known]
    time = np.array([min(p.seconds) for p in known])
    error = np.sqrt([np.mean(p.mean_square_m2) for p in known])
    order = np.argsort(time)
    return time[order], error[order]


def reach(points, target_m):
    """`Reach` of an engine's points; None if no error is known."""
    time, error = curve(points)
    if not len(time):
        return None
    below = np.flatnonzero(error <= target_m)
    if not len(below):
        seconds = time[-1] * (error[-1] / target_m) ** 2
        return Reach(target_m, float(seconds), BEYOND)
    first = below[0]
    if first == 0:
        return Reach(target_m, float(time[0]), BEFORE)
    pair = slice(first - 1, first + 1)
    down, across = -np.log(error[pair]), np.log(time[pair])
    return Reach(target_m, float(np.exp(np.interp(-np.log(target_m), down, across))), MEASURED)


def draw(panels, target_m, stem):
    """Write ``stem.png`` and ``stem.svg``; `panels` are (title, note, {engine: [points]}).

    An engine may have several curves in a panel: they share a colour.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from peers.chart import COLOURS, MARKERS

    names = list(dict.fromkeys(name for panel in panels for name in panel[2]))
    looks = dict(zip(names, zip(COLOURS, MARKERS, strict=False), strict=False))
    with plt.rc_context({"svg.fonttype": "none", "svg.hashsalt": "toftools", "font.size": 10}):
        size = (5.6 * len(panels), 4.8)
        fig, axes = plt.subplots(1, len(panels), figsize=size, squeeze=False, layout="constrained")
        for axis, (title, note, curves) in zip(axes.flat, panels, strict=True):
            for name, several in curves.items():
                for points in several:
                    _line(axis, points, target_m, name, looks[name], thin=len(several) > 1)
            _frame(axis, title, note, target_m)
        for kind, extra in (("png", {"dpi": 110}), ("svg", {"metadata": {"Date": None}})):
            fig.savefig(stem.with_suffix(f".{kind}"), **extra)
        plt.close(fig)


def _line(axis, points, target_m, name, look, *, thin):
    time, error = curve(points)
    if not len(time):
        return
    colour, marker = look
    style = {"color": colour, "lw": 0.8 if thin else 1.6, "alpha": 0.7 if thin else 1.0}
    axis.plot(time, 1e3 * error, marker=marker, ms=3 if thin else 5, label=name, **style)
    found = reach(points, target_m)
    if found.how == BEYOND:
        axis.plot([time[-1], found.seconds], [1e3 * error[-1], 1e3 * target_m], "--", **style)


def _frame(axis, title, note, target_m):
    import matplotlib.ticker

    axis.axhline(1e3 * target_m, color="#888", lw=0.8)
    axis.set(xscale="log", yscale="log", xlabel="time per frame, s",
             ylabel="root mean square range error, mm")  # fmt: skip
    axis.yaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_minor_formatter("")
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_formatter("{x:g}")
    axis.set_title(f"{title}\n" + "\n" * note.count("\n"), loc="left", fontsize=11,
                   fontweight="bold")  # fmt: skip
    axis.text(0, 1.015, note, transform=axis.transAxes, fontsize=8, color="#666", va="bottom")
    handles, labels = axis.get_legend_handles_labels()
    one = dict(zip(labels, handles, strict=True))
    axis.legend(one.values(), one.keys(), frameon=False, fontsize=8, loc="upper right")
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(color="#eee", which="both", lw=0.6)
    axis.set_axisbelow(True)
