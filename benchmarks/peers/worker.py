"""An engine in a process of its own, so that caches, memory and threads do not mix.

The process answers one job at a time and sleeps in between, so that engines can take turns.
"""

import importlib
import multiprocessing
import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toftools.registry import parse_entry
from toftools.sensors import sensor as preset
from toftools.types import Scene

FOLDER = str(Path(__file__).parents[1])


@dataclass(frozen=True)
class Frame:
    """One rendered frame: phasors (F, H, W), range (H, W) or None, its time and the peak so far."""

    phasors: np.ndarray
    range_m: np.ndarray | None
    seconds: float
    peak_mb: float


@dataclass(frozen=True)
class Engine:
    """A running engine: `setup_s` is the import, the scene and what the engine builds from it."""

    name: str
    setup_s: float
    idle_mb: float
    process: Any
    pipe: Any

    def __call__(self, samples: int, seed: int) -> Frame:
        self.pipe.send((samples, seed))
        return self._answer()

    def _answer(self):
        answer = self.pipe.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None:
        self.pipe.send(None)
        self.process.join()


def start(name, module, **options) -> Engine:
    """Start ``module.make(**options)`` in a new process; scene and sensor are texts."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there, module, options), daemon=True)
    process.start()
    there.close()
    engine = Engine(name, 0.0, 0.0, process, here)
    setup_s, idle_mb = engine._answer()
    return Engine(name, setup_s, idle_mb, process, here)


def _serve(pipe, module, options):
    sys.path.insert(0, FOLDER)
    begin = time.perf_counter()
    try:
        render = importlib.import_module(module).make(**_parsed(options))
        pipe.send((time.perf_counter() - begin, _peak_mb()))
        while (job := pipe.recv()) is not None:
            begin = time.perf_counter()
            phasors, range_m = render(*job)
            seconds = time.perf_counter() - begin
            pipe.send(Frame(phasors, range_m, seconds, _peak_mb()))
    except Exception as error:  # told to the parent, who raises it
        pipe.send(RuntimeError(f"{module}: {type(error).__name__}: {error}"))


def _parsed(options):
    scene, sensor = options.get("scene"), options.get("sensor")
    made = {} if scene is None else {"scene": Scene(*parse_entry(scene))}
    return options | made | ({} if sensor is None else {"sensor": preset(sensor)})


def _peak_mb():
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)
