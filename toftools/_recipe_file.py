"""Find and read a TOML file that a user names: a path, or one that comes with the package."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def read_toml(
    source: Path | str, folder: Path, what: str
) -> tuple[Path, str, Mapping[str, Any]]:  # fmt: skip
    """Read a recipe.

    Parameters
    ----------
    source : path or str
        TOML file, or the name of one in `folder`.
    folder : Path
        Of the files that come with the package.
    what : str
        What it is, for messages: ``recipe``.

    Returns
    -------
    path : Path
        The file.
    text : str
        Its text.
    given : mapping
        What it says.

    Raises
    ------
    ValueError
        If there is no such file, or it is no TOML.
    """
    path, known = Path(source), sorted(p.stem for p in folder.glob("*.toml"))
    if str(source) in known:
        path = folder / f"{source}.toml"
    elif not path.is_file():
        msg = f"got the {what} {str(source)!r}, wanted a TOML file or one of: {', '.join(known)}"
        raise ValueError(msg)
    try:
        text = path.read_text(encoding="utf-8")
        return path, text, tomllib.loads(text)
    except (OSError, ValueError) as error:
        msg = f"cannot read the {what} {path}: {error}"
        raise ValueError(msg) from error
