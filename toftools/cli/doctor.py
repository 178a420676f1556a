"""``toftools doctor``: does every part of this installation work, and if not, what to do.

What can abort a process (LLVM, Open3D) is tried in a process of its own.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import click

_TIMEOUT_S = 60

# Library to import, its distributions on PyPI (the first one installed counts), name to print.
_LIBRARIES = (
    ("numpy", ("numpy",), "NumPy"),
    ("scipy.optimize", ("scipy",), "SciPy"),
    ("numba", ("numba",), "Numba"),
    ("h5py", ("h5py",), "h5py"),
    ("cv2", ("opencv-contrib-python-headless", "opencv-contrib-python"), "OpenCV"),
    ("matplotlib", ("matplotlib",), "matplotlib"),
    ("av", ("av",), "PyAV"),
    ("jinja2", ("jinja2",), "Jinja2"),
)
_OPTIONAL = (
    ("torch", "only for training networks: pip install torch"),
    ("onnxruntime", "only for running networks: pip install onnxruntime"),
    ("dask", "only for datasets made on a cluster: pip install 'dask[distributed]'"),
)

# minimum() is the instruction on which Dr.Jit dies with LLVM 15 and older.
_LLVM_PROBE = """
import json
from toftools._native import import_mitsuba, prepare_llvm
path = prepare_llvm()
mi = import_mitsuba()
import drjit as dr
total = int(dr.sum(dr.minimum(dr.arange(mi.Float, 100), 50))[0])
assert total == 3725, f"the kernel computed {total} instead of 3725"
version = ".".join(map(str, dr.detail.llvm_version()))
print(json.dumps({"path": path, "llvm": version, "mitsuba": mi.__version__,
                  "drjit": dr.__version__}))
"""
_OPEN3D_PROBE = """
import json
from toftools._native import import_open3d
o3d = import_open3d()
scene = o3d.t.geometry.RaycastingScene()
scene.add_triangles(o3d.t.geometry.TriangleMesh.create_box())
ray = o3d.core.Tensor([[0.5, 0.5, -3, 0, 0, 1]], dtype=o3d.core.float32)
distance = scene.cast_rays(ray)["t_hit"].item()
assert abs(distance - 3) < 1e-5, f"the ray hit at {distance} instead of 3"
print(json.dumps({"open3d": o3d.__version__}))
"""


@dataclass(frozen=True)
class Check:
    """One line of the report."""

    name: str
    ok: bool
    detail: str
    advice: str = ""
    required: bool = True
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def line(self) -> str:
        """Text for a person."""
        mark = "ok" if self.ok else "MISSING" if self.required else "absent"
        text = f"{mark:<8} {self.name:<16} {self.detail}"
        return f"{text}; {self.advice}" if self.advice and not self.ok else text


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON.")
def command(*, as_json: bool) -> int:
    """Check that every part of the installation works."""
    found = []
    for check in checks():
        found.append(check)
        if not as_json:
            click.echo(check.line)
    broken = [check.name for check in found if check.required and not check.ok]
    if as_json:
        report = {"ok": not broken, "checks": [asdict(check) for check in found]}
        click.echo(json.dumps(report))
    else:
        click.echo(f"\nbroken: {', '.join(broken)}" if broken else "\nall required parts work")
    return 1 if broken else 0


def checks() -> Iterator[Check]:
    """All checks, each made when it is asked for.

    Yields
    ------
    Check
        The next finding.
    """
    import toftools

    yield Check("toftools", True, toftools.__version__, facts={"version": toftools.__version__})
    yield _python()
    for module, distributions, name in _LIBRARIES:
        yield _library(module, distributions, name)
    yield from _llvm()
    yield _open3d()
    yield _rendering()
    yield _threads()
    yield _data()
    for module, purpose in _OPTIONAL:
        yield _optional(module, purpose)


def _python() -> Check:
    version = platform.python_version()
    where = f"{version} on {platform.system()} {platform.machine()}"
    ok = sys.version_info >= (3, 11)
    return Check("Python", ok, where, "install Python 3.11 or newer", facts={"version": version})


def _library(module: str, distributions: tuple[str, ...], name: str) -> Check:
    """Import one library in this process."""
    advice = f"pip install {distributions[0]}"
    try:
        importlib.import_module(module)
    except Exception as error:  # a broken wheel raises anything
        return Check(name, False, _one_line(error), advice)
    version = next((v for v in map(_version, distributions) if v), None)
    return Check(name, True, version or "version unknown", facts={"version": version})


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _llvm() -> Iterator[Check]:
    """LLVM really compiles a kernel for Dr.Jit, and Mitsuba imports with it."""
    facts, trouble = _probe(_LLVM_PROBE)
    if trouble:
        for name, distribution in (("Mitsuba", "mitsuba"), ("Dr.Jit", "drjit")):
            version, advice = _version(distribution), "pip install 'mitsuba>=3.9,<3.10'"
            yield Check(name, version is not None, version or "not installed", advice)
        # What toftools itself refuses already says what to do.
        advice = "" if "pip install" in trouble else "pip install karellen-llvm-core"
        yield Check("LLVM", False, trouble, advice, facts={"compiles": False})
        return
    yield Check("Mitsuba", True, facts["mitsuba"], facts={"version": facts["mitsuba"]})
    yield Check("Dr.Jit", True, facts["drjit"], facts={"version": facts["drjit"]})
    where = facts["path"] or "found by Dr.Jit itself"
    detail = f"{facts['llvm']} compiles kernels ({where})"
    known = {"version": facts["llvm"], "path": facts["path"], "compiles": True}
    yield Check("LLVM", True, detail, facts=known)


def _open3d() -> Check:
    facts, trouble = _probe(_OPEN3D_PROBE)
    if trouble:
        advice = "pip install open3d-cpu (open3d off Linux x86-64) and libusb-package"
        return Check("Open3D", False, trouble, advice)
    detail = f"{facts['open3d']} casts rays"
    return Check("Open3D", True, detail, facts={"version": facts["open3d"]})


def _rendering() -> Check:
    """Whether Open3D draws without a display; matplotlib stands in where it does not."""
    import numpy as np

    from toftools.viz._process import draw
    from toftools.viz._view import oblique

    corners = np.argwhere(np.ones((2, 2, 2))).astype(np.float64)
    try:
        draw(corners, np.zeros((8, 3)), oblique(corners, (96, 64)), 4.0)
    except RuntimeError as error:
        detail = f"Open3D cannot ({_one_line(error)}), so matplotlib draws clouds"
        advice = "on Linux install libegl1 and libgl1-mesa-dri for Open3D's pictures"
        return Check("headless drawing", False, detail, advice, False, {"renderer": "matplotlib"})
    detail = "Open3D draws clouds without a display"
    return Check("headless drawing", True, detail, required=False, facts={"renderer": "open3d"})


def _threads() -> Check:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    try:
        import numba

        threads = int(numba.get_num_threads())
    except Exception:  # said in Numba's own line
        threads = 0
    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    limits = {name: os.environ[name] for name in names if name in os.environ}
    said = ", ".join(f"{name}={value}" for name, value in limits.items()) or "no limits set"
    facts = {"cores": cores, "numba": threads, "environment": limits}
    return Check("threads", True, f"{cores} cores, Numba uses {threads}, {said}", facts=facts)


def _data() -> Check:
    """Real captures, which some suites want."""
    name, folder = "TOFTOOLS_DATA", os.environ.get("TOFTOOLS_DATA")
    advice = "set it to a folder of recordings to run the suite `real`"
    if not folder:
        return Check(name, False, "not set", advice, False, {"folder": None, "captures": 0})
    if not Path(folder).is_dir():
        detail = f"{folder} is not a folder"
        return Check(name, False, detail, advice, False, {"folder": folder, "captures": 0})
    count = sum(map(_is_recording, Path(folder).rglob("*")))
    facts = {"folder": folder, "captures": count}
    return Check(name, count > 0, f"{folder} holds {count} captures", advice, False, facts)


def _is_recording(path: Path) -> bool:
    """Whether exactly one reader claims a file, or it is a capture of our own."""
    from toftools.io.native import is_capture
    from toftools.io.open import detect

    if not path.is_file():
        return False
    try:
        return is_capture(path) or bool(detect(path))
    except (ValueError, OSError):
        return False


def _optional(module: str, purpose: str) -> Check:
    """Presence of a package that only some commands need; it is not imported."""
    present = importlib.util.find_spec(module) is not None
    version = _version(module)
    detail = (version or "version unknown") if present else "not installed"
    return Check(module, present, detail, purpose, False, {"version": version})


def _probe(code: str) -> tuple[dict[str, Any], str]:
    """What a program prints as JSON, or why it did not, in one line."""
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                              timeout=_TIMEOUT_S)  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        return {}, _one_line(error)
    lines = done.stderr.strip().splitlines() or ["no message"]
    if done.returncode < 0:
        return {}, f"its process was killed by signal {-done.returncode} ({lines[-1]})"
    if done.returncode:
        return {}, lines[-1].partition(": ")[2] or lines[-1]
    facts: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return facts, ""


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
