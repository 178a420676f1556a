"""Program that draws a cloud with Open3D; run in a process of its own, because it can abort.

``python -m toftools.viz._render SCENE.npz [PICTURE.npy]`` reads points (N, 3), colours (N, 3), K
(3, 3), extrinsic (4, 4), size (2,) and point_px. It writes the picture (H, W, 3) uint8, or without
a second name shows a window until it is closed. Open3D's legacy Visualizer needs no display to
draw: without one it uses EGL. Its OffscreenRenderer is not used: it needs Vulkan, and tone-maps
the colours.
"""

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools._native import import_open3d


def window(scene: dict[str, NDArray[np.float64]], *, visible: bool) -> Any:  # noqa: ANN401
    """Open3D window that holds one cloud.

    Parameters
    ----------
    scene : dict of str to ndarray
        The arrays named above.
    visible : bool
        Whether to show it.

    Returns
    -------
    open3d.visualization.Visualizer
        The window.

    Raises
    ------
    RuntimeError
        If Open3D cannot open it.
    """
    o3d = import_open3d()
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    width, height = (int(side) for side in scene["size"])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scene["points"]))
    cloud.colors = o3d.utility.Vector3dVector(scene["colours"])
    camera = o3d.camera.PinholeCameraParameters()
    camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(width, height, scene["K"])
    camera.extrinsic = scene["extrinsic"]

    opened = o3d.visualization.Visualizer()
    if not opened.create_window("toftools", width, height, visible=visible):
        msg = "Open3D cannot open a window, shown or hidden"
        raise RuntimeError(msg)
    opened.add_geometry(cloud)
    option = opened.get_render_option()
    option.background_color = np.ones(3)
    option.point_size = float(scene["point_px"])
    opened.get_view_control().convert_from_pinhole_camera_parameters(camera, True)
    return opened


def main(source: str, target: str | None = None) -> None:
    """Read a scene, and write its picture or show it.

    Parameters
    ----------
    source : str
        Scene (.npz).
    target : str or None
        Picture (.npy); None shows a window.
    """
    with np.load(source, allow_pickle=False) as archive:
        opened = window(dict(archive), visible=target is None)
    if target is None:
        opened.run()
    else:
        picture = np.asarray(opened.capture_screen_float_buffer(True))
        np.save(target, np.asarray(np.round(picture * 255), dtype=np.uint8))
    opened.destroy_window()


if __name__ == "__main__":
    main(*sys.argv[1:])
