"""What the times of some rows were taken on, in words: one sentence per machine."""

from collections.abc import Mapping, Sequence
from typing import Any

from toftools.bench.table import label_of

MOST_NAMES = 6


def platforms(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Machines and versions behind the times of rows.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of results.

    Returns
    -------
    list of str
        One sentence per machine; with several, each says which settings it timed. Empty if nothing
        was timed.

    Examples
    --------
    >>> machine = {"cpu": "A", "cores": 2, "threads": 1, "system": "Linux x86_64"}
    >>> row = {"method": "crt", "params": {}, "ms": 1.0, "machine": machine,
    ...        "versions": {"python": "3.11"}}
    >>> platforms([row])
    ['Times: A, 1 of 2 cores, Linux x86_64; python 3.11.']
    """
    found: dict[str, list[str]] = {}
    for row in rows:
        if row.get("ms") is not None and row.get("machine"):
            told = _sentence(row["machine"], row.get("versions") or {})
            found.setdefault(told, []).append(label_of(row))
    if len(found) < 2:
        return [f"Times: {told}." for told in found]
    return [
        f"Times come from {len(found)} machines and do not compare across them. "
        f"{place}: {told}, for {_names(labels)}."
        if place == 1
        else f"{place}: {told}, for {_names(labels)}."
        for place, (told, labels) in enumerate(found.items(), start=1)
    ]


def _sentence(machine: Mapping[str, Any], versions: Mapping[str, Any]) -> str:
    jobs = machine.get("jobs", 1)
    parts = [
        str(machine.get("cpu", "unknown processor")),
        f"{machine.get('threads', '?')} of {machine.get('cores', '?')} cores",
        str(machine.get("system", "unknown system")),
    ]
    if jobs == "cluster":
        parts.append("on a cluster")
    elif isinstance(jobs, int | float) and jobs > 1:
        parts.append(f"{jobs:g} points at once, so times of a busy machine")
    if machine.get("batch"):
        parts.append("in batches")
    told = ", ".join(parts)
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    return f"{told}; {named}" if named else told


def _names(labels: Sequence[str]) -> str:
    names = list(dict.fromkeys(labels))
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join(names[:MOST_NAMES]) + more
