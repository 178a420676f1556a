"""Tables of the leaderboard: one per suite and group, ranked by mean error; one for stress."""

from toftools.bench.render import number

LEAST_VALID = 0.5
"""Share of pixels that a method must answer to have a rank; as on the stress axes."""
HEAD = ["rank", "method", "MAE cm", "p95 cm", "wraps %", "valid %", "ms", "MB", "holds on"]
STRESS_HEAD = ["rank", "method", "holds on", "survives %", "unstable on", "overconfident on",
               "fails on", "weakest on"]  # fmt: skip
INTRO = """# Leaderboard

Made by `python benchmarks/leaderboard.py` from finished runs; do not edit. Of a method's settings
the one with the least mean absolute error counts, and which that is, the truth has said: the row
names it, and how many were tried. Ranked is what answers every capture of the group, and at least
half of their pixels. Rows without a rank are references, which see the truth or are somebody's
published output, and the uncorrected input: what does not come before it is worse than doing
nothing. Against the camera's own distance nothing is ranked: to be near it is to share its errors.
ms is the time of a frame, the mean over captures of medians, MB the memory beyond an empty process;
*holds on* is the number of stress axes on which a method does not break, from the suite `stress`:
of the very setting where that suite has it, else of the one setting that it has.

## Your own row

```sh
toftools bench core --method your_method:make --out out/core
python benchmarks/leaderboard.py --take out/core
```

The first command runs your method ([how to write one](benchmark.md#a-method-of-your-own)) beside
all others, so that times are those of one machine; the second adds the figures to this page, under
the class of your machine. `toftools bench stress --method your_method:make --out out/stress`, taken
likewise, fills *holds on*. To publish a row, send the new files of `benchmarks/results/` together
with the file of the method."""


def page(boards):
    parts = [INTRO]
    # Breaking points are errors, not times: those of another class of machine will do.
    everywhere = holds(rows for suites in boards.values() for _, rows in suites.values())
    for kind, suites in boards.items():
        first = next(iter(suites.values()))[0]["machine"]
        parts.append(f"## {kind}\n\n{first['cpu']}, {first['cores']} cores, {first['threads']} "
                     f"threads, {first['system']}.")  # fmt: skip
        held = everywhere | holds(rows for _, rows in suites.values())
        for about, rows in suites.values():
            parts += [about_text(about), *group_tables(rows, held), *stress_table(rows)]
    return "\n\n".join(parts) + "\n"


def about_text(about):
    names = ", ".join(f"{name} {text}" for name, text in about["versions"].items())
    return (f"### Suite {about['suite']}\n\nCommit {about['commit']}; {about['points']} points on "
            f"{about['captures']} captures; {names}.")  # fmt: skip


def holds(suites):
    """Setting, and method where it has one setting, to how many axes it holds on, of how many."""
    stress = [row for rows in suites for row in rows if "stress" in row]
    found = {row["stress"]: f"{held(row)} of {len(row['breaks_at'])}" for row in stress}
    for name in {row["stress"].partition(":")[0] for row in stress}:
        mine = [label for label in found if label.partition(":")[0] == name]
        if len(mine) == 1 and " > " not in mine[0]:
            found.setdefault(name, found[mine[0]])
    return found


def held(row):
    return sum(value is None for value in row["breaks_at"].values())


def survives(row):
    return sum(row["survives"].values()) / len(row["survives"])


def weakest(row, most=3):
    """Axes of which it survives least."""
    broken = [axis for axis, value in row["breaks_at"].items() if value is not None]
    return sorted(broken, key=row["survives"].get)[:most]


def group_tables(rows, held):
    for group in dict.fromkeys(row["group"] for row in rows if "group" in row):
        mine = [row for row in rows if row.get("group") == group]
        shown = best_of_each([row for row in mine if "label" in row])
        yield f"#### {group}\n\n" + table(HEAD, ranked(shown, held))
        told = [f"`{row['label']}`: {row['note']}" for row, _ in shown if row["note"]]
        told += [row["unsuited"] for row in mine if "unsuited" in row]
        if told:
            yield "\n".join(f"- {sentence}" for sentence in told)


def best_of_each(rows):
    """The best setting of every method with the number of its settings; references keep all."""
    by_method = {}
    for row in rows:
        by_method.setdefault(row["method"] if row["timed"] else row["label"], []).append(row)
    best = [(min(mine, key=order), len(mine)) for mine in by_method.values()]
    return sorted(best, key=lambda pair: order(pair[0]))


def order(row):
    """What answers all captures first, then by mean error; no error at all comes last."""
    error = float("inf") if row["mae_m"] is None else row["mae_m"]
    return (row["timed"] and not counts(row), error)


def counts(row):
    """Whether a row may have a rank."""
    enough = row["valid_share"] is not None and row["valid_share"] >= LEAST_VALID
    known = row.get("against", "truth") == "truth"  # to be near the camera is to share its errors
    return known and row["timed"] and row["complete"] and enough and row["mae_m"] is not None


def ranked(shown, held):
    place = 0
    for row, settings in shown:
        place += counts(row)
        name = f"`{row['label']}`" + (f", best of {settings}" if settings > 1 else "")
        figures = [number(row["mae_m"], 100), number(row["p95_m"], 100),
                   number(row["wrap_share"], 100), number(row["valid_share"], 100, ".1f"),
                   number(row["ms"]), number(row["peak_mb"], 1, ".0f")]  # fmt: skip
        on = held.get(row["label"], held.get(row["method"], "–")) if row["timed"] else "–"
        yield [str(place) if counts(row) else "–", name, *figures, on]


def stress_table(rows):
    """Methods by the number of axes they hold on, then by how much of the axes they survive."""
    stress = [row for row in rows if "stress" in row]
    if not stress:
        return
    stress.sort(key=lambda row: (-held(row), -survives(row)))
    most = max(len(row["breaks_at"]) for row in stress)
    body = [
        [str(i), f"`{row['stress']}`", f"{held(row)} of {len(row['breaks_at'])}",
         number(survives(row), 100, ".0f"),
         *(str(len(row[flag])) for flag in ("unstable", "overconfident", "fails")),
         ", ".join(weakest(row))]
        for i, row in enumerate(stress, 1)
    ]  # fmt: skip
    yield (f"#### {most} stress axes\n\n*survives*: mean part of an axis, in steps of its values, "
           "before a method breaks. What breaking means: [docs/benchmark.md]"
           "(benchmark.md#stress-axes).\n\n" + table(STRESS_HEAD, body))  # fmt: skip


def table(head, rows):
    lines = [head, ["---:", "---", *["---:"] * (len(head) - 2)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
