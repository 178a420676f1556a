"""Native libraries come from wheels: real kernels and rays run on them, in fresh processes."""

import ast
import ctypes
import importlib.metadata
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from toftools import _native
from toftools.cli import doctor

PACKAGE = Path(_native.__file__).parent
linux = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the packages find their own")

# The system's libusb is hidden by refusing its name: only an exact file can then be loaded.
HIDE_LIBUSB = """
import ctypes
real = ctypes.CDLL
def only_files(name, *args, **kwargs):
    if name == "libusb-1.0.so.0":
        raise OSError("hidden by the test")
    return real(name, *args, **kwargs)
ctypes.CDLL = only_files
"""
MAPPED = """
def mapped(word):
    with open("/proc/self/maps") as maps:
        return sorted({line.split()[-1] for line in maps if word in line.rsplit("/", 1)[-1]})
"""
LLVM_KERNEL = """
from toftools._native import import_mitsuba
mi = import_mitsuba()
import drjit as dr
import numpy as np
assert dr.backend_v(mi.Float) == dr.JitBackend.LLVM
print(int(dr.sum(dr.square(dr.arange(mi.Float, 100)))[0]))
scene = mi.load_dict({
    "type": "scene",
    "integrator": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
    "sensor": {"type": "perspective", "fov": 90, "film": {
        "type": "hdrfilm", "width": 9, "height": 9, "pixel_format": "luminance",
        "rfilter": {"type": "box"}}},
    "ball": {"type": "sphere", "center": [0, 0, 5], "radius": 2},
    "sky": {"type": "constant", "radiance": 2.0},
})
image = np.array(mi.render(scene, spp=64))[..., 0]
print(image[0, 0], image[4, 4])
print(*mapped("libLLVM"))
"""
OPEN3D_RAY = """
from toftools._native import import_open3d
o3d = import_open3d()
box = o3d.t.geometry.TriangleMesh.create_box()
scene = o3d.t.geometry.RaycastingScene()
scene.add_triangles(box)
ray = o3d.core.Tensor([[0.5, 0.5, -3, 0, 0, 1]], dtype=o3d.core.float32)
print(scene.cast_rays(ray)["t_hit"].item())
print(*mapped("libusb"))
"""


def fresh(code: str, **env: str) -> list[str]:
    """Lines a new interpreter prints; every warning is an error there."""
    variables = {k: v for k, v in os.environ.items() if k != _native.LLVM_VARIABLE}
    done = subprocess.run([sys.executable, "-W", "error", "-c", MAPPED + code],
                          capture_output=True, text=True, env={**variables, **env})  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@linux
def test_dr_jit_compiles_and_mitsuba_renders_with_the_llvm_of_the_wheel():
    total, pixels, libraries = fresh(LLVM_KERNEL)
    assert int(total) == 328_350  # 99 * 100 * 199 / 6
    corner, centre = map(float, pixels.split())
    assert corner == 2.0  # the sky alone
    # A convex diffuse ball of albedo 0.5 under a uniform sky of 2 is 1, and cosine sampling hits
    # the sky with the weight 0.5 every time: no noise, only float32.
    assert centre == pytest.approx(1.0, abs=1e-5)
    assert libraries == _native._wheel_llvm()


@linux
def test_open3d_casts_a_ray_with_the_libusb_of_the_wheel():
    distance, libraries = fresh(HIDE_LIBUSB + OPEN3D_RAY)
    assert float(distance) == pytest.approx(3.0, abs=1e-6)  # float32 and a unit box at z = 0
    wheel = Path(importlib.util.find_spec("libusb_package").origin).parent
    assert Path(libraries).parent == wheel


@linux
def test_a_users_own_llvm_is_kept(monkeypatch):
    wheel = Path(_native._wheel_llvm())
    own = f"{wheel.parent}/./{wheel.name}"  # works, but is spelled as only a user would
    monkeypatch.setenv(_native.LLVM_VARIABLE, own)
    assert _native.prepare_llvm() == own
    assert os.environ[_native.LLVM_VARIABLE] == own


@linux
def test_a_library_that_cannot_be_or_is_too_old_is_refused_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv(_native.LLVM_VARIABLE, str(tmp_path / "nothing.so"))
    with pytest.raises(RuntimeError, match=r"cannot load .*nothing\.so .*pip install karellen"):
        _native.prepare_llvm()
    # Like LLVM 15 and older, the C library has no LLVMGetVersion.
    monkeypatch.setenv(_native.LLVM_VARIABLE, "libc.so.6")
    with pytest.raises(RuntimeError, match="LLVM older than 16, with which"):
        _native.prepare_llvm()


def no_wheel(name):
    raise importlib.metadata.PackageNotFoundError(name)


def test_without_the_wheel_linux_is_told_what_to_install(monkeypatch):
    monkeypatch.delenv(_native.LLVM_VARIABLE, raising=False)
    monkeypatch.setattr(importlib.metadata, "files", no_wheel)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(RuntimeError, match=r"found no libLLVM.*pip install karellen-llvm-core"):
        _native.prepare_llvm()


@pytest.mark.parametrize("platform", ["darwin", "win32"])
def test_elsewhere_the_packages_search_for_themselves(monkeypatch, platform):
    monkeypatch.delenv(_native.LLVM_VARIABLE, raising=False)
    monkeypatch.setattr(importlib.metadata, "files", no_wheel)
    monkeypatch.setattr(sys, "platform", platform)
    assert _native.prepare_llvm() is None
    assert _native.prepare_libusb() is None
    assert _native.LLVM_VARIABLE not in os.environ


def test_a_missing_libusb_is_said(monkeypatch):
    def nothing(*_args, **_kwargs):
        raise OSError

    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", nothing)
    with pytest.raises(RuntimeError, match="which Open3D needs: pip install libusb-package"):
        _native.prepare_libusb()


def test_a_machine_without_a_gpu_is_told_so(monkeypatch):
    mitsuba = _native.import_mitsuba()

    def no_driver(_name):
        raise ImportError

    monkeypatch.setattr(mitsuba, "set_variant", no_driver)
    with pytest.raises(RuntimeError, match="it needs an NVIDIA GPU and its driver"):
        _native.import_mitsuba("cuda_ad_mono")


def test_an_unknown_variant_is_refused():
    with pytest.raises(ValueError, match="got Mitsuba variant 'llvm_mono', wanted one of scalar"):
        _native.import_mitsuba("llvm_mono")


@pytest.mark.parametrize(
    "path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: p.relative_to(PACKAGE).as_posix()
)
def test_only_native_imports_mitsuba_and_open3d(path):
    if path.name == "_native.py":
        return
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        for name in names:
            first = name.partition(".")[0]
            assert first not in ("mitsuba", "open3d"), f"{path.name}:{node.lineno} imports {name}"


# --- toftools doctor ---------------------------------------------------------------------------


def diagnose(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(doctor.command, arguments, catch_exceptions=False,
                              standalone_mode=False)  # fmt: skip
    return done.return_value, done.stdout


def test_doctor_finds_this_installation_sound():
    status, text = diagnose("--json")
    report = json.loads(text)
    found = {check["name"]: check for check in report["checks"]}
    assert status == 0, [check for check in report["checks"] if not check["ok"]]
    assert report["ok"]
    assert found["LLVM"]["facts"]["compiles"]
    assert int(found["LLVM"]["facts"]["version"].partition(".")[0]) >= _native.LLVM_OLDEST
    wanted = ["toftools", "Python", "NumPy", "SciPy", "Numba", "h5py", "OpenCV", "Open3D",
              "Mitsuba", "Dr.Jit", "headless drawing", "threads", "TOFTOOLS_DATA", "torch",
              "onnxruntime", "dask"]  # fmt: skip
    assert set(wanted) <= set(found)


def only(monkeypatch, *names: str) -> None:
    """Leave out the checks that a test does not ask about, since each takes a second."""
    everything = {"_library", "_llvm", "_open3d", "_rendering", "_data", "_optional"}
    for name in everything - set(names):
        empty = [] if name == "_llvm" else doctor.Check(name, True, "left out")
        monkeypatch.setattr(doctor, name, lambda *_, given=empty: given)


def test_doctor_survives_parts_that_abort_and_says_so(monkeypatch):
    only(monkeypatch, "_llvm", "_open3d")
    monkeypatch.setattr(doctor, "_LLVM_PROBE", "import os; os.abort()")
    monkeypatch.setattr(doctor, "_OPEN3D_PROBE", "raise RuntimeError('no libusb here')")
    status, text = diagnose()
    lines = {line.split()[1]: line for line in text.splitlines() if len(line.split()) > 1}
    assert status == 1
    assert lines["LLVM"].startswith("MISSING")
    assert "killed by signal 6" in lines["LLVM"]
    assert "pip install karellen-llvm-core" in lines["LLVM"]
    assert lines["Open3D"].startswith("MISSING  Open3D           no libusb here; pip install")
    assert text.endswith("broken: LLVM, Open3D\n")


def test_doctor_does_without_open3d_pictures_and_optional_packages(monkeypatch):
    from toftools.viz import _process

    def failing(*_args):
        msg = "no EGL"
        raise RuntimeError(msg)

    only(monkeypatch, "_rendering", "_optional")
    monkeypatch.setattr(_process, "draw", failing)
    monkeypatch.setattr(doctor, "_OPTIONAL", (("no_such_package", "pip install it"),))
    status, text = diagnose()
    assert status == 0
    assert "Open3D cannot (no EGL), so matplotlib draws clouds; on Linux install" in text
    assert "absent   no_such_package  not installed; pip install it" in text


def test_doctor_tells_a_library_that_cannot_be_imported():
    check = doctor._library("no_such_module", ("no-such-wheel",), "Nothing")
    assert not check.ok
    assert check.line.endswith("No module named 'no_such_module'; pip install no-such-wheel")


def test_doctor_counts_recordings(monkeypatch, tmp_path):
    monkeypatch.setenv("TOFTOOLS_DATA", str(tmp_path / "nowhere"))
    assert "is not a folder" in doctor._data().detail
    monkeypatch.setenv("TOFTOOLS_DATA", str(tmp_path))
    (tmp_path / "notes.txt").write_text("no recording")
    assert doctor._data().facts["captures"] == 0

    import numpy as np

    np.savez(tmp_path / "a.npz", range_m=np.ones((4, 4)))
    found = doctor._data()
    assert found.facts["captures"] == 1
    assert found.ok
    monkeypatch.delenv("TOFTOOLS_DATA")
    assert not doctor._data().ok


@pytest.mark.parametrize("first", ["", "import numba"])
def test_numba_does_not_complain_about_the_libraries_of_open3d(first):
    """Open3D brings an old TBB; whoever runs a parallel kernel after it got a warning."""
    code = f"""
{first}
import warnings
warnings.simplefilter("error")
from toftools._native import import_open3d
import_open3d()
import numpy as np
from toftools.correct.crt import crt
from toftools.sensors import sensor
from toftools.types import Phasors
crt(sensor("opt8241:width=4,height=3"))(Phasors(np.ones((2, 3, 4))))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
