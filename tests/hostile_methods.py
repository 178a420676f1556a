"""Methods that a benchmark must survive, each with one fault, which its name says."""

import os
import sys
import time

import numpy as np

from toftools.types import DepthMap


def _flat(phasors):
    return DepthMap(np.full(phasors.valid.shape, 2.0, np.float32))


def honest(sensor, *, metres=2.0):
    return lambda phasors: DepthMap(np.full(phasors.valid.shape, metres, np.float32))


def raises(sensor):
    def run(phasors):
        raise RuntimeError("planted " + "and long " * 10_000)

    return run


def speechless(sensor):
    class Speechless(Exception):
        def __str__(self):
            raise ValueError

    def run(phasors):
        raise Speechless

    return run


def leaves(sensor):
    def run(phasors):
        sys.exit(0)

    return run


def exits(sensor):
    return lambda phasors: os._exit(7)


def segfaults(sensor):
    return lambda phasors: os.kill(os.getpid(), 11)


def hangs(sensor):
    return lambda phasors: time.sleep(600)


def eats(sensor):
    def run(phasors):
        held = []
        while True:
            held.append(np.ones(1 << 20))

    return run


def shouts(sensor):
    def run(phasors):
        for _ in range(300):
            print("x" * 65536)
            print("y" * 65536, file=sys.stderr)
        os.write(2, b"z" * (8 << 20))
        return _flat(phasors)

    return run


def wrong_shape(sensor):
    return lambda phasors: DepthMap(np.ones((2, 3), np.float32))


def wrong_type(sensor):
    return lambda phasors: np.ones(phasors.valid.shape, np.float32)


def wrong_later(sensor):
    calls = []

    def run(phasors):
        calls.append(1)
        return _flat(phasors) if len(calls) == 1 else None

    return run


class Liar(DepthMap):
    """A depth map by name alone."""

    def __post_init__(self):
        pass


def lies(sensor):
    return lambda phasors: Liar(np.full(phasors.valid.shape, -3.0))


class Changing(DepthMap):
    """Right at the first look, of another shape at all others."""

    looks = 0

    def __getattribute__(self, name):
        if name == "range_m":
            Changing.looks += 1
            return np.ones((6, 8) if Changing.looks == 1 else (2, 2), np.float32)
        return super().__getattribute__(name)


def changes(sensor):
    def run(phasors):
        made = Changing(np.ones(phasors.valid.shape, np.float32))
        Changing.looks = 0
        return made

    return run


def models(sensor):
    info = {"model": np.array([[{}]], object), "models": ("one",)}
    return lambda phasors: DepthMap(np.ones(phasors.valid.shape, np.float32), info=info)


def writes(sensor):
    def run(phasors):
        phasors.values.flags.writeable = True
        phasors.values[:] = 1j
        return _flat(phasors)

    return run


def replaces(sensor):
    def run(phasors):
        object.__setattr__(phasors, "valid", np.zeros_like(phasors.valid))
        return _flat(phasors)

    return run


def naps(sensor, *, number=0):
    """Slow, within the limit of one point."""

    def run(phasors):
        time.sleep(0.4)
        return _flat(phasors)

    return run


def never_ends(sensor):
    """A right answer, and a thread that keeps the process alive."""
    import threading

    threading.Thread(target=time.sleep, args=(600,)).start()
    return _flat


def starts_a_child(sensor):
    """A process of its own that outlives the call and holds the worker's stderr."""
    import subprocess
    from pathlib import Path

    def run(phasors):
        child = subprocess.Popen(["sleep", "600"])
        with Path("children").open("a") as file:
            file.write(f"{child.pid}\n")
        return _flat(phasors)

    return run


def sometimes(sensor, *, harm="none"):
    """Honest or not, by its parameter: a batch with all kinds of points."""
    ways = {
        "none": honest,
        "last": honest,
        "exit": exits,
        "hang": hangs,
        "eat": eats,
        "raise": raises,
    }
    return ways[harm](sensor)
