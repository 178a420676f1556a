"""``DIR/results.jsonl`` read back, every line checked: the report trusts nothing in it.

Names end up in file names, in SVG and in HTML. What is no text that can be shown becomes a space;
what cannot be meant is refused with the number of its line.
"""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

NAMES = ("suite", "capture", "capture_id", "group", "method", "against", "status")
FIGURES = ("setup_s", "first_call_s", "ms", "ms_iqr", "peak_mb")
AGAINST = ("truth", "camera", "nothing")
MOST_LETTERS = 1000
MOST_ERROR_LETTERS = 2000
"""What is longer is cut: the report shows a sentence, not a log."""
MOST = 1e300
_ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+=-]{0,199}")


def read_rows(out: Path) -> list[dict[str, Any]]:
    """Rows of ``results.jsonl``.

    Parameters
    ----------
    out : Path
        Benchmark folder.

    Returns
    -------
    list of dict
        Rows.

    Raises
    ------
    ValueError
        If the folder was not scored, or a line is damaged.
    """
    path = out / "results.jsonl"
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except FileNotFoundError:
        msg = f"no results in {out}; run: toftools bench score {out}"
        raise ValueError(msg) from None
    except (OSError, ValueError) as error:
        msg = f"{path} is damaged ({error}); run: toftools bench score {out}"
        raise ValueError(msg) from error
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            rows.append(_checked(json.loads(line, parse_constant=_missing)))
        except (ValueError, RecursionError) as error:
            said = " ".join(str(error).split())[:200]
            msg = f"line {number} of {path} is damaged: {said}; run: toftools bench score {out}"
            raise ValueError(msg) from error
    return rows


def _missing(_: str) -> None:
    """NaN and infinity, which JSON does not have but many programs write: no figure."""


def _checked(row: object) -> dict[str, Any]:
    """The row with texts that can be shown.

    Raises
    ------
    ValueError
        If it is no row of results.
    """
    if not isinstance(row, dict):
        _wrong("the line", row, "an object")
    for name in NAMES:
        text = row.get(name)
        if not isinstance(text, str) or not 0 < len(text) <= MOST_LETTERS:
            _wrong(name, text, f"a text of 1 to {MOST_LETTERS} letters")
        row[name] = _shown(text)
    if not _ID.fullmatch(row["capture_id"]):
        _wrong("capture_id", row["capture_id"], "letters, digits, and . _ + = -")
    if row["against"] not in AGAINST:
        _wrong("against", row["against"], f"one of {', '.join(AGAINST)}")
    for name in (*FIGURES, "bound_m", "spectral_radius"):
        _number(name, row.get(name), positive=True)
    error = row.get("error")
    if error is not None and not isinstance(error, str):
        _wrong("error", error, "a text or null")
    row["error"] = error and _shown(error[:MOST_ERROR_LETTERS])
    row["params"] = _params(row.get("params"))
    for name in ("metrics", "intervals", "pixels", "z", "sensitivity"):
        _numbers(name, row, needed=name == "metrics")
    _told(row)
    _coverage(row.get("coverage"))
    _axis(row)
    return row


def _wrong(name: str, got: object, wanted: str) -> NoReturn:
    told = repr(got)
    told = told if len(told) <= 60 else f"{told[:57]}..."
    msg = f"{name} is {told}, wanted {wanted}"
    raise ValueError(msg)


def _shown(text: str) -> str:
    """The text with spaces for what cannot be shown: line breaks, control codes, half letters."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _number(name: str, value: object, *, positive: bool = False) -> None:
    if value is None:
        return
    # 1e999 is JSON and infinite; whole numbers beyond all floats are JSON too.
    if not isinstance(value, int | float) or isinstance(value, bool) or abs(value) >= MOST:
        _wrong(name, value, "a finite number or null")
    if positive and value < 0:
        _wrong(name, value, "no negative number")


def _numbers(name: str, row: Mapping[str, Any], *, needed: bool) -> None:
    table = row.get(name)
    if table is None and not needed:
        return
    if not isinstance(table, dict):
        _wrong(name, table, "an object of numbers")
    for key, value in table.items():
        _number(f"{name} {key[:60]}", value, positive=key.endswith("mae_m"))


def _params(params: object) -> dict[str, Any]:
    if not isinstance(params, dict):
        _wrong("params", params, "an object")
    for key, value in params.items():
        plain = value is None or isinstance(value, str | int | float)
        if not plain or len(key) + len(str(value)) > MOST_LETTERS:
            _wrong(
                f"parameter {_shown(key[:60])}", value, "a short text, a number or true or false"
            )
    return {_shown(key): _shown(v) if isinstance(v, str) else v for key, v in params.items()}


def _told(row: dict[str, Any]) -> None:
    """Machine and versions: short texts and numbers, or nothing."""
    for name in ("machine", "versions"):
        table = row.get(name)
        if table is None:
            row[name] = {}
            continue
        if not isinstance(table, dict):
            _wrong(name, table, "an object")
        for key, value in table.items():
            plain = isinstance(value, str | int | float) and len(str(value)) <= MOST_LETTERS
            if not plain:
                _wrong(f"{name} {key[:60]}", value, "a short text or a number")
            table[key] = _shown(value) if isinstance(value, str) else value


def _coverage(curve: object) -> None:
    if curve is None:
        return
    if not isinstance(curve, dict):
        _wrong("coverage", curve, "an object")
    shares, errors = curve.get("coverage"), curve.get("mae_m")
    if not isinstance(shares, list) or not isinstance(errors, list) or len(shares) != len(errors):
        _wrong("coverage", curve, "two lists of one length, coverage and mae_m")
    for value in (*shares, *errors):
        _number("coverage", value)


def _axis(row: dict[str, Any]) -> None:
    if "axis" not in row:
        return
    name = row["axis"]
    if not isinstance(name, str) or not 0 < len(name) <= MOST_LETTERS:
        _wrong("axis", name, f"a text of 1 to {MOST_LETTERS} letters")
    row["axis"] = _shown(name)
    for key in ("value", "seed"):
        _number(key, row.get(key))
        if row.get(key) is None:
            _wrong(key, None, "a number, since the row has an axis")


def finite(value: float | None) -> float:
    """A figure of a row as a float.

    Parameters
    ----------
    value : float or None
        As JSON has it.

    Returns
    -------
    float
        NaN for null.

    Examples
    --------
    >>> finite(None), finite(2)
    (nan, 2.0)
    """
    return math.nan if value is None else float(value)
