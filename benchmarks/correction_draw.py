"""Pictures of the correction benchmark: curves as PNG and SVG, maps as PNG."""

import contextlib

import numpy as np

from toftools.viz.figures import no_answer

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#666666", "#8c564b")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
MODEL_COLOURS = ("#dddddd", "#56b4e9", "#e69f00", "#d55e00", "#009e73", "#cc79a7", "#0072b2")


@contextlib.contextmanager
def figure(stem, rows, columns, size, *, svg=False):
    """Axes (rows, columns) that are written to `stem`.png, and to .svg, at the end."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context({"svg.fonttype": "none", "svg.hashsalt": "toftools", "font.size": 9}):
        fig, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
        yield fig, axes
        fig.savefig(stem.with_suffix(".png"), dpi=110)
        if svg:
            fig.savefig(stem.with_suffix(".svg"), metadata={"Date": None})
        plt.close(fig)


def planted_figure(result, entry, name, stem):
    """One row per method: error, efficiency, outliers, error over sigma; the bound on top."""
    from matplotlib.colors import LogNorm, Normalize

    bound = np.array(entry["bound_m"], float)
    looks = (
        ("rms error, mm", "error_m", 1e3, "viridis_r", LogNorm(1, 1000)),
        ("efficiency: bound / rms", "efficiency", 1, "cividis", Normalize(0, 1)),
        ("outliers, %", "outliers", 100, "magma_r", Normalize(0, 100)),
        ("error / sigma", "spread", 1, "PuOr_r", LogNorm(0.1, 10)),
    )
    rows = [("bound", {"error_m": bound}), *entry["methods"].items()]
    with figure(stem, len(rows), len(looks), (13, 1.1 + 1.35 * len(rows))) as (fig, axes):
        for index, (line, (label, maps)) in enumerate(zip(axes, rows, strict=True)):
            last = index == len(rows) - 1
            shown = {key: np.array(maps[key], float) for key in maps if key in
                     ("error_m", "outliers", "spread")}  # fmt: skip
            if label != "bound":
                with np.errstate(invalid="ignore", divide="ignore"):
                    shown["efficiency"] = np.minimum(bound / shown["error_m"], 1)
            for axis, (title, key, factor, cmap, norm) in zip(line, looks, strict=True):
                if key not in shown:
                    axis.set_visible(False)
                    continue
                mesh = _map(axis, factor * shown[key], cmap, norm)
                _ticks(axis, result, bottom=last, left=key == "error_m")
                if index == (key != "error_m"):
                    axis.set_title(title, fontsize=10)
                if last:
                    bar = fig.colorbar(mesh, ax=axis, location="bottom", aspect=40, pad=0.02)
                    bar.outline.set(lw=0.4)
                    bar.ax.xaxis.set_major_formatter("{x:g}")
            line[0].set_ylabel(f"{label.partition(':')[0]}\nratio", fontsize=8, fontweight="bold")
        fig.suptitle(f"{name}: two returns; bottom row of each map: lone return", fontsize=12)


def _map(axis, values, cmap, norm):
    axis.add_patch(no_answer((0, 0, 1, 1), axis.transAxes))
    values = np.ma.masked_invalid(np.clip(values, norm.vmin, norm.vmax))
    return axis.pcolormesh(values, cmap=cmap, norm=norm, edgecolors="white", linewidth=0.3)


def _ticks(axis, result, *, bottom, left):
    """Separations below the lowest map, ratios at the left one."""
    separations, ratios = result["separations_m"], ["0", *(f"{r:g}" for r in result["ratios"])]
    axis.set_xticks(np.arange(len(separations)) + 0.5)
    axis.set_xticklabels([f"{s:g}" for s in separations] if bottom else [], fontsize=7)
    axis.set_yticks(np.arange(len(ratios)) + 0.5)
    axis.set_yticklabels(ratios if left else [], fontsize=6.5)
    axis.tick_params(length=0)
    if bottom:
        axis.set_xlabel("separation, m", fontsize=8)


def lines_figure(panels, stem, *, xlabel, ylabel, columns=2):
    """Panels of (title, {name: (x, y)}), both lists; one logarithmic y axis for all."""
    from matplotlib.ticker import LogLocator

    every = [y for _, curves in panels for _, ys in curves.values() for y in ys if y]
    low, high = max(min(every), max(every) / 1e5), max(every)  # one scale, to compare panels
    rows = -(-len(panels) // columns)
    names = list(dict.fromkeys(n for _, curves in panels for n in curves))
    looks = {n: (COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)])
             for i, n in enumerate(names)}  # fmt: skip
    with figure(stem, rows, columns, (6 * columns, 3.4 * rows + 0.5), svg=True) as (fig, axes):
        for axis in axes.flat[len(panels) :]:
            axis.set_visible(False)
        for axis, (title, curves) in zip(axes.flat, panels, strict=False):
            for n, (x, y) in curves.items():
                colour, marker = looks[n]
                y = np.array(y, float)
                axis.plot(
                    x, np.where(y > 0, y, np.nan), color=colour, marker=marker, ms=4.5, lw=1.4
                )
            axis.set_yscale("log")
            axis.set_title(title, loc="left", fontsize=10, fontweight="bold")
            axis.set(xlabel=xlabel, ylabel=ylabel)
            axis.set_ylim(low / 1.3, high * 1.3)
            axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter("")
            axis.grid(color="#e8e8e8", lw=0.6)
            axis.set_axisbelow(True)
            axis.spines[["top", "right"]].set_visible(False)
        _legend(fig, looks)


def _legend(fig, looks):
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=c, marker=m, ms=5, lw=1.4) for c, m in looks.values()]
    fig.legend(handles, list(looks), loc="outside lower center", ncols=4, frameon=False)


def model_maps(panels, names, stem):
    """Maps of the model that `auto` chose: (title, codes (H, W)); a legend with the shares."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    cmap = ListedColormap([MODEL_COLOURS[i % len(MODEL_COLOURS)] for i in range(len(names))])
    norm = BoundaryNorm(np.arange(len(names) + 1) - 0.5, len(names))
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    with figure(stem, rows, columns, (4.2 * columns, 3.6 * rows + 0.5)) as (fig, axes):
        for axis in axes.flat:
            axis.set_axis_off()
        for axis, (title, codes) in zip(axes.flat, panels, strict=False):
            axis.imshow(codes, cmap=cmap, norm=norm, interpolation="nearest")
            shares = [f"{n} {100 * np.mean(codes == i):.0f} %" for i, n in enumerate(names)
                      if (codes == i).any()]  # fmt: skip
            axis.set_title(f"{title}\n{', '.join(shares)}", loc="left", fontsize=8.5)
        handles = [Patch(color=cmap(i)) for i in range(len(names))]
        fig.legend(handles, names, loc="outside lower center", ncols=5, frameon=False)
