"""Make a data set: every capture of a recipe as a file of its own, and a manifest of them all.

``DIR/captures/<id>.h5`` appear whole or not at all, under names that follow from what they are of:
whoever is stopped goes on where he was. What fails is told with its reason, and tried again by the
next run.
"""

import errno
import hashlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

from toftools.bench.results import only_run
from toftools.dataset import manifest
from toftools.dataset.manifest import Entry
from toftools.dataset.recipe import Job, Recipe
from toftools.io.native import read_capture, write_capture
from toftools.registry import SIMULATORS, find, parse_entry
from toftools.sensors import sensor
from toftools.sim.choice import choose
from toftools.types import Capture, Scene, Shot

log = logging.getLogger(__name__)

TOLD = ("engine", "max_bounces", "standard_error_mm", "tolerance_met", "left_to_path")
"""What a manifest repeats of a capture's own account."""
ONE_AT_A_TIME = threading.Lock()
"""Engines and files have state of the process; a pool may have threads."""

Work = Callable[[Job], Entry]
Pool = Callable[[Work, Sequence[Job]], Iterator[Entry]]
"""Runs jobs and gives their entries as they come; a failure is an entry with ``error``."""


@dataclass(frozen=True)
class Made:
    """What a run has done.

    Parameters
    ----------
    entries : tuple of dict
        Manifest: one line per capture that is there.
    fresh : int
        How many of them this run made.
    failed : mapping of str to str
        Ids of captures that are missing, and why.
    """

    entries: tuple[Entry, ...]
    fresh: int
    failed: Mapping[str, str]


def make(
    recipe: Recipe, out: Path, pool: Pool, told: Callable[[str], None] = lambda _: None
) -> Made:
    """Make what a data set lacks.

    Parameters
    ----------
    recipe : Recipe
        Captures.
    out : Path
        Folder; what it holds already is kept.
    pool : callable
        Where jobs run: `pools.local` or `pools.over_cluster`.
    told : callable
        Takes a line of progress after every capture.

    Returns
    -------
    Made
        What is there now.

    Raises
    ------
    ValueError
        If another run is at work in the folder, or it cannot be written to.
    """
    out = out.resolve()  # workers may stand elsewhere
    try:
        (out / "captures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"cannot write to {out}: {error.strerror or error}; choose another folder"
        raise ValueError(msg) from error
    with only_run(out):
        manifest.clean(out)
        found = manifest.present(out)
        missing = [job for job in recipe.jobs if job.id not in found]
        absent = {job.id for job in missing if not manifest.file_of(out, job.id).exists()}
        failed: dict[str, str] = {}
        progress = _Progress(len(missing))
        try:
            for entry in pool(partial(captured, out), missing):
                if "error" not in entry and not manifest.is_there(out, entry):
                    entry = {"id": entry["id"], "error": "made, but not in this folder"}
                if "error" in entry:
                    failed[entry["id"]] = entry["error"]
                else:
                    found[entry["id"]] = entry
                    manifest.note(out, entry)
                told(progress.after(entry))
                if os.strerror(errno.ENOSPC) in entry.get("error", ""):
                    break  # all others would fail as well, after all their work
        finally:
            # The recipe says to which part a capture belongs; it may have changed its mind.
            here = [job for job in recipe.jobs if job.id in found]
            entries = tuple({**found[job.id], **asdict(job)} for job in here)
            manifest.write(out, recipe, entries, failed)
    _warn_of_versions(entries)
    return Made(entries, len(absent & found.keys()), failed)


def captured(out: Path, job: Job) -> Entry:
    """Make one capture unless it is there and whole, and describe it.

    Parameters
    ----------
    out : Path
        Folder of the data set.
    job : Job
        The capture.

    Returns
    -------
    dict
        A line of the manifest; or the id and ``error``.
    """
    path, seconds = manifest.file_of(out, job.id), None
    try:
        with ONE_AT_A_TIME:
            try:
                capture = read_capture(path)
            except ValueError:
                begin = time.monotonic()
                capture = simulated(job)
                write_capture(path, capture)
                seconds = round(time.monotonic() - begin, 3)
            data = path.read_bytes()
    except Exception as error:  # whatever it is, the others go on
        log.info("details of %s", job.id, exc_info=True)
        return {"id": job.id, "error": " ".join(str(error).split()) or type(error).__name__}
    told = {key: capture.provenance.get(key) for key in TOLD}
    return {
        **asdict(job), **{key: value for key, value in told.items() if value is not None},
        "toftools": version("toftools"), "seconds": seconds,
        "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest(),
    }  # fmt: skip


def simulated(job: Job) -> Capture:
    """The capture of a job: taps with noise, and truth, from which all else follows.

    Parameters
    ----------
    job : Job
        What to capture.

    Returns
    -------
    Capture
        Without phasors, which follow from the taps.
    """
    scene = Scene(*parse_entry(job.scene))
    shot = Shot(
        sensor(job.sensor), seed=job.seed, tol_m=1e-3 * job.tol_mm, max_bounces=job.max_bounces
    )
    engine, why = choose(scene, shot.sensor, max_bounces=job.max_bounces)
    capture: Capture = find(SIMULATORS, engine).build(scene)(shot)
    return replace(capture, phasors=None, provenance={**capture.provenance, "engine_why": why})


def _warn_of_versions(entries: Sequence[Entry]) -> None:
    others = {str(entry.get("toftools")) for entry in entries} - {version("toftools")}
    if others:
        log.warning(
            "some captures were made by toftools %s; for one version throughout, make them anew",
            ", ".join(sorted(others)),
        )


class _Progress:
    """How far a run is, and how long the rest will take at the pace of what was really made."""

    def __init__(self, total: int) -> None:
        self.total, self.count, self.failed, self.made = total, 0, 0, 0
        self.begin = time.monotonic()

    def after(self, entry: Entry) -> str:
        """A line after one more entry."""
        self.count += 1
        self.failed += "error" in entry
        if entry.get("seconds") is None and not self.made:
            self.begin = time.monotonic()  # captures that were there already took no time
        else:
            self.made += 1
        text = f"{self.count} of {self.total}"
        if self.failed:
            text += f", {self.failed} failed"
        if not self.made:
            return text
        each = (time.monotonic() - self.begin) / self.made
        hours, minutes = divmod(int(each * (self.total - self.count) // 60), 60)
        return f"{text}, {each:.1f} s each, {hours}:{minutes:02d} h left"
