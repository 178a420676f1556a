"""Scene files of strangers into a tree: bounded in size and depth, files only from their folder."""

import re
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

LARGEST_BYTES = 32 << 20
DEEPEST = 64
MOST_INCLUDES = 100


def read_text(path: Path) -> str:
    """Text of a file, refused if it is no text or too much of it.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    str
        Its text.

    Raises
    ------
    ValueError
        If it is no file, empty, larger than 32 MiB, or not UTF-8.
    """
    if not path.is_file():
        what = "a folder" if path.is_dir() else "nothing there" if not path.exists() else "no file"
        raise ValueError(f"got {what} at {path}, wanted a scene file")
    size = path.stat().st_size
    if not 0 < size <= LARGEST_BYTES:
        raise ValueError(f"{path.name} has {size} bytes, wanted a scene file of up to 32 MiB")
    try:
        return path.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        msg = f"{path.name} is not text in UTF-8 ({error}); save it so"
        raise ValueError(msg) from error


def parse(text: str, name: str) -> Element:
    """Tree of an XML text without entities and of bounded depth.

    Parameters
    ----------
    text : str
        XML.
    name : str
        What to call it in messages.

    Returns
    -------
    Element
        The root, a ``scene`` or a part of one.

    Raises
    ------
    ValueError
        If it is not well formed, or defines entities, or nests too deeply.
    """
    level = 0

    def refuse(*_what: object) -> None:
        msg = f"{name} has a document type, in which entities hide; remove its <!DOCTYPE>"
        raise ValueError(msg)

    def down(*_what: object) -> None:
        nonlocal level
        level += 1
        if level > DEEPEST:
            raise ValueError(f"{name} nests more than {DEEPEST} elements deep, which no scene does")

    def up(*_what: object) -> None:
        nonlocal level
        level -= 1

    scan = expat.ParserCreate("utf-8")
    scan.StartDoctypeDeclHandler = refuse
    scan.StartElementHandler, scan.EndElementHandler = down, up
    try:
        scan.Parse(text.encode("utf-8"), True)
        return ElementTree.fromstring(text)
    except (expat.ExpatError, ElementTree.ParseError, UnicodeEncodeError) as error:
        msg = f"{name} is not well-formed XML: {error}"
        raise ValueError(msg) from error


def include(root: Element, folder: Path) -> None:
    """Put included files in the place of their ``include`` elements.

    Parameters
    ----------
    root : Element
        Root of a scene, changed in place.
    folder : Path
        Its folder, which no file may leave.

    Raises
    ------
    ValueError
        If a file is missing, outside, or no XML, or there are too many.
    """
    bytes_left, done = LARGEST_BYTES, 0
    while (place := next((i for i, e in enumerate(root) if e.tag == "include"), None)) is not None:
        name = root[place].get("filename", "")
        text = read_text(inside(_filled(name, _defaults(root)), folder))
        bytes_left, done = bytes_left - len(text), done + 1
        if bytes_left < 0 or done > MOST_INCLUDES:
            msg = f"the scene includes more than {MOST_INCLUDES} files or 32 MiB, {name!r} the last"
            raise ValueError(msg)
        part = parse(text, name)
        root[place : place + 1] = list(part) if part.tag == "scene" else [part]
    if root.find(".//include") is not None:
        raise ValueError("an include stands inside another element; wanted it right below <scene>")


def _defaults(root: Element) -> dict[str, str]:
    return {e.get("name", ""): e.get("value", "") for e in root.findall("default")}


def _filled(text: str, values: dict[str, str]) -> str:
    return re.sub(r"\$(\w+)", lambda m: values.get(m[1], m[0]), text) if "$" in text else text


def fill_defaults(root: Element) -> None:
    """Put the values of ``default`` elements in the place of their names, ``$name``.

    Parameters
    ----------
    root : Element
        Root of a scene, changed in place.

    Raises
    ------
    ValueError
        If that makes the scene huge.
    """
    values, size = _defaults(root), 0
    for element in root.iter():
        for key, value in element.items():
            filled = _filled(value, values)
            size += len(filled)
            if size > LARGEST_BYTES:
                raise ValueError("the defaults of the scene expand to more than 32 MiB")
            element.set(key, filled)
    for default in root.findall("default"):
        root.remove(default)


def inside(name: str, folder: Path) -> Path:
    """Path of a file that a scene names, refused outside the folder of the scene.

    Parameters
    ----------
    name : str
        Name as written.
    folder : Path
        Folder of the scene.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ValueError
        If the name leads elsewhere, or to no file.
    """
    parts = PurePosixPath(name)
    if not name or parts.is_absolute() or ".." in parts.parts or ":" in name or "\\" in name:
        msg = f"the scene names the file {name!r}; wanted one inside its own folder, as a/b.obj"
        raise ValueError(msg)
    path = folder / name
    if not path.is_file():
        raise ValueError(f"the scene names the file {name!r}, which is not in {folder.absolute()}")
    return path


def check_files(root: Element, folder: Path, *, absolute: bool = False) -> list[Path]:
    """The files that a scene names, all of which are there.

    Parameters
    ----------
    root : Element
        Root of a scene.
    folder : Path
        Its folder.
    absolute : bool
        Whether to write their absolute names into the tree.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    ValueError
        If a file is missing or outside.
    """
    found = []
    for element in root.iter():
        key = "value" if element.get("name") == "filename" else "filename"
        if key in element.keys():  # noqa: SIM118 - an Element is no mapping
            path = inside(element.get(key, ""), folder)
            found.append(path)
            if absolute:
                element.set(key, str(path.absolute()))
    return found
