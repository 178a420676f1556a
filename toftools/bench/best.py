"""Settings of a group of captures compared, and the best setting of each method.

A setting *answers* a capture with a finite error and at least half of the pixels: less is no answer
to compare, since the pixels that were left out are the hard ones. A setting is *whole* if it
answers every capture of the group that can be scored. The best setting of a method is the whole one
with the least mean absolute error; if none is whole, the one that answers most captures, then the
least error. It is chosen with the truth at hand, as by one who tuned on these captures.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from toftools.bench.references import REFERENCES
from toftools.bench.rows import finite
from toftools.bench.table import label_of

LEAST_VALID = 0.5
"""Share of the pixels from which a capture counts as answered, as on a stress axis."""


@dataclass(frozen=True)
class Entry:
    """One setting of a method over the captures of a group.

    Parameters
    ----------
    label, method : str
        With its parameters, and without.
    timed : bool
        False for reference rows.
    mae_m : float
        Mean over the captures with a finite error, m.
    ms : tuple of float
        Time of every capture that has one, ms.
    captures, answered : int
        Captures that can be scored, and those of them that it answers.
    valid_share : float
        Mean share of the pixels answered, 0..1.
    """

    label: str
    method: str
    timed: bool
    mae_m: float
    ms: tuple[float, ...]
    captures: int
    answered: int
    valid_share: float

    @property
    def whole(self) -> bool:
        """Whether every capture is answered."""
        return self.answered == self.captures > 0

    @property
    def mean_ms(self) -> float:
        """Mean time over captures, ms, as in the table of the group."""
        return float(np.mean(self.ms)) if self.ms else float("nan")


def entries(rows: Sequence[Mapping[str, Any]]) -> list[Entry]:
    """All settings of a group that suit one of its captures or more.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of one group.

    Returns
    -------
    list of Entry
        In the order of the rows; empty where nothing can be scored.
    """
    scored = {str(row["capture_id"]) for row in rows if _known(row, "input_mae_m")}
    by_label: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["capture_id"] in scored:
            by_label.setdefault(label_of(row), []).append(row)
    return [
        _entry(label, mine, len(scored))
        for label, mine in by_label.items()
        if any(row["status"] != "unsuited" for row in mine)
    ]


def best_of_each(found: Iterable[Entry]) -> dict[str, Entry]:
    """The best setting of every timed method; references are not compared.

    Parameters
    ----------
    found : iterable of Entry
        Settings of one group.

    Returns
    -------
    dict of str to Entry
        By method, in order of appearance.
    """
    best: dict[str, Entry] = {}
    for one in found:
        if one.timed and (one.method not in best or _order(one) < _order(best[one.method])):
            best[one.method] = one
    return best


def _order(one: Entry) -> tuple[int, float]:
    return -one.answered, one.mae_m if np.isfinite(one.mae_m) else np.inf


def _known(row: Mapping[str, Any], name: str) -> bool:
    return bool(np.isfinite(finite(row["metrics"].get(name))))


def _entry(label: str, rows: Sequence[Mapping[str, Any]], captures: int) -> Entry:
    errors = [finite(row["metrics"].get("mae_m")) for row in rows]
    valid = [finite(row["metrics"].get("valid_share")) for row in rows]
    # An old row without a share of pixels has answered all that it was scored on.
    answered = [np.isfinite(e) and not v < LEAST_VALID for e, v in zip(errors, valid, strict=True)]
    known = [error for error in errors if np.isfinite(error)]
    shares = [v for v in valid if np.isfinite(v)]
    return Entry(
        label=label,
        method=str(rows[0]["method"]),
        timed=rows[0]["method"] not in REFERENCES,
        mae_m=float(np.mean(known)) if known else float("nan"),
        ms=tuple(float(row["ms"]) for row in rows if row.get("ms") is not None),
        captures=captures,
        answered=int(sum(answered)),
        valid_share=float(np.mean(shares)) if shares else float("nan"),
    )
