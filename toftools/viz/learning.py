"""Learning curves: loss and validation error against steps, one column per stage."""

from collections.abc import Mapping, Sequence

from toftools.viz._plots import labels, png, row

BLUE, RED, GREY = "#0072b2", "#d55e00", "#98a2b3"
Points = Sequence[Mapping[str, float]]


def curves_png(stages: Mapping[str, Points], *, title: str) -> bytes:
    """Learning curves of a training.

    Parameters
    ----------
    stages : mapping of str to sequence of mapping
        Points of each stage: ``step``, ``loss``, and where a stage is examined ``mae_cm``,
        ``median_cm`` and ``raw_cm`` on validation frames.
    title : str
        What was trained.

    Returns
    -------
    bytes
        A PNG.

    Raises
    ------
    ValueError
        If there is no point.
    """
    panels: list[tuple[str, Points, tuple[str, ...]]] = []
    for stage, points in stages.items():
        if points:
            panels.append((f"{stage}: loss", points, ("loss",)))
            if "mae_cm" in points[-1]:
                names = ("mae_cm", "median_cm", "raw_cm")
                panels.append((f"{stage}: error on validation frames", points, names))
    if not panels:
        msg = "got no point of a learning curve, wanted one or more"
        raise ValueError(msg)
    figure, axes = row(len(panels), 3.4)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    for ax, (name, points, keys) in zip(axes, panels, strict=True):
        steps = [point["step"] for point in points]
        errors = len(keys) > 1
        for key, colour in zip(keys, (BLUE, RED, GREY), strict=False):
            told = {"mae_cm": "mean", "median_cm": "median", "raw_cm": "mean, uncorrected"}
            ax.plot(steps, [point[key] for point in points], color=colour, lw=1.4, marker=".",
                    ms=3, label=told.get(key))  # fmt: skip
        labels(ax, name, "steps", "absolute error, cm" if errors else "mean loss")
        if errors:
            ax.set_yscale("log")
            ax.legend(fontsize=8, frameon=False)
    return png(figure)
