"""First stage: every capture of a suite as a capture file, every point as a line of a plan.

``DIR/captures/<id>.h5`` and ``DIR/plan.json``; ids come from content, so that a second run finds
what the first one made.
"""

import json
import logging
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from toftools.bench.fingerprint import digest
from toftools.bench.ingest import _simulator, ingest, name_of
from toftools.bench.methods import check_method, points, setting
from toftools.bench.references import REFERENCES
from toftools.bench.source import Source
from toftools.bench.suite import Suite
from toftools.io.atomic import atomic_path

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
        return f"{self.capture}--{name_of(self.method)}-{mark}"


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
    listed = [(source, item) for source in suite.sources for item in ingest(source, suite, out)]
    _simulator.cache_clear()  # it keeps the last scene and its light
    plain = [item for source, item in listed if not source.ladder]
    captures = list({(item["id"], item["group"]): item for item in plain}.values())
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
    if extra_methods and not captures:
        msg = f"suite {suite.name} has ladders alone, which name their own methods; leave --method"
        raise ValueError(msg)
    found = _points(captures, methods, suite)
    every = [*found, *(point for _, point in climbs)]
    plan = list({point.key: point for point in every}.values())  # a setting named twice runs once
    told = {
        "ladders": _ladders(climbs, {point.key for point in found}),
        "captures": [*captures, *shared.values()],
        "points": [asdict(point) for point in plan],
    }
    write_json(out / "plan.json", {**_about(suite), **told})
    return plan


def _points(
    captures: Iterable[Mapping[str, Any]], methods: Iterable[str], suite: Suite
) -> list[Point]:
    """Every setting of every method on every capture; references where they exist."""
    return [
        Point(str(item["id"]), method, params)
        for item in captures
        for text in methods
        for method, params in points(text, suite.grid)
        if method not in REFERENCES or _applies(method, params, item)
    ]


def _about(suite: Suite) -> dict[str, Any]:
    """What later stages ask of a suite."""
    farthest_m = (
        suite.max_range_m if math.isfinite(suite.max_range_m) else None
    )  # JSON: no infinity
    return {
        "suite": suite.name,
        "repeats": suite.repeats,
        "mask": {"min_range_m": suite.min_range_m, "max_range_m": farthest_m},
        "axes": {s.axis: s.about for s in suite.sources if s.axis},
    }


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
