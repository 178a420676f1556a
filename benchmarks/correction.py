"""The correction methods against each other: one run, one page.

python benchmarks/correction.py [--out docs/correction] [--quick] [--only SECTION ...] [--redraw]

Writes index.md, results.json and the pictures. Every section asks the whole registry: a method
that suits a sensor appears by itself, one that does not is listed with its own sentence.
Captures that others made are found through TOFTOOLS_DATA and the living room beside it, in
scenes/living-room; what is not there is left out and the page says so. Renderings are kept as
captures in --cache. With --only, the other sections stay as an earlier run left them; --redraw
measures nothing and writes the page anew (but for the maps of `auto`).
"""

import argparse
import importlib
import json
import os
import sys
import time
from pathlib import Path

from correction_methods import Job, plain

from toftools.bench.run import machine, versions

ROOT = Path(__file__).parents[1]
SECTIONS = {
    "planted": "Two planted returns",
    "diffuse": "Diffuse light between surfaces",
    "su": "Rendered frames that others made",
    "real": "Real captures",
    "auto": "`auto`: no worse than nothing",
    "speed": "Speed against accuracy",
}


def module_of(section):
    return importlib.import_module(f"correction_{section}")


def measured(job, section):
    """Result of a section, with the time it took and the number of methods asked."""
    begin = time.perf_counter()
    result = module_of(section).measure(job)
    return {**plain(result), "seconds": round(time.perf_counter() - begin, 1)}


def page(results, folder):
    """All sections as Markdown, in order; their pictures go into the folder."""
    about = results["about"]
    names = ", ".join(f"{key} {value}" for key, value in about["versions"].items())
    parts = [
        "# Correction methods against each other",
        f"Written by `python benchmarks/correction.py`{' --quick' if about['quick'] else ''}: "
        f"{names}; {about['machine']['cpu']}, {about['machine']['cores']} cores. "
        "[results.json](results.json) holds every figure.",
    ]
    for section, title in SECTIONS.items():
        if section in results["sections"]:
            result = results["sections"][section]
            parts.append(f"## {title}")
            parts.append(module_of(section).write(result, folder))
            parts.append(f"*This section took {result['seconds']:.0f} s.*")
    return "\n\n".join(parts) + "\n"


def earlier(folder, *, keep):
    """Sections that an earlier run left and this one does not make anew."""
    path = folder / "results.json"
    if not keep or not path.is_file():
        return {}
    return json.loads(path.read_text(encoding="utf-8"))["sections"]


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "correction")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "correction")
    parser.add_argument("--quick", action="store_true", help="tiny grids: does it run?")
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), default=[])
    parser.add_argument("--redraw", action="store_true", help="page and charts of results.json")
    parser.add_argument("--methods", nargs="+", default=[], help="names out of the registry")
    given = parser.parse_args(arguments)
    begin = time.perf_counter()

    def log(text):
        print(f"[{time.perf_counter() - begin:6.1f} s] {text}", file=sys.stderr, flush=True)

    if given.redraw:
        results = json.loads((given.out / "results.json").read_text(encoding="utf-8"))
        (given.out / "index.md").write_text(page(results, given.out), encoding="utf-8")
        return
    given.out.mkdir(parents=True, exist_ok=True)
    given.cache.mkdir(parents=True, exist_ok=True)
    job = Job(given.out, given.cache, log, given.quick, tuple(given.methods))
    sections = earlier(given.out, keep=bool(given.only))
    for section in given.only or SECTIONS:
        sections[section] = measured(job, section)
    about = {"versions": versions(), "machine": machine(os.cpu_count() or 1), "quick": given.quick}
    results = {"about": about, "sections": sections}
    text = json.dumps(results, allow_nan=False)
    (given.out / "results.json").write_text(text + "\n", encoding="utf-8")
    (given.out / "index.md").write_text(page(results, given.out), encoding="utf-8")
    log(f"wrote {given.out / 'index.md'}")


if __name__ == "__main__":
    main()
