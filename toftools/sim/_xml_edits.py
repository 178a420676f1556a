"""The edits that bring a Mitsuba scene file to what Mitsuba 3 and a ToF camera need, by rule.

Each takes the root and counts what it did. Old names come from the documentation of Mitsuba 0.6
(W. Jakob, 2014), recalled, and from the public scene collections.
"""

import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from toftools.sim._xml_read import read_text

GONE = ("gamma", "extEta", "maxSmoothAngle")
SKIES = ("sky", "sun", "sunsky")
COATINGS = ("coating", "roughcoating")
AS_DIFFUSE = ("roughdiffuse", "phong", "ward")
SPECTRA = ("rgb", "srgb", "spectrum", "float")
ALBEDO_NAMES: Mapping[str, tuple[str, str]] = {
    "diffuse": ("reflectance", "reflectance"),
    "plastic": ("diffuseReflectance", "diffuse_reflectance"),
    "roughplastic": ("diffuseReflectance", "diffuse_reflectance"),
    "principled": ("base_color", "base_color"),
    "conductor": ("specularReflectance", "specular_reflectance"),
    "roughconductor": ("specularReflectance", "specular_reflectance"),
}
"""Materials whose albedo can be chosen, and the parameter it goes by, old and new."""
METALS = ("conductor", "roughconductor")
Notes = Counter[str]


def _children(root: Element) -> Iterator[tuple[Element, Element]]:
    """Every element with its parent; the tree may change meanwhile."""
    for parent in list(root.iter()):
        for child in list(parent):
            yield parent, child


def _drop_engine(root: Element, notes: Notes) -> None:
    for element in list(root):
        if element.tag in ("integrator", "path"):
            root.remove(element)
            notes[f"removed the {element.tag}"] += 1


def _keep_pose(root: Element, notes: Notes) -> None:
    """Of the first sensor only the pose: the ToF sensor brings its own optics.

    An orthographic one stands in for it, which bears a pose with a scale.
    """
    for i, sensor in enumerate(root.findall("sensor")):
        if i > 0:
            root.remove(sensor)
            notes["removed a further sensor"] += 1
            continue
        for child in list(sensor):
            if child.tag != "transform":
                sensor.remove(child)
        sensor.attrib.clear()
        sensor.set("type", "orthographic")
        notes["kept only the pose of the sensor"] += 1


def _drop_names(root: Element, notes: Notes) -> None:
    for parent, child in _children(root):
        if child.get("name") in GONE:
            parent.remove(child)
            notes[f"removed {child.get('name')}"] += 1


def _drop_skies(root: Element, notes: Notes) -> None:
    for parent, child in _children(root):
        if child.tag == "emitter" and child.get("type") in SKIES:
            parent.remove(child)
            notes[f"removed the emitter {child.get('type')}"] += 1


def _uncoat(root: Element, notes: Notes) -> None:
    """A coat becomes what it covers, under its own id."""
    while (found := next(filter(_is_coat, _children(root)), None)) is not None:
        parent, coat = found
        inner = next(e for e in coat if e.tag == "bsdf")
        inner.attrib.pop("id", None)
        inner.attrib.update({k: v for k, v in coat.items() if k != "type"})
        parent[list(parent).index(coat)] = inner
        notes[f"{coat.get('type')} -> its inner {inner.get('type')}"] += 1


def _is_coat(pair: tuple[Element, Element]) -> bool:
    coat = pair[1]
    return coat.get("type") in COATINGS and coat.find("bsdf") is not None


def _to_diffuse(root: Element, notes: Notes) -> None:
    for bsdf in root.iter("bsdf"):
        if bsdf.get("type") not in AS_DIFFUSE:
            continue
        notes[f"{bsdf.get('type')} -> diffuse"] += 1
        bsdf.set("type", "diffuse")
        for child in list(bsdf):
            if child.get("name") in ("diffuseReflectance", "diffuse_reflectance"):
                child.set("name", "reflectance")
            if child.get("name") != "reflectance":
                bsdf.remove(child)


def _look_at(root: Element, notes: Notes) -> None:
    for element in root.iter("lookAt"):
        element.tag = "lookat"
        notes["lookAt -> lookat"] += 1


def _bilinear(root: Element, notes: Notes) -> None:
    for element in root.iter("string"):
        if element.get("name") in ("filterType", "filter_type") and element.get("value") in (
            "trilinear",
            "ewa",
        ):
            notes[f"{element.get('value')} -> bilinear"] += 1
            element.set("value", "bilinear")


def _triples(root: Element, notes: Notes) -> None:
    """Three plain numbers are a colour, however they are labelled."""
    for element in root.iter("spectrum"):
        value = element.get("value", "")
        if ":" not in value and len(value.replace(",", " ").split()) == 3:
            element.tag = "rgb"
            notes["spectrum of three numbers -> rgb"] += 1


def is_old(root: Element) -> bool:
    """Whether a scene is of a version before 2, with names in camelCase."""
    return root.get("version", "3").split(".")[0] in ("0", "1")


def _version(root: Element, notes: Notes) -> None:
    old = root.get("version")
    wanted = "0.5.0" if is_old(root) else old or "3.0.0"
    if old != wanted:
        root.set("version", wanted)
        notes[f"version {old} -> {wanted}"] += 1


EDITS: tuple[Callable[[Element, Notes], None], ...] = (
    _drop_engine,
    _keep_pose,
    _drop_skies,
    _drop_names,
    _uncoat,
    _to_diffuse,
    _look_at,
    _bilinear,
    _triples,
    _version,
)


def check_albedos(root: Element) -> None:
    """Refuse reflectances outside 0..1, each number of a colour for itself.

    Parameters
    ----------
    root : Element
        Root of a scene.

    Raises
    ------
    ValueError
        If one is.
    """
    owner = {e: b.get("id", "") for b in root.iter("bsdf") if b.get("id") for e in b.iter()}
    for element in root.iter():
        name = element.get("name", "")
        if element.tag not in SPECTRA or not name.lower().endswith(("reflectance", "base_color")):
            continue
        for number in element.get("value", "").replace(",", " ").split():
            if not _is_albedo(number.rpartition(":")[2]):
                msg = f"{name}={number} of the material {owner.get(element, 'without id')!r}"
                raise ValueError(f"got {msg}, wanted an albedo in 0..1")


def _is_albedo(text: str) -> bool:
    try:
        return 0 <= float(text) <= 1
    except ValueError:  # a colour as #rrggbb, or a mistake that Mitsuba names
        return True


def read_albedos(name: str) -> dict[str, float]:
    """Albedos by material id out of a TOML file.

    Parameters
    ----------
    name : str
        File of lines such as ``Walls = 0.7``.

    Returns
    -------
    dict of str to float
        The albedos.

    Raises
    ------
    ValueError
        If it is no such file.
    """
    if not Path(name).is_file():
        raise ValueError(f"got albedos={name}, which is no file; wanted lines such as Walls = 0.7")
    try:
        table = tomllib.loads(read_text(Path(name)))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"albedos={name} is no TOML: {error}") from error
    for key, value in table.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
            raise ValueError(f"got {key} = {value!r} in {name}, wanted an albedo in 0..1")
    return table


def set_albedos(
    root: Element, albedo: float, albedos: Mapping[str, float], notes: Counter[str]
) -> None:
    """Give materials other albedos.

    Parameters
    ----------
    root : Element
        Root of a scene, changed in place.
    albedo : float
        Of every diffuse material and plastic, 0..1; 0 leaves them alone.
    albedos : mapping of str to float
        Of materials by id; these precede.
    notes : Counter
        Counts what was done.

    Raises
    ------
    ValueError
        If there is no such material, or it has no albedo.
    """
    if not 0 <= albedo <= 1:
        raise ValueError(f"albedo must lie in 0..1, 0 for what the file says, got {albedo}")
    if albedo > 0:
        for shape in root.iter("shape"):
            if not any(e.tag in ("bsdf", "ref") for e in shape) and shape.get("type") != "instance":
                SubElement(shape, "bsdf", type="diffuse")
        for bsdf in root.iter("bsdf"):
            if bsdf.get("type") in ALBEDO_NAMES and bsdf.get("type") not in METALS:
                _paint(bsdf, albedo, is_old(root))
                notes[f"albedo {albedo:g}"] += 1
    named = {b.get("id", ""): b for b in root.iter("bsdf") if b.get("id")}
    for name, value in albedos.items():
        inside = named[name].iter("bsdf") if name in named else ()
        bodies = [b for b in inside if b.get("type") in ALBEDO_NAMES]
        if not bodies:
            known = ", ".join(named) or "none"
            raise ValueError(f"got an albedo for {name!r}; materials with an id are: {known}")
        for body in bodies:
            _paint(body, value, is_old(root))
        notes[f"albedo of {name}: {value:g}"] += 1


def _paint(bsdf: Element, albedo: float, old: bool) -> None:
    names = ALBEDO_NAMES[bsdf.get("type", "")]
    for child in list(bsdf):
        if child.get("name") in names:
            bsdf.remove(child)
    SubElement(bsdf, "spectrum", name=names[0 if old else 1], value=f"{albedo:.9g}")
