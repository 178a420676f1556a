"""First stage: every capture of a suite as a capture file, every point as a line of a plan.

``DIR/captures/<id>.h5`` and ``DIR/plan.json``; ids come from content, so that a second run finds
what the first one made.
"""

import json
import logging
import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from toftools.bench.fingerprint import capture_digest, digest, package_digest
from toftools.bench.methods import check_method, points, setting
from toftools.bench.references import REFERENCES
from toftools.bench.source import Source
from toftools.bench.suite import Suite, expand
from toftools.io.atomic import atomic_path
from toftools.io.native import read_capture, write_capture
from toftools.io.open import open_capture
from toftools.registry import SIMULATORS, find, parse_entry
from toftools.sensors import sensor
from toftools.sim.choice import choose
from toftools.types import Capture, Scene, Shot

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Point:
    """One benchmark point.

    Parameters
    ----------
    capture : str
        Capture id: file stem under ``captures/``.
    method : str
        Registry name, ``module:function`` or a chain.
    params : mapping
        Parameters of the method.
    """

    capture: str
    method: str
    params: Mapping[str, Any]

    @property
    def key(self) -> str:
        """File stem of the point under ``runs/``."""
        mark = digest([self.capture, self.method, dict(self.params)])[:8]
        return f"{self.capture}--{_slug(self.method)}-{mark}"


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.]+", "-", text).strip("-")[:60]


def write_json(path: Path, value: Any) -> None:  # noqa: ANN401 - any JSON value
    """Write JSON atomically.

    Parameters
    ----------
    path : Path
        Target.
    value : object
        JSON value.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=True), encoding="utf-8")


def make_folders(out: Path) -> None:
    """Make the folders of a benchmark.

    Parameters
    ----------
    out : Path
        Benchmark folder.

    Raises
    ------
    ValueError
        If it cannot be made.
    """
    try:
        (out / "captures").mkdir(parents=True, exist_ok=True)
        (out / "runs").mkdir(exist_ok=True)
    except OSError as error:
        msg = f"cannot write {out}: {error.strerror or error}; choose a writable folder"
        raise ValueError(msg) from error


def make_plan(suite: Suite, out: Path, extra_methods: tuple[str, ...] = ()) -> list[Point]:
    """Ingest the captures of a suite and write the plan.

    Parameters
    ----------
    suite : Suite
        What to run.
    out : Path
        Output folder; made if missing.
    extra_methods : tuple of str
        Methods on top of the suite's.

    Returns
    -------
    list of Point
        All points, whether finished or not.

    Raises
    ------
    ValueError
        If a capture cannot be read, or none is left.
    """
    methods = (*suite.methods, *extra_methods)
    for text in methods:
        check_method(text, suite.grid)
    make_folders(out)
    listed = [(source, item) for source in suite.sources for item in _ingest(source, suite, out)]
    captures = [item for source, item in listed if not source.ladder]
    # The climbs of ladders: captures that several rungs or ladders share are listed once.
    climbs = [
        (source, Point(str(item["id"]), *setting(source.method)))
        for source, item in listed
        if source.ladder
    ]
    known = {item["id"] for item in captures}
    shared = {item["id"]: item for source, item in listed if item["id"] not in known}
    if not listed:
        msg = f"suite {suite.name} found no capture; set TOFTOOLS_DATA or give scenes"
        raise ValueError(msg)
    found = [
        Point(str(item["id"]), method, params)
        for item in captures
        for text in methods
        for method, params in points(text, suite.grid)
        if method not in REFERENCES or _applies(method, params, item)
    ]
    every = [*found, *(point for _, point in climbs)]
    plan = list({point.key: point for point in every}.values())  # a setting named twice runs once
    write_json(
        out / "plan.json",
        {
            "suite": suite.name,
            "repeats": suite.repeats,
            # JSON has no infinity: no limit is null.
            "mask": {
                "min_range_m": suite.min_range_m,
                "max_range_m": suite.max_range_m if math.isfinite(suite.max_range_m) else None,
            },
            "axes": {s.axis: s.about for s in suite.sources if s.axis},
            "ladders": _ladders(climbs, {point.key for point in found}),
            "captures": [*captures, *shared.values()],
            "points": [asdict(point) for point in plan],
        },
    )
    return plan


def _ladders(
    climbs: Iterable[tuple[Source, Point]], others: Collection[str]
) -> dict[str, dict[str, Any]]:
    """Every ladder with its rungs, and the points of every rung by scene.

    ``own`` are the points that nothing else of the suite asks for.
    """
    found: dict[str, dict[str, Any]] = {}
    for source, point in climbs:
        ladder = found.setdefault(
            source.ladder, {"about": source.about, "within_m": source.within_m, "rungs": {},
                            "own": []},
        )  # fmt: skip
        rung = ladder["rungs"].setdefault(
            f"{source.rung:.12g}",
            {"rung": source.rung, "label": source.label, "method": source.method, "scenes": {}},
        )
        rung["scenes"].setdefault(source.text, []).append(point.key)
        if point.key not in others and point.key not in ladder["own"]:
            ladder["own"].append(point.key)
    return {
        name: {**ladder, "rungs": list(ladder["rungs"].values())} for name, ladder in found.items()
    }


def read_plan(out: Path) -> tuple[dict[str, Any], list[Point]]:
    """The plan in a folder.

    Parameters
    ----------
    out : Path
        Folder that ``bench run`` filled.

    Returns
    -------
    dict, list of Point
        Plan and points.

    Raises
    ------
    ValueError
        If there is none, or it is damaged.
    """
    try:
        plan = json.loads((out / "plan.json").read_text(encoding="utf-8"))
        if plan["mask"]["max_range_m"] is None:
            plan["mask"]["max_range_m"] = math.inf
        return plan, [Point(**point) for point in plan["points"]]
    except FileNotFoundError:
        msg = f"no benchmark in {out}; start with: toftools bench run SUITE --out {out}"
        raise ValueError(msg) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        msg = f"{out / 'plan.json'} is damaged ({error}); run the suite again"
        raise ValueError(msg) from error


def _applies(method: str, params: Mapping[str, Any], item: Mapping[str, Any]) -> bool:
    """Whether a reference row exists for a capture."""
    if method == "reported":
        return bool(item["reported"]) and params.get("name", "") in ("", *item["reported"])
    return bool(item["truth"]) and int(params.get("freq_index", 0)) < int(item["n_freqs"])


def _ingest(source: Source, suite: Suite, out: Path) -> Iterator[dict[str, Any]]:
    if source.sensor is not None:
        name = _slug(source.text)
        wish = [source.text, source.sensor, source.engine, source.tol_mm, source.claimed]
        mark = digest([*wish, source.seed, package_digest()])[:8]
        yield _store(source, name, out / "captures" / f"{name}-{mark}.h5", lambda: _shot(source))
        return
    if source.unless in os.environ:
        log.info("left out %s: %s is set", source.text, source.unless)
        return
    files = expand(source, suite.folder)
    if files is None:
        log.warning("left out %s: the environment variable is not set", source.text)
        return
    if not files:
        msg = f"no file matches {source.text!r}, relative to {suite.folder}"
        raise ValueError(msg)
    for file in files:
        # A reader may open files beside this one: the digest is of what it made of them all.
        capture = open_capture(file, source.format)
        name = _slug(file.stem)
        path = out / "captures" / f"{name}-{capture_digest(capture)[:8]}.h5"
        yield _store(source, name, path, partial(_same, capture))


def _same(capture: Capture) -> Capture:
    return capture


def _shot(source: Source) -> Capture:
    device = sensor(str(source.sensor))
    light_seed = 0 if source.axis or source.ladder else None  # they share what light they can
    shot = Shot(device, source.seed, tol_m=1e-3 * source.tol_mm, light_seed=light_seed)
    scene = Scene(*parse_entry(source.text))
    engine = choose(scene, device)[0] if source.engine == "auto" else source.engine
    capture: Capture = _simulator(engine, source.text)(shot)
    if capture.provenance.get("tolerance_met") is False:
        log.warning("%s has a standard error of range above %g mm", source.text, source.tol_mm)
    return _told(capture, source.claimed) if source.claimed else capture


@lru_cache(maxsize=1)
def _simulator(engine: str, scene: str) -> Callable[[Shot], Capture]:
    """The simulator of the scene before, if it is the same: it remembers light."""
    run: Callable[[Shot], Capture] = find(SIMULATORS, engine).build(Scene(*parse_entry(scene)))
    return run


def _told(capture: Capture, claimed: str) -> Capture:
    """The capture as somebody has it who believes in another sensor than the one that took it."""
    told = {"claimed_sensor": claimed, **capture.provenance}
    return replace(capture, sensor=sensor(claimed), phasors=None, provenance=told)


def _store(source: Source, name: str, path: Path, make: Callable[[], Capture]) -> dict[str, Any]:
    """Make the capture file unless it is there and readable, and describe it."""
    try:
        capture = read_capture(path)
    except ValueError:
        capture = make()
        write_capture(path, capture)
    return {
        "id": path.stem,
        "name": name,
        "group": source.group,
        **(
            {"axis": source.axis, "value": source.value, "seed": source.seed} if source.axis else {}
        ),
        "truth": capture.truth is not None,
        "camera_depth": capture.depth is not None,
        "reported": list(capture.reported),
        "n_freqs": capture.sensor.modulation.n_freqs,
        "width": capture.sensor.camera.width,
        "height": capture.sensor.camera.height,
        "freqs_hz": capture.sensor.modulation.freqs_hz.tolist(),
    }
