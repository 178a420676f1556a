"""Mitsuba scene files, old and new, as a `World`: read without trust, edited by rule, noted.

Mitsuba 3 renames the camelCase parameters of the older versions (0.4 to 0.6) by itself; the edits
here do the rest, by rule and not by file, and each leaves a note. Only the pose of the file's first
sensor is kept, so neither its film nor its clipping planes matter. Colours become their luminance
in the monochromatic variants, which is no near-infrared albedo: choose those with `albedo` and
`albedos`. A file cannot read outside its folder. Materials that Mitsuba 3 lacks and no rule knows
are refused by Mitsuba.
"""

from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from toftools.sim._xml_edits import EDITS, check_albedos, read_albedos, set_albedos
from toftools.sim._xml_read import check_files, fill_defaults, include, parse, read_text
from toftools.sim.planes import STILL, moving
from toftools.sim.world import World, look_at
from toftools.types import F64


def xml_world(
    path: Path,
    *,
    unit_m: float = 1.0,
    lamps: float = 0.1,
    modulated: object = None,
    delay_ns: tuple[float, ...] = (0.0,),
    camera: tuple[float, ...] = (),
    target: tuple[float, ...] = (),
    up: tuple[float, ...] = (0.0, 1.0, 0.0),
    albedo: float = 0.0,
    albedos: str = "",
    velocity: tuple[float, float, float] = STILL,
) -> World:
    """World of a Mitsuba scene file.

    Parameters
    ----------
    path : Path
        The file.
    unit_m : float
        Length of one unit of the file, m.
    lamps : float
        Gain of the file's lamps: radiance 1 counts as so much of what a white surface at 1 m
        sends back of the camera's own light; 0 switches them off. Files are exposed for display,
        white surfaces near radiance 1. The default takes 700 lx of daylight, about 0.3 W/m2
        within 50 nm around 850 nm, against a flash of 2 W over a wide field, about 2 W/m2 at 1 m
        (estimates): the public living room has then a median of 0.016, and a white wall at 3.5 m
        sends back 0.08 of the flash.
    modulated : str or tuple of str or None
        Ids of lamps, or of the shapes that carry them, that are modulated; all others are ambient.
    delay_ns : tuple of float
        Delay of the modulated lamps, ns: one for all, or one for each.
    camera, target : tuple of 3 floats
        Place of the camera and a point on its axis, units of the file; empty for the pose of the
        file's own sensor.
    up : tuple of 3 floats
        Direction that points upwards in the image, if `camera` is given.
    albedo : float
        Albedo of all diffuse materials and the bodies of plastics, 0..1; 0 for what the file says.
    albedos : str
        TOML file of material ids with an albedo each, ``Walls = 0.7``; it precedes `albedo`.
    velocity : tuple of 3 floats
        Velocity of the camera in its own frame, m/s.

    Returns
    -------
    World
        The scene, its notes telling every edit.

    Raises
    ------
    ValueError
        If the file is no scene, asks for files that are not there, or a parameter is impossible.
    """
    root = parse(read_text(path), path.name)
    notes: Counter[str] = Counter()
    include(root, path.parent)
    fill_defaults(root)
    for edit in EDITS:
        edit(root, notes)
    check_albedos(root)
    set_albedos(root, albedo, read_albedos(albedos) if albedos else {}, notes)
    check_files(root, path.parent)
    return World(
        ElementTree.tostring(root, encoding="unicode"),
        folder=path.parent,
        to_world=_pose(camera, target, up),
        unit_m=unit_m,
        lamp_gain=lamps,
        modulated_s=_delays(modulated, delay_ns),
        velocity_mps=moving("camera", velocity),
        notes=tuple(f"{what} ({count})" for what, count in notes.items()),
    )


def with_files(text: str, folder: Path) -> tuple[str, list[Path]]:
    """The text of a scene with the names of its files made absolute, and those files.

    Parameters
    ----------
    text : str
        Scene file.
    folder : Path
        Where its relative names start.

    Returns
    -------
    tuple of str and list of Path
        The same scene, loadable from anywhere, and the files.

    Raises
    ------
    ValueError
        If it is no scene, or a file is missing or outside the folder.
    """
    root = parse(text, "the scene")
    files = check_files(root, folder, absolute=True)
    return ElementTree.tostring(root, encoding="unicode"), files


def _pose(
    camera: tuple[float, ...], target: tuple[float, ...], up: tuple[float, ...]
) -> F64 | None:
    given = [np.size(camera) > 0, np.size(target) > 0]
    if any(given) and not all(given):
        msg = f"got camera={camera} and target={target}; wanted both, as x+y+z, or neither"
        raise ValueError(msg)
    return look_at(camera, target, up) if all(given) else None


def _delays(modulated: object, delay_ns: tuple[float, ...]) -> dict[str, float]:
    """Delay of each modulated lamp, s."""
    ids = modulated if isinstance(modulated, tuple) else () if modulated is None else (modulated,)
    delays = np.atleast_1d(np.asarray(delay_ns, np.float64)) * 1e-9
    if delays.size not in (1, len(ids)) or (not ids and delays.any()):
        msg = f"got {delays.size} delay_ns for {len(ids)} modulated lamps; wanted one each, or one"
        raise ValueError(msg)
    each = np.broadcast_to(delays, len(ids)) if ids else ()
    return dict(zip(map(str, ids), map(float, each), strict=True))
