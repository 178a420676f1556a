"""The leaderboard: ranks, what has none, stress axes, and that the committed page is fresh."""

import importlib
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MACHINE = {"cpu": "Some(R) Brand CPU @ 2GHz", "cores": 4, "threads": 2, "system": "Linux x86_64"}


@pytest.fixture
def board(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("leaderboard")


def row(method, capture, mae_m, *, status="ok", ms=2.0, valid=1.0, group="rooms", **params):
    figures = {"mae_m": mae_m, "p95_m": 0.2, "wrap_share": 0.01, "valid_share": valid,
               "input_mae_m": 0.05, "input_valid_share": 1.0}  # fmt: skip
    return {"suite": "tiny", "capture": capture, "capture_id": capture, "group": group,
            "method": method, "params": params, "against": "truth", "status": status,
            "error": None if status == "ok" else f"{method} cannot", "ms": ms, "setup_s": 0.1,
            "first_call_s": 0.1, "peak_mb": 10.0, "machine": MACHINE,
            "versions": {"toftools": "0.1.0"},
            "metrics": figures if status == "ok" else {}}  # fmt: skip


ROWS = [
    row("slow", "a", 0.02), row("slow", "b", 0.04),
    row("dial", "a", 0.08, window=3), row("dial", "b", 0.08, window=3),
    row("dial", "a", 0.01, window=5), row("dial", "b", 0.01, window=5),
    row("picky", "a", 0.001, valid=0.1), row("picky", "b", 0.001, valid=0.1),
    row("half", "a", 0.002), row("half", "b", None, status="failed"),
    row("oracle", "a", 0.005, ms=None), row("oracle", "b", 0.005, ms=None),
    row("three", "a", None, status="unsuited"), row("three", "b", None, status="unsuited"),
]  # fmt: skip
AXES = [
    {"axis": "light", "label": "slow", "breaks_at": None, "share": 1.0, "flags": []},
    {"axis": "clock", "label": "slow", "breaks_at": 12.0, "share": 0.25, "flags": ["unstable"]},
    {"axis": "light", "label": "dial:window=5", "breaks_at": 3.0, "share": 0.5, "flags": []},
]


def run(folder, rows=ROWS, axes=AXES):
    folder.mkdir(exist_ok=True)
    (folder / "results.jsonl").write_text("\n".join(map(json.dumps, rows)) + "\n")
    (folder / "stability.json").write_text(json.dumps(axes))
    return folder


def cells(page):
    return [[cell.strip() for cell in line.strip("|").split("|")]
            for line in page.splitlines() if line.startswith("| ")]  # fmt: skip


def made(board, tmp_path, *folders):
    words = ["--take", *map(str, folders), "--commit", "abc1234", "--page", str(tmp_path / "p.md")]
    board.main([*words, "--results", str(tmp_path / "kept")])
    return (tmp_path / "p.md").read_text(encoding="utf-8")


def test_a_run_becomes_ranks(board, tmp_path):
    page = made(board, tmp_path, run(tmp_path / "out"))
    assert "## some-brand-2ghz-2-threads" in page and "4 cores, 2 threads" in page
    assert "Commit abc1234; 14 points on 2 captures; toftools 0.1.0." in page
    lines = cells(page)
    assert [line[:3] for line in lines[2:9]] == [
        ["–", "`oracle`", "0.50"],
        ["1", "`dial:window=5`, best of 2", "1.00"],
        ["2", "`slow`", "3.00"],
        ["–", "`input (unwrapped, uncorrected)`", "5.00"],
        ["–", "`picky`", "0.10"],
        ["–", "`half`", "0.20"],
        ["rank", "method", "holds on"],
    ]
    dial, slow = lines[3], lines[4]
    assert dial[3:] == ["20.00", "1.00", "100.0", "2.00", "10", "0 of 1"]
    assert slow[-1] == "1 of 2"
    assert "- three does not apply here: three cannot" in page
    assert "- `half`: failed on 1 of 2: half cannot" in page


def test_against_the_camera_nothing_is_ranked(board, tmp_path):
    rows = [{**row(m, "a", e), "against": "camera"} for m, e in (("near", 0.01), ("far", 0.09))]
    table = cells(made(board, tmp_path, run(tmp_path / "run", rows, [])))
    assert {line[0] for line in table if "near" in line[1] or "far" in line[1]} == {"–"}


def test_times_of_several_machines_are_refused(board, tmp_path, capsys):
    rows = [row("a", "a", 0.01), {**row("b", "a", 0.02), "machine": {**MACHINE, "jobs": 4}}]
    with pytest.raises(SystemExit):
        made(board, tmp_path, run(tmp_path / "run", rows, []))
    assert "holds times of several machines" in capsys.readouterr().err


def test_rungs_of_ladders_are_not_compared_as_a_group(board, tmp_path):
    rows = [*ROWS, {**row("rung", "c", 1e-4), "ladders": ["bounces"]}]
    assert "rung" not in made(board, tmp_path, run(tmp_path / "run", rows))


def test_stress_axes_are_ranked_by_what_holds(board, tmp_path):
    lines = cells(made(board, tmp_path, run(tmp_path / "out")))
    assert lines[-2:] == [
        ["1", "`slow`", "1 of 2", "62", "1", "0", "0", "clock"],
        ["2", "`dial:window=5`", "0 of 1", "50", "0", "0", "0", "light"],
    ]


def test_a_later_run_replaces_the_suite_and_leaves_other_machines(board, tmp_path):
    other = [{**r, "machine": {**MACHINE, "threads": 8}} for r in ROWS]
    made(board, tmp_path, run(tmp_path / "out"), run(tmp_path / "wide", other))
    page = made(board, tmp_path, run(tmp_path / "out", [r for r in ROWS if r["method"] == "slow"]))
    two, eight = page.split("## some-brand-2ghz-8-threads")
    assert "`dial:window=5`, best of 2" in eight and "`dial:window=5`, best" not in two
    assert page == board.page(board.boards(tmp_path / "kept"))


def test_axes_held_are_known_to_other_machines(board, tmp_path):
    wide = [{**r, "machine": {**MACHINE, "threads": 8}} for r in ROWS]
    page = made(board, tmp_path, run(tmp_path / "out"), run(tmp_path / "wide", wide, []))
    eight = page.split("## some-brand-2ghz-8-threads")[1]
    slow = next(line for line in cells(eight) if line[1] == "`slow`")
    assert slow[-1] == "1 of 2" and "stress axes\n" not in eight


def test_what_is_no_finished_run_is_refused(board, tmp_path, capsys):
    for folder, words in (
        (tmp_path, "give the folder of a finished"),
        (run(tmp_path / "out", [*ROWS, row("late", "a", None, status="missing")]), "1 of 15"),
    ):
        with pytest.raises(SystemExit):
            made(board, tmp_path, folder)
        assert words in capsys.readouterr().err
    assert not (tmp_path / "kept").exists() and not (tmp_path / "p.md").exists()


def test_the_committed_page_is_fresh(board):
    page = (ROOT / "docs" / "leaderboard.md").read_text(encoding="utf-8")
    assert page == board.page(board.boards()), "run python benchmarks/leaderboard.py"
