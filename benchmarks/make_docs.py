"""Docs that come out of code: docs/methods.md, docs/results.md, the README's table and pictures.

python benchmarks/make_docs.py            rewrite the pages and the README's table
python benchmarks/make_docs.py --pictures also simulate and draw docs/pictures/
python benchmarks/make_docs.py --results DIR  first take over DIR/results.jsonl of a finished run
"""

import argparse
import importlib
import inspect
import json
import re
import tempfile
from pathlib import Path

from toftools.bench.render import markdown_table, number
from toftools.bench.table import groups, summarise, unsuited
from toftools.registry import (
    CALIBRATIONS,
    CORRECTIONS,
    FACTORY,
    FILTERS,
    METRICS,
    READERS,
    SIMULATORS,
    parameters_of,
)
from toftools.sensors import PRESETS, SOURCES
from toftools.sim.analytic import SCENES
from toftools.sim.scenes import FILES, WORLDS

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "core.jsonl"
SRA_SETTING = "sra:grid_m=0.02"
KEPT = ("suite", "capture", "capture_id", "group", "method", "params", "against", "status",
        "error", "setup_s", "first_call_s", "ms", "ms_iqr", "peak_mb", "versions",
        "machine")  # fmt: skip


def first_sentence(thing):
    return re.split(r"(?<=\.)\s", inspect.getdoc(thing) or "")[0].replace("\n", " ")


def dials(make):
    return ", ".join(f"`{key}={value}`" for key, value in parameters_of(make).items()) or "none"


def module_of(spec):
    return importlib.import_module(spec.target.partition(":")[0])


def method_sections(table):
    for name, spec in table.items():
        make = spec.load()
        header = re.sub(r"References\n-+\n", "References: ", inspect.getdoc(module_of(spec)))
        grid = ", ".join(f"`{key}` {list(values)}" for key, values in spec.grid.items())
        yield f"### `{name}`\n\n{header}\n\n- Parameters: {dials(make)}"
        if spec.place:
            yield f"- Place: {spec.place} the correction"
        if grid:
            yield f"- Benchmark grid: {grid}"


def rows(table, head):
    yield f"| {' | '.join(head)} |\n|{'---|' * len(head)}"
    yield from (f"| {' | '.join(row)} |" for row in table)


def methods_md():
    metrics = [(f"`{n}`", s.unit or "1", s.better, first_sentence(s.load()))
               for n, s in METRICS.items()]  # fmt: skip
    readers = [(f"`{n}`", dials(s.load()), first_sentence(module_of(s)))
               for n, s in READERS.items()]  # fmt: skip
    parts = [
        "# Methods\n\nMade by `python benchmarks/make_docs.py` from the registry; do not edit.",
        "## Corrections\n\nA correction turns phasors into a depth map.",
        *method_sections(CORRECTIONS),
        "## Filters\n\nSteps before or after a correction, joined to a chain by `>` "
        "([docs/benchmark.md](benchmark.md#chains)).",
        *method_sections(FILTERS),
        "## Calibrations\n\nA calibration fits a stage to captures; a stage corrects phasors, taps "
        "or optics ([docs/calibration](calibration/index.md)).",
        *method_sections(CALIBRATIONS),
        "### Factory tables\n",
        "\n".join(rows([(f"`factory:{n}`", dials(s.load()), first_sentence(module_of(s)))
                        for n, s in FACTORY.items()], ("table", "parameters", "what"))),
        "## Simulators",
        *method_sections(SIMULATORS),
        "### Closed-form scenes\n",
        "\n".join(rows([(f"`{n}`", dials(f), first_sentence(f)) for n, f in SCENES.items()],
                       ("scene", "parameters", "what"))),
        "### Scenes with surfaces, for radiosity and path\n",
        "\n".join(rows([(f"`{n}`", dials(f), first_sentence(f)) for n, f in WORLDS.items()],
                       ("scene", "parameters", "what"))),
        "\n".join(rows([(" ".join(f"`{s}`" for s, f in FILES.items() if f is load), dials(load),
                         first_sentence(load)) for load in dict.fromkeys(FILES.values())],
                       ("file", "parameters", "what"))),
        "## Sensors\n",
        "\n".join(rows([(f"`{n}`", SOURCES[n]) for n in PRESETS], ("preset", "source"))),
        "Read noise 20 e-, full well 150 000 e-, contrast 0.8 and signal 20 000 e- at 1 m are "
        "assumed for every preset: makers do not publish them.",
        "## Readers\n",
        "\n".join(rows(readers, ("format", "parameters", "what"))),
        "## Metrics\n",
        "\n".join(rows(metrics, ("metric", "unit", "better", "what"))),
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def results_by_group():
    return groups(json.loads(line) for line in RESULTS.read_text().splitlines())


def measured_on(rows):
    machine = next(row["machine"] for row in rows if row.get("machine"))
    return f"{machine['cpu']}, {machine['threads']} threads; ms is the median per frame."


def results_md():
    """Every group of the committed run: docs/results.md."""
    first = next(iter(results_by_group().values()))
    sra = next(line for line in summarise(first) if line.label == SRA_SETTING)
    parts = [
        "# Results",
        "The suite `core`, made by `python benchmarks/make_docs.py`; do not edit. Errors in cm. "
        "`input` is the capture unwrapped with nothing done about multipath.",
        measured_on(first),
        f"`{SRA_SETTING}` takes {sra.ms:.1f} ms per 320 x 240 frame at "
        f"{100 * sra.metrics['mae_m']:.2f} cm MAE. Thesis table 7.1 quotes 31.2 ms for the "
        "authors' own SRA, on one machine of 2014, with another frame size and other frequencies.",
        "Unwrapping against distance and noise: [long_range](long_range/long_range.md).",
    ]
    for name, mine in results_by_group().items():
        captures = ", ".join({row["capture_id"]: row["capture"] for row in mine}.values())
        parts.append(f'## {name}\n\nCaptures, in the order of "of each": {captures}.')
        parts.append(markdown_table(summarise(mine)))
        parts += [f"{sentence}" for sentence in unsuited(mine)]
    return "\n\n".join(parts) + "\n"


def readme_md():
    """The short table of the README: one group, the columns one looks at first."""
    mine = next(iter(results_by_group().values()))
    table = [
        (
            f"`{line.label}`",
            number(line.metrics["mae_m"], 100),
            number(line.metrics["median_m"], 100),
            number(line.metrics["wrap_share"], 100),
            number(line.ms),
        )
        for line in summarise(mine)
    ]
    head = ("method", "MAE cm", "median cm", "wrong wraps %", "ms per frame")
    return "\n".join(rows(table, head)) + f"\n\n{measured_on(mine)}"


def replace_block(text, name, block):
    pattern = rf"(<!-- {name} -->).*?(<!-- /{name} -->)"
    new, count = re.subn(pattern, lambda m: f"{m[1]}\n{block}\n{m[2]}", text, flags=re.DOTALL)
    assert count == 1, f"README has no block {name}"
    return new


def take_results(folder):
    """Keep what tables need; curves stay in the run's folder."""
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    shown = (
        "mae_m",
        "median_m",
        "p95_m",
        "bias_m",
        "under_1cm",
        "wrap_share",
        "valid_share",
        "coherence",
    )
    lines = []
    for line in (folder / "results.jsonl").read_text().splitlines():
        row = json.loads(line)
        small = {key: row[key] for key in KEPT}
        small["metrics"] = {
            key: float(f"{value:.6g}")
            for key, value in row["metrics"].items()
            if key.removeprefix("input_") in shown and value is not None
        }
        lines.append(json.dumps(small))
    RESULTS.write_text("\n".join(lines) + "\n")


def pictures():
    import numpy as np

    from toftools.bench.pareto import pareto
    from toftools.camera import points
    from toftools.correct.crt import crt
    from toftools.sensors import sensor
    from toftools.sim.analytic import analytic
    from toftools.types import Scene, Shot
    from toftools.viz.cloud import cloud_png
    from toftools.viz.figures import maps_png
    from toftools.viz.preview import preview_png

    folder = ROOT / "docs" / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    device = sensor("opt8241:width=200,height=150")
    capture = analytic(Scene("corner", {"range": 2.0, "albedo": 0.8}))(Shot(device, seed=1))
    depth = crt(device)(capture.phasors)
    panels = [
        ("truth", capture.truth.range_m, "range"),
        ("crt: multipath left in", depth.range_m - capture.truth.range_m, "error"),
        ("sigma from the noise model", depth.sigma_m, "sigma"),
    ]
    (folder / "corner.png").write_bytes(maps_png(panels, columns=3))
    shown = np.where(np.isfinite(capture.truth.range_m), depth.range_m, np.nan)
    cloud = cloud_png(points(device.camera, shown), shown, size=(900, 560))
    (folder / "cloud.png").write_bytes(cloud)
    scene, wide = Scene("room", {"seed": 8}), sensor("kinect2:width=128,height=106,beam_deg=100")
    room = SIMULATORS["path"].build(scene)(Shot(wide, tol_m=5e-3))
    (folder / "room.png").write_bytes(preview_png(room, title="room:seed=8 seen by a kinect2"))
    name, mine = next(iter(results_by_group().items()))
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "figures").mkdir()
        svg = pareto(Path(place), mine, summarise(mine), title=name, stem="pareto")
    (folder / "pareto.svg").write_text(svg, encoding="utf-8")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path)
    parser.add_argument("--pictures", action="store_true")
    args = parser.parse_args()
    if args.results:
        take_results(args.results)
    (ROOT / "docs" / "methods.md").write_text(methods_md(), encoding="utf-8")
    readme = ROOT / "README.md"
    (ROOT / "docs" / "results.md").write_text(results_md(), encoding="utf-8")
    readme.write_text(replace_block(readme.read_text(encoding="utf-8"), "results", readme_md()),
                      encoding="utf-8")  # fmt: skip
    if args.pictures:
        pictures()


if __name__ == "__main__":
    main()
