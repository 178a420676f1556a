"""What a data set holds: a line per capture, kept through every kind of end.

While a set is made every capture is noted in ``journal.jsonl`` at once; at the end
``manifest.jsonl`` holds them in the order of the recipe. Either may be damaged or gone: what is not
told is read from the captures again.
"""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from toftools.dataset.recipe import Recipe
from toftools.io.atomic import atomic_path

Entry = dict[str, Any]
MANIFEST, JOURNAL, FAILED = "manifest.jsonl", "journal.jsonl", "failed.jsonl"
STALE_S = 3600.0
"""Age from which a temporary file has no writer any more."""


def read_manifest(out: Path) -> list[Entry]:
    """Lines of the manifest of a data set.

    Parameters
    ----------
    out : Path
        Folder.

    Returns
    -------
    list of dict
        One per capture; none without a manifest, and none for lines that are damaged.
    """
    return [entry for entry in _lines(out / MANIFEST) if _is_entry(entry)]


def present(out: Path) -> dict[str, Entry]:
    """What is known of captures that are there, as large as they were.

    Parameters
    ----------
    out : Path
        Folder.

    Returns
    -------
    dict of str to dict
        Entries by id.
    """
    told = [*read_manifest(out), *(e for e in _lines(out / JOURNAL) if _is_entry(e))]
    return {entry["id"]: entry for entry in told if is_there(out, entry)}


def is_there(out: Path, entry: Entry) -> bool:
    """Whether the capture of an entry is where it should be, as large as it was.

    Parameters
    ----------
    out : Path
        Folder.
    entry : dict
        Its line.

    Returns
    -------
    bool
        False for one that is missing or cut.
    """
    try:
        return bool(file_of(out, entry["id"]).stat().st_size == entry["bytes"])
    except OSError:
        return False


def file_of(out: Path, name: str) -> Path:
    """File of a capture.

    Parameters
    ----------
    out : Path
        Folder of the data set.
    name : str
        Id of the capture.

    Returns
    -------
    Path
        ``captures/<id>.h5``.
    """
    return out / "captures" / f"{name}.h5"


def note(out: Path, entry: Entry) -> None:
    """Add a capture to the journal.

    Parameters
    ----------
    out : Path
        Folder.
    entry : dict
        Its line.
    """
    with (out / JOURNAL).open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")


def write(out: Path, recipe: Recipe, entries: Sequence[Entry], failed: Mapping[str, str]) -> None:
    """Write the manifest, what failed, and the recipe; the journal has done its work.

    Parameters
    ----------
    out : Path
        Folder.
    recipe : Recipe
        What was asked for.
    entries : sequence of dict
        What is there.
    failed : mapping of str to str
        Ids of what is not, and why.
    """
    missing = [{"id": name, "error": why} for name, why in failed.items()]
    for name, lines in ((MANIFEST, entries), (FAILED, missing)):
        _write(out / name, "".join(json.dumps(line) + "\n" for line in lines))
    _write(out / "recipe.toml", recipe.text)
    (out / JOURNAL).unlink(missing_ok=True)


def clean(out: Path) -> None:
    """Remove what killed writers have left behind, but nothing that may still be written.

    Parameters
    ----------
    out : Path
        Folder.
    """
    for file in (*out.glob(".*.*.*"), *(out / "captures").glob(".*.h5")):
        if time.time() - file.stat().st_mtime > STALE_S:
            file.unlink(missing_ok=True)


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _lines(file: Path) -> list[Any]:
    found = []
    if file.is_file():
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                found.append(json.loads(line))
            except ValueError:  # cut by whoever was killed
                continue
    return found


def _is_entry(value: object) -> bool:
    return (
        isinstance(value, dict)
        and isinstance(value.get("id"), str)
        and isinstance(value.get("bytes"), int)
    )
