"""First stage: every capture of a suite as a capture file, every point as a line of a plan.

``DIR/captures/<id>.h5`` and ``DIR/plan.json``; ids come from content, so that a second run finds
what the first one made.
"""

import hashlib
import json
import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from toftools.bench.references import REFERENCES
from toftools.bench.suite import Source, Suite, expand, points
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
        Registry name or ``module:function``.
    params : mapping
        Parameters of the method.
    """

    capture: str
    method: str
    params: Mapping[str, Any]

    @property
    def key(self) -> str:
        """File stem of the point under ``runs/``."""
        digest = _digest([self.capture, self.method, dict(self.params)])
        return f"{self.capture}--{_slug(self.method)}-{digest}"


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.]+", "-", text).strip("-")[:60]


def _digest(value: Any) -> str:  # noqa: ANN401 - any JSON value
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:8]


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
    (out / "captures").mkdir(parents=True, exist_ok=True)
    (out / "runs").mkdir(exist_ok=True)
    captures = [item for source in suite.sources for item in _ingest(source, suite, out)]
    if not captures:
        msg = f"suite {suite.name} found no capture; set TOFTOOLS_DATA or give scenes"
        raise ValueError(msg)
    plan = [
        Point(str(item["id"]), method, params)
        for item in captures
        for text in (*suite.methods, *extra_methods)
        for method, params in points(suite, text)
        if method not in REFERENCES or _applies(method, params, item)
    ]
    write_json(
        out / "plan.json",
        {
            "suite": suite.name,
            "repeats": suite.repeats,
            "mask": {"min_range_m": suite.min_range_m, "max_range_m": suite.max_range_m},
            "captures": captures,
            "points": [asdict(point) for point in plan],
        },
    )
    return plan


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
        digest = _digest([source.text, source.sensor])
        yield _store(source, name, f"{name}-{digest}", source.text, out)
        return
    files = expand(source, suite.folder)
    if files is None:
        log.warning("left out %s: the environment variable is not set", source.text)
        return
    if not files:
        msg = f"no file matches {source.text!r}, relative to {suite.folder}"
        raise ValueError(msg)
    for file in files:
        digest = hashlib.sha256(file.read_bytes() + repr(source.format).encode()).hexdigest()[:8]
        name = _slug(file.stem)
        yield _store(source, name, f"{name}-{digest}", str(file), out)


def _store(source: Source, name: str, capture_id: str, text: str, out: Path) -> dict[str, Any]:
    """Make the capture file unless it is there, and describe it."""
    from toftools.io.native import read_capture, write_capture

    path = out / "captures" / f"{capture_id}.h5"
    if not path.exists():
        write_capture(path, _capture(source, text))
    capture = read_capture(path)
    return {
        "id": capture_id,
        "name": name,
        "group": source.group,
        "truth": capture.truth is not None,
        "camera_depth": capture.depth is not None,
        "reported": list(capture.reported),
        "n_freqs": capture.sensor.modulation.n_freqs,
        "width": capture.sensor.camera.width,
        "height": capture.sensor.camera.height,
        "freqs_hz": capture.sensor.modulation.freqs_hz.tolist(),
    }


def _capture(source: Source, text: str) -> Any:  # noqa: ANN401 - a Capture
    from toftools.io.open import open_capture
    from toftools.registry import SIMULATORS, parse_name
    from toftools.sensors import sensor
    from toftools.types import Scene, Shot

    if source.sensor is None:
        return open_capture(Path(text), source.format)
    scene, params = parse_name(text)
    return SIMULATORS["analytic"].build(Scene(scene, params))(Shot(sensor(source.sensor), seed=0))
