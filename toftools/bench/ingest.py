"""Captures of a suite as capture files ``DIR/captures/<id>.h5``: read, or simulated, once.

Ids come from content (of files) or from the wish and the code (of scenes), so that a second run
finds what the first one made.
"""

import logging
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from toftools.bench.fingerprint import capture_digest, digest, package_digest
from toftools.bench.source import Source
from toftools.bench.suite import Suite, expand
from toftools.io.native import read_capture, write_capture
from toftools.io.open import open_capture
from toftools.registry import SIMULATORS, find, parse_entry
from toftools.sensors import sensor
from toftools.sim.choice import choose
from toftools.types import Capture, Scene, Shot

log = logging.getLogger(__name__)


def name_of(text: str) -> str:
    """Text as part of a file name.

    Parameters
    ----------
    text : str
        A scene, a method, a file's stem.

    Returns
    -------
    str
        Letters, digits, ``_``, ``.`` and ``-``, 1 to 60.
    """
    return re.sub(r"[^A-Za-z0-9_.]+", "-", text).strip("-")[:60] or "capture"


def ingest(source: Source, suite: Suite, out: Path) -> Iterator[dict[str, Any]]:
    """Make or find the captures of one entry of a suite.

    Parameters
    ----------
    source : Source
        The entry.
    suite : Suite
        Its suite, for the folder of relative patterns.
    out : Path
        Benchmark folder.

    Yields
    ------
    dict
        What the plan says of each capture: id, name, group, what it holds.

    Raises
    ------
    ValueError
        If a file matches nothing or cannot be read, or a scene cannot be made.
    """
    if source.sensor is not None:
        name = name_of(source.text)
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
        name = name_of(file.stem)
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
