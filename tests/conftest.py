"""How tests share a machine: who runs together in one worker, and that a worker takes one core."""

import os

import pytest

from toftools._native import limit_threads

# Apart, two workers compile all corrections at the same moment, each for itself.
TOGETHER = {"test_laws_correction.py", "test_hostile_frames.py"}


def pytest_configure():
    # Idle threads of one worker's kernels spin and take the cores from the other's.
    if "PYTEST_XDIST_WORKER" in os.environ:
        limit_threads(1)


def pytest_collection_modifyitems(items):
    for item in items:
        group = "corrections" if item.path.name in TOGETHER else str(item.path)
        item.add_marker(pytest.mark.xdist_group(group))
