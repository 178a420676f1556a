"""Wiggling of two real cameras: what the stages leave, on data that their fits did not see.

Needs the files of TOFTOOLS_DATA. Writes real.md and pictures; the Melexis data have no stated
licence, so the page shows fitted curves only. `--binned FILE` draws them over the data, for your
own eyes.
"""

import argparse
import os
import sys
from pathlib import Path

import calibration_sweeps as sweeps
import numpy as np
from correction_draw import COLOURS, figure

from toftools.calib._basis import fourier
from toftools.calib._grams import held_out, leftover, products, solved
from toftools.calib._wiggling_data import gather
from toftools.calib.wiggling import wiggling
from toftools.calib.wiggling_lut import wiggling_lut
from toftools.calib.wiggling_spline import wiggling_spline
from toftools.conditions import Conditions, with_conditions
from toftools.io.readers.melexis_npy import read
from toftools.units import phase_to_range

MELEXIS = "snapshot_lidar_mlx75027_60MHz"
TANAKA = "tanaka_kinect2_distortion"
FREQ_HZ = 60e6
PLAIN = (1, 2, 4)
MODELS = {
    "Fourier, order chosen": lambda c: wiggling(c),
    "Fourier, orders 1 to 4": lambda c: wiggling(c, harmonics=4),
    "cubic spline, knots chosen": lambda c: wiggling_spline(c),
    "table, 16 knots": lambda c: wiggling_lut(c),
    "table, knots chosen": lambda c: wiggling_lut(c, knots=0),
}
REPOSITORY = "https://github.com/ken1row/libfreenect2_altered"


def mm(phase_rad):
    return 1e3 * phase_to_range(phase_rad, FREQ_HZ)


def melexis(folder):
    """The capture, with the vendor's distance as reference."""
    return with_conditions(read(folder / MELEXIS), Conditions("wall", reference="depth"))


def plain(capture):
    """Orders 1, 2, 4 by least squares: rms after, on blocks left out, largest coefficient, mm."""

    def columns(phase):
        return np.hstack([fourier(order * phase, 1) for order in PLAIN])

    (samples,) = gather([capture])
    grams = products(samples, columns, samples.weight, samples.weight)
    nothing = np.zeros((2 * len(PLAIN), 2 * len(PLAIN)))
    theta = solved(grams.total, nothing)
    model = columns(samples.phase_rad.ravel()) @ theta[:-1]
    rest = leftover(samples, samples.weight, model.reshape(samples.phase_rad.shape))
    used = samples.weight > 0
    unseen = held_out(grams, nothing).sum() / grams.weight.sum()
    largest = np.abs(theta[:-1]).max()
    return float(mm(rest[used].std())), float(mm(np.sqrt(unseen))), float(mm(largest))


def any_curve(capture, width_rad=0.02):
    """What the best function of phase leaves: the means of narrow bins, mm."""
    (samples,) = gather([capture])
    used = samples.weight > 0
    place = np.floor(samples.phase_rad[used] / width_rad).astype(int)
    place -= place.min()
    error = samples.error_rad[used]
    counts = np.bincount(place)
    means = np.bincount(place, error) / np.maximum(counts, 1)
    middle = (np.arange(counts.size) + 0.5) * width_rad + np.floor(
        samples.phase_rad[used].min() / width_rad
    ) * width_rad
    busy = counts > 50
    rest = float(mm((error - means[place]).std()))
    return rest, middle[busy], mm(means[busy] - means[busy].mean())


def size_of(stage):
    """Order or knots of the one frequency."""
    return stage.harmonics[0] if hasattr(stage, "harmonics") else stage.knots[0]


def melexis_page(capture, fits):
    """Text of the Melexis part."""
    before = next(iter(fits.values())).residual
    span = float(next(iter(fits.values())).covered.mean() * 2 * np.pi)
    after, unseen, largest = plain(capture)
    rows = [
        f"| {name} | {size_of(s)} | {s.residual.after:.2f} | {s.residual.held_out:.2f} |"
        for name, s in fits.items()
    ]
    return f"""## Melexis MLX75027, 60 MHz, one scene

Phase of four taps against the vendor's own distance (one averaged frame of a scene,
{before.n} pixels above 60 DN of amplitude; github.com/dartmouth-risc-lab/snapshot-lidar, no licence
stated, so no data are shown). Their difference is a function of phase, presumably the vendor's
wiggling calibration. After a constant it has **{before.before:.2f} mm** rms. All figures are plain
root mean squares over all these pixels; *held out* is the error of each of 64 blocks of 80 x 48
pixels by a fit of all others.

| model | size | after, mm | held out, mm |
|---|---:|---:|---:|
| least squares, orders 1, 2, 4 | 3 | {after:.2f} | {unseen:.2f} |
{chr(10).join(rows)}
| mean of every 0.02 rad | – | {any_curve(capture)[0]:.2f} | – |

The last line is what any function of phase must leave: the rest hangs on the pixel (fixed pattern),
which one capture cannot tell from wiggling. Sizes were chosen by the held-out blocks and the rule
of one standard error. Phases fill {span:.1f} of 6.3 rad, so single coefficients mean nothing: those
of orders 1, 2, 4 by least squares reach {largest:.0f} mm and cancel. Elsewhere the curves are drawn
towards 0 (dotted).

![Fitted curves](real_melexis.png)
"""


def melexis_figure(fits, stem, data=None):
    """Fitted curves where they have data; over binned errors if given."""
    phase = np.linspace(-np.pi, np.pi, 721)
    with figure(stem, 1, 1, (7, 3.6)) as (_, axes):
        axis = axes[0, 0]
        if data is not None:
            axis.plot(*data, ".", color="#999999", label="mean error per 0.02 rad")
        for colour, (name, stage) in zip(COLOURS, fits.items(), strict=False):
            seen = stage.covered[0][((phase % (2 * np.pi)) * (64 / (2 * np.pi))).astype(int) % 64]
            curve = mm(stage.error_rad(phase[None])[0])
            middle = curve[seen].mean()
            axis.plot(phase, curve - middle, ":", color=colour, lw=0.8)
            axis.plot(phase, np.where(seen, curve - middle, np.nan), color=colour, label=name)
        axis.set(xlabel="measured phase, rad", ylabel="measured minus true, mm", xlim=(-3.2, 3.2))
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)


def sweep_results(folder):
    """Per row of the files and per kind of model: orders, residuals and the model of all data."""
    found = {}
    for row in sweeps.ROWS:
        data = sweeps.read(folder / TANAKA, row)
        for shifts in (False, True):
            orders, errors = sweeps.chosen(data, shifts=shifts)
            every = np.ones(data.values.shape[1], bool)
            model = sweeps.fit(data, orders, shifts=shifts, train=every)
            found[row, shifts] = {
                "data": data,
                "model": model,
                "after": sweeps.spread(sweeps.residual(data, model)),
                "blocks": errors[orders],
                "singles": sweeps.held_out(data, orders, shifts=shifts, block=1),
            }
    return found


def summary(rest):
    """Median, worst and pooled standard deviation."""
    each = sweeps.spread(rest)
    return f"{np.median(each):.2f} | {each.max():.2f} | {np.sqrt(np.nanmean(rest**2)):.2f}"


def sweeps_page(found):
    """Text of the Kinect part."""
    lines = []
    for (row, shifts), one in found.items():
        data, before = one["data"], sweeps.straight(one["data"])
        if not shifts:
            lines.append(f"| {row} | before: a line | – | – | – | {summary(before)} |")
        kind = "and a shift per frequency" if shifts else "common curves and a line"
        name = ", ".join(map(str, one["model"].orders))
        for title, key in (("blocks of 15 mm", "blocks"), ("every 5th position", "singles")):
            median = np.median(one["after"])
            lines.append(
                f"| {row} | {kind} | {name} | {median:.2f} | {title} | {summary(one[key])} |"
            )
        if shifts:
            quiet = np.median(sweeps.noise(data))
            lines.append(f"| {row} | noise alone | – | – | – | {quiet:.2f} | – | – |")
    return f"""## Kinect v2, 20 materials on a stage

Differences of the ranges of two frequencies at 200 stage positions, 3 mm apart (K. Tanaka et al.,
"Material classification using frequency- and depth-dependent time-of-flight distortion", CVPR
2017; files of <{REPOSITORY}>, Apache-2.0 or GPL-2). Where the stage starts is not told; neither is
amplitude. One model serves all materials: Fourier series of the phase of either frequency, orders
that three taps make (multiples of 3). A material has a line of its own, and in the wider model a
shift of either curve; both belong to the material, not to wiggling. Orders were chosen by held-out
blocks of five positions and the rule of one standard error. Standard deviations over the positions
of a material, mm; *pooled* is over all materials.

| difference | model | orders | after, median | held out | median | worst | pooled |
|---|---|---|---:|---|---:|---:|---:|
{chr(10).join(lines)}

![Common curves and residuals](real_sweeps.png)

### What is material

Shift against the median material at the middle of the stage (from the line), mm, and the held-out
residual of every material with shifts, blocks of 15 mm, mm.

{material_table(found)}

Light enters acryl and silicone and comes back later; at 16 MHz by 20 to 36 mm more than at 120 MHz.
They are also the ones that the common curves alone fit worst. The shifts of the curves (last two
columns) are no such delays: they are larger than those, and aluminium, which no light enters, has
one, too. They stand for whatever makes the cyclic error of these materials differ, presumably
amplitude, which the files do not hold. Without them the common curves and a line meet 1 mm with
half of the materials only. Blocks at the two ends of the stage are extrapolations and about twice
as bad as those between.
"""


def material_table(found):
    """One line per material."""
    high, low = found["d80 - d120", True], found["d16 - d120", True]
    plain_high = found["d80 - d120", False]
    names = high["data"].names
    shift = high["model"].shift - np.median(high["model"].shift, axis=0)
    columns = (
        sweeps.offsets(high["data"], high["model"]),
        sweeps.offsets(low["data"], low["model"]),
        sweeps.spread(sweeps.straight(high["data"])),
        sweeps.spread(plain_high["blocks"]),
        sweeps.spread(high["blocks"]),
        shift[:, 0],
        shift[:, 1],
    )
    head = (
        "| material | d80 - d120 | d16 - d120 | before | held out, line | held out, shifts "
        "| curve 80 MHz | curve 120 MHz |\n|---|---:|---:|---:|---:|---:|---:|---:|"
    )
    rows = [
        f"| {name} | " + " | ".join(f"{column[k]:.1f}" if i < 2 or i > 4 else f"{column[k]:.2f}"
                                     for i, column in enumerate(columns)) + " |"
        for k, name in enumerate(names)
    ]  # fmt: skip
    return "\n".join([head, *rows])


def sweeps_figure(found, stem):
    """Common curves, and standard deviations before and after, per material."""
    one, line = found["d80 - d120", True], found["d80 - d120", False]
    data, model = one["data"], one["model"]
    with figure(stem, 1, 2, (11, 3.8)) as (_, axes):
        left, right = axes[0]
        half = len(model.theta) // 2
        for colour, part, label in zip(COLOURS, (0, 1), ("80 MHz", "120 MHz"), strict=False):
            only = np.zeros_like(model.theta)
            only[part * half : (part + 1) * half] = model.theta[part * half : (part + 1) * half]
            curve = sweeps.columns(data, model.orders, np.median(model.shift, axis=0)) @ only
            left.plot(
                data.position, (1, -1)[part] * (curve - curve.mean()), color=colour, label=label
            )
        left.set(xlabel="stage position, mm", ylabel="common cyclic error, mm")
        left.legend()
        left.grid(alpha=0.3)
        at = np.arange(len(data.names))
        bars = (
            ("before", sweeps.spread(sweeps.straight(data))),
            ("held out, common curves", sweeps.spread(line["blocks"])),
            ("held out, shifts as well", sweeps.spread(one["blocks"])),
        )
        for k, (colour, (label, values)) in enumerate(zip(COLOURS, bars, strict=False)):
            right.bar(at + 0.27 * (k - 1), values, 0.27, color=colour, label=label)
        right.axhline(1, color="k", lw=0.7)
        right.set_xticks(at, data.names, rotation=90, fontsize=7)
        right.set(ylabel="standard deviation, mm")
        right.legend(fontsize=7)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/calibration"))
    parser.add_argument("--binned", type=Path, help="picture of the Melexis curves over the data")
    args = parser.parse_args()
    folder = Path(os.environ.get("TOFTOOLS_DATA", "missing"))
    if not folder.is_dir():
        sys.exit("TOFTOOLS_DATA names no folder of real captures")
    args.out.mkdir(parents=True, exist_ok=True)
    capture = melexis(folder)
    fits = {name: make([capture]) for name, make in MODELS.items()}
    shown = {name: fits[name] for name in fits if "orders" not in name and "16" not in name}
    melexis_figure(shown, args.out / "real_melexis")
    if args.binned:
        melexis_figure(shown, args.binned, any_curve(capture)[1:])
    found = sweep_results(folder)
    sweeps_figure(found, args.out / "real_sweeps")
    page = (
        "# Wiggling of real cameras\n\nWritten by `python benchmarks/calibration_real.py` from the "
        "files of TOFTOOLS_DATA.\n\n" + melexis_page(capture, fits) + "\n" + sweeps_page(found)
    )
    (args.out / "real.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
