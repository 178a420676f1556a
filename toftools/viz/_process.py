"""Open3D's window in a process of its own: it can abort, and then only that process is lost."""

import ctypes
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toftools.viz._view import F64, View

TIMEOUT_S = 60  # a picture takes about a second


def draw(points: F64, colours: F64, view: View, point_px: float) -> NDArray[np.uint8]:
    """Picture of a cloud, in a hidden window.

    Parameters
    ----------
    points, colours : ndarray, (N, 3)
        Points, m, and RGB in 0..1.
    view : View
        Where from.
    point_px : float
        Size of a point.

    Returns
    -------
    ndarray, (H, W, 3), uint8
        The picture.

    Raises
    ------
    RuntimeError
        If Open3D fails in any way, its process dying included.
    """
    env = dict(os.environ)
    if sys.platform == "linux":
        # Without a display Open3D draws through EGL: the same everywhere, and no window flashes.
        for name in ("DISPLAY", "WAYLAND_DISPLAY"):
            env.pop(name, None)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "scene.npz", Path(folder) / "picture.npy"
        _save(source, points, colours, view, point_px)
        _run([str(source), str(target)], env, timeout_s=TIMEOUT_S)
        if not target.is_file():
            msg = "its process left no picture"
            raise RuntimeError(msg)
        picture: NDArray[np.uint8] = np.load(target, allow_pickle=False)
    if picture.shape != (view.size[1], view.size[0], 3) or np.ptp(picture) == 0:
        msg = f"it drew an empty picture of shape {picture.shape}"
        raise RuntimeError(msg)
    return picture


def _save(source: Path, points: F64, colours: F64, view: View, point_px: float) -> None:
    """What viz/_render.py reads."""
    np.savez(source, points=points, colours=colours, K=view.K, extrinsic=view.extrinsic,
             size=np.array(view.size), point_px=np.array(point_px))  # fmt: skip


def _run(arguments: list[str], env: dict[str, str], *, timeout_s: float | None) -> None:
    """Run viz/_render.py; RuntimeError in one sentence if it does not end well."""
    command = [sys.executable, "-m", "toftools.viz._render", *arguments]
    try:
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=timeout_s)
    except (OSError, subprocess.TimeoutExpired) as error:
        msg = f"its process did not end well ({error})"
        raise RuntimeError(msg) from error
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        msg = f"its process ended with {done.returncode}: {last}"
        raise RuntimeError(msg)


def show(points: F64, colours: F64, view: View, point_px: float) -> None:
    """Show a cloud in a window until it is closed.

    Parameters
    ----------
    points, colours : ndarray, (N, 3)
        Points, m, and RGB in 0..1.
    view : View
        Where from.
    point_px : float
        Size of a point.

    Raises
    ------
    RuntimeError
        If there is no display, or Open3D fails.
    """
    if sys.platform == "linux" and not _has_display():
        msg = "a window needs a display, and there is none here; write a .html page instead"
        raise RuntimeError(msg)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "scene.npz"
        _save(source, points, colours, view, point_px)
        try:
            _run([str(source)], dict(os.environ), timeout_s=None)
        except RuntimeError as error:
            msg = f"Open3D could not show the cloud: {error}; write a .html page instead"
            raise RuntimeError(msg) from error


def _has_display() -> bool:
    """Whether an X or Wayland server answers.

    Open3D cannot be asked: without one it silently draws off screen, and would wait for ever for
    a window to be closed that nobody can see.
    """
    for variable, library, connect in (
        ("DISPLAY", "libX11.so.6", "XOpenDisplay"),
        ("WAYLAND_DISPLAY", "libwayland-client.so.0", "wl_display_connect"),
    ):
        if not os.environ.get(variable):
            continue
        try:
            function = getattr(ctypes.CDLL(library), connect)
        except (OSError, AttributeError):
            continue
        function.restype = ctypes.c_void_p
        if function(None):
            return True
    return False
