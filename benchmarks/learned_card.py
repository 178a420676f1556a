"""Model cards of the networks that come with the package, out of their files and the figures."""

from learned_draw import cm, table

from toftools.correct._net_file import WEIGHTS, read_card, wanted

HEAD = """# Model card

Made by `python benchmarks/learned.py`; do not edit.
"""
USE = """## What they are for
Ranges of diffuse and slightly glossy scenes of 0.3 to 12 m, seen by one camera whose light sits at
the camera: `toftools correct CAPTURE -m network`, or `auto`, which takes their answer where their
sigma is below what it changes. Nothing in them knows persons; they were trained
on simulated furniture alone. Not for safety: nothing here is certified, and sigma is that of scenes
like those of training.

## Where they fail
- Wrong turns: which candidate is right is a choice, and sigma is that of a right choice. On frames
  of another renderer about one pixel in a hundred is a turn off ([index](index.md)), more than with
  `semi_global` there.
- `phasornet_20` in rooms whose range is off by more than half a metre everywhere: with one
  frequency the same network that takes nearly two thirds from the error of furnished rooms leaves
  more there than `deeptof2017` does.
- Frames of fewer pixels than 112 x 160: trainings know none (`auto` asks no network there).
- Slanted walls in the distance, closed boxes and cavities at 40 and 70 MHz: `semi_global` or
  `fuchs2010` err less there ([index](index.md), by family), and `auto`, which believes the
  network's sigma, goes along with it.
- Mirrors, glass, light through thin things, a second camera: none was in training.
- Surfaces out of view that are brighter or nearer than those of the training's rooms.
- Amplitudes that are not proportional to the light (calibrate them first): the pattern of
  reflectance is part of the input; its unit is not.
- Calibration errors of phase of more than some millimetres look like multipath.
- Frequencies other than those named, which are refused.

## How to make them again
```
toftools dataset make broad --out sets/broad
toftools train NAME --data sets/broad --out NAME.onnx
```
The same data set, seed, versions and number of threads give the same weights on the same kind of
machine; elsewhere sums round differently.
"""


def text(kept):
    """The page."""
    rows = []
    for path in sorted(WEIGHTS.glob("*.onnx")):
        card, data = read_card(path)
        told = kept.get("held_out", {}).get(path.stem, {})
        raw = "raw, 20 MHz" if len(card.freqs_hz) == 1 else "raw, 40 + 70 MHz"
        before = kept.get("held_out", {}).get(raw, {})
        rows.append([
            f"`{path.stem}`", wanted(card), f"{len(data) / 1e6:.2f} MB", card.licence, card.recipe,
            card.data, cm(before.get("mae_m", float("nan"))), cm(told.get("mae_m", float("nan"))),
            cm(told.get("median_m", float("nan"))), cm(told.get("p95_m", float("nan"))),
        ])  # fmt: skip
    head = ["network", "frequencies", "size", "licence", "recipe", "data", "raw MAE cm", "MAE cm",
            "median", "95 %"]  # fmt: skip
    said = "Errors on held-out scenes of the data set; by family, albedo and on frames of others: "
    return "\n".join([HEAD, table(head, rows), "", said + "[index](index.md).", "", USE])
