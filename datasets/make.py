"""Make a set of captures again from its recipe, and its part of MANIFEST.toml.

python datasets/make.py datasets/first.toml                 where the recipe says, manifest and all
python datasets/make.py datasets/first.toml --out DIR       elsewhere, without a manifest
"""

import hashlib
import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import click

from toftools.io.native import write_capture
from toftools.registry import SIMULATORS, find, parse_entry
from toftools.sensors import sensor
from toftools.sim.choice import choose
from toftools.types import Capture, Scene, Shot

ROOT = Path(__file__).parent.parent
MANIFEST = ROOT / "datasets" / "MANIFEST.toml"
HEAD = "# Made by datasets/make.py; do not edit. Ranges in m, standard errors in mm."
TOLD = ("engine", "max_bounces", "samples", "standard_error_mm", "tolerance_mm", "left_out_mm")


def read_recipe(path):
    """A recipe, its scenes as tables with all their keys."""
    recipe = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    usual = {key: recipe[key] for key in ("sensor", "tol_mm", "seed")}
    tables = [{"scene": s} if isinstance(s, str) else s for s in recipe["scenes"]]
    recipe["scenes"] = [{**usual, **table} for table in tables]
    for number, item in enumerate(recipe["scenes"]):
        item["seed"] += number  # no two captures share their noise
    return recipe


def file_name(item):
    """Capture file of a scene."""
    return re.sub(r"[^A-Za-z0-9_.]+", "-", item["scene"]).strip("-") + ".h5"


def make(item, seed=None):
    """The capture of one entry of a recipe; taps and truth, from which phasors follow."""
    scene = Scene(*parse_entry(item["scene"]))
    seed = item["seed"] if seed is None else seed
    shot = Shot(sensor(item["sensor"]), seed=seed, tol_m=1e-3 * item["tol_mm"])
    engine, why = choose(scene, shot.sensor)
    capture: Capture = find(SIMULATORS, engine).build(scene)(shot)
    told = {**capture.provenance, "engine_why": why}
    return replace(capture, phasors=None, provenance=told)


def entry(path, item, capture):
    """One table of the manifest."""
    told = {key: capture.provenance.get(key) for key in TOLD}
    facts = {"file": path.name, "scene": item["scene"], **item, **told,
             "bytes": path.stat().st_size,
             "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}  # fmt: skip
    lines = [f"{key} = {_toml(value)}" for key, value in facts.items() if value is not None]
    return "\n".join(["[[capture]]", *lines])


def _toml(value):
    return f"{value:.4g}" if isinstance(value, float) else json.dumps(value)


@click.command()
@click.argument("recipe_file", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=None)
def command(*, recipe_file, out):
    """Make the captures of RECIPE_FILE."""
    recipe = read_recipe(recipe_file)
    folder = out or ROOT / recipe["folder"]
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for item in recipe["scenes"]:
        capture = make(item)
        path = folder / file_name(item)
        write_capture(path, capture)
        entries.append(entry(path, item, capture))
        error = capture.provenance.get("standard_error_mm")
        click.echo(f"{path.name}: {path.stat().st_size} bytes, {error:.2g} mm")
    if out is None:
        about = [f"{key} = {_toml(recipe[key])}" for key in ("name", "about", "folder")]
        text = "\n".join([HEAD, "", *about, f"recipe = {_toml(recipe_file.name)}"])
        MANIFEST.write_text("\n\n".join([text, *entries]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    command()
