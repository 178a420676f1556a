"""Learned corrections: held-out scenes, albedos, foreign frames, time, steadiness.

    python benchmarks/learned.py --data DIR --networks DIR --out docs/learned [--only PART ...]

DIR of networks holds ONNX files by name (`toftools train`); those of the package are taken where it
is left out. Every part keeps its figures in OUT/results.json, so that one can be measured again
without the others; the page and the pictures come from there.
"""

import argparse
import json
import os
from pathlib import Path

import learned_card
import learned_draw
import learned_held_out
import learned_speed
import learned_steady
from learned_frames import errors_of, figures

from toftools.correct.network import WEIGHTS
from toftools.io.open import open_capture
from toftools.phasor import phasors_of
from toftools.registry import CORRECTIONS, find

PARTS = ("held_out", "albedo", "su", "speed", "steady")
TOFNET = "ToFNet, as published"
FAR_M = 9.9


def su(networks, log):
    """Frames rendered by Su et al. (CVPR 2018): never trained or tuned on."""
    folder = Path(os.environ.get("TOFTOOLS_DATA", "")) / "su2018_synth_40_70MHz"
    files = sorted(folder.glob("im_pair_*.mat"))
    asked = [("raw (crt)", "crt"), ("semi_global", "semi_global"), ("auto", "auto")]
    asked += [(p.stem, f"network:model={p}") for p in sorted(networks.glob("*40_70*.onnx"))]
    found = {}
    for path in files:
        capture = open_capture(path)
        log(f"su: {path.stem}")
        phasors = phasors_of(capture)
        answers = {
            label: find(CORRECTIONS, name).build(capture.sensor)(phasors) for label, name in asked
        }
        truth = capture.truth.range_m
        for label, depth in answers.items():
            found.setdefault(label, {})[path.stem] = figures(errors_of(depth.range_m, truth, FAR_M))
        for label, range_m in capture.reported.items():
            told = figures(errors_of(range_m, truth, FAR_M))
            found.setdefault(f"{label}, as published", {})[path.stem] = told
    return found


def steady(networks, log):
    """A camera that moves slowly."""
    names = [("raw (crt)", "crt"), ("semi_global", "semi_global"), ("fuchs2010", "fuchs2010")]
    names += [
        (p.stem, f"network:model={p}") for p in sorted(networks.glob("phasornet_40_70*.onnx"))
    ]
    return learned_steady.measure(names, log)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="data set of the held-out scenes")
    parser.add_argument("--albedo", type=Path, help="data set of rooms in six sets of albedos")
    parser.add_argument("--networks", type=Path, default=WEIGHTS)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "results.json"
    kept = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    parts = {
        "held_out": lambda: learned_held_out.measure(given.data, "test", given.networks, print),
        "albedo": lambda: learned_held_out.measure(
            given.albedo, "test", given.networks, print, key=lambda e: f"albedos {paint(e)}"
        ),
        "su": lambda: su(given.networks, print),
        "speed": lambda: learned_speed.measure(given.networks, print),
        "steady": lambda: steady(given.networks, print),
    }
    needs = {"held_out": given.data, "albedo": given.albedo}
    for name in given.only:
        if needs.get(name, given.out):
            kept[name] = parts[name]()
            path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    learned_draw.write(kept, given.out)
    (given.out / "model_card.md").write_text(learned_card.text(kept), encoding="utf-8")


def paint(entry):
    """Number of the set of albedos of a capture."""
    return int(entry["scene"].partition("paint=")[2].split(",")[0])


if __name__ == "__main__":
    main()
