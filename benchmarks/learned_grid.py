"""What the parts of a learned correction are worth: recipes that differ in one thing, equal steps.

    python benchmarks/learned_grid.py train --data DIR --networks DIR
    python benchmarks/learned_grid.py measure --data DIR --networks DIR --out docs/learned

The recipes stand in learned_grid/. Their trainings are short, so that all of them take about an
hour: they are compared with each other, not with the networks that ship.
"""

import argparse
import json
from pathlib import Path

import learned_held_out
import learned_speed
from learned_draw import cm, pareto, table

from toftools.train.recipe import read_train_recipe
from toftools.train.run import run

RECIPES = Path(__file__).parent / "learned_grid"
SAID = {
    "phasornet_32": "16, 32 and 64 channels",
    "phasornet_48": "32, 48 and 96 channels",
    "phasornet_64": "32, 64 and 128 channels",
    "phasornet_96": "48, 96 and 192 channels",
    "phasornet_no_bounce": "as phasornet_48, without the light of one bounce",
    "phasornet_no_physics": "as phasornet_48, without bounced light, residuals, candidates and "
    "reflectance: range, direction, and on the coarse grid normals",
    "deeptof2017_short": "additions of the encoder's features, pre-trained",
    "deeptof2017_no_pretraining": "all layers trained from the start, for as many steps in all",
    "deeptof2017_concat": "concatenation instead of addition",
    "deeptof2017_no_skip": "no skips at all",
}
PAGE = """# What the parts are worth

Made by `python benchmarks/learned_grid.py measure`; do not edit. Recipes that differ in one thing,
trained for equally many steps (`benchmarks/learned_grid/`), on held-out scenes. Trainings as short
as these are for comparison; what ships was trained longer: [index](index.md).

## Inputs and sizes of phasornet, 40 and 70 MHz
"""
SPEED = """
## Error against time, by width, in floats and eight bits
Median milliseconds of the whole correction on two cores.

![Error against time](grid.png)

"""
DEEPTOF = """
## The stages and skips of deeptof2017, 20 MHz
"""


def train(data, networks):
    """Every recipe, one after the other; those that are there are left."""
    networks.mkdir(parents=True, exist_ok=True)
    for path in sorted(RECIPES.glob("*.toml")):
        out = networks / f"{path.stem}.onnx"
        if out.is_file():
            continue
        eight = networks / f"{path.stem}_int8.onnx"
        print(path.stem)
        run(read_train_recipe(path), data, out, networks / path.stem, eight, print)


def measure(data, networks, log):
    """Held-out errors of all, milliseconds of networks of phasors."""
    return {
        "errors": learned_held_out.measure(data, "test", networks, log, physics=("crt",)),
        "speed": learned_speed.measure(networks, log),
    }


def rows(errors, kind):
    """A line per network of a kind."""
    found = []
    for label, told in errors.items():
        name = label.removesuffix("_int8")
        if name.startswith(kind) and label == name:
            eight = errors.get(f"{name}_int8", {}).get("mae_m", float("nan"))
            found.append([f"`{name}`", SAID.get(name, ""), cm(told["mae_m"]), cm(told["median_m"]),
                          cm(told["p95_m"]), f"{100 * told['wrong']:.2f}", cm(eight)])  # fmt: skip
    head = ["recipe", "what it has", "MAE cm", "median", "95 %", "> 0.5 m, %", "MAE in 8 bits"]
    return table(head, found)


def write(kept, folder):
    """The page and its chart."""
    errors, speed = kept["errors"], kept["speed"]
    widths = {n: f for n, f in speed.items() if "no_" not in n}
    pareto(widths, errors, folder / "grid")
    raw = {label: cm(f["mae_m"]) for label, f in errors.items() if label.startswith("raw")}
    said = "\nUncorrected: " + "; ".join(
        f"{k.removeprefix('raw, ')} {v} cm" for k, v in raw.items()
    )
    sizes = [k for k in next(iter(widths.values())) if "x" in k]
    times = [
        [f"`{n}`", cm(errors[n]["mae_m"]), *(f"{f[size]['whole']:.1f}" for size in sizes)]
        for n, f in widths.items()
    ]
    text = [PAGE, rows(errors, "phasornet"), said + ".", SPEED,
            table(["network", "MAE cm", *(f"{size}, ms" for size in sizes)], times), DEEPTOF,
            rows(errors, "deeptof"), ""]  # fmt: skip
    (folder / "parts.md").write_text("\n".join(text), encoding="utf-8")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("train", "measure"))
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--networks", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("docs/learned"))
    given = parser.parse_args(arguments)
    if given.what == "train":
        train(given.data, given.networks)
        return
    given.out.mkdir(parents=True, exist_ok=True)
    kept = measure(given.data, given.networks, print)
    (given.out / "parts.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    write(kept, given.out)


if __name__ == "__main__":
    main()
