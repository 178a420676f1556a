"""The script that compares runs finds what differs, and only that."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import reruns


def row(method, mae_m, ms, **more):
    return {
        "capture": "wall", "capture_id": "wall-1", "group": "walls", "method": method, "params": {},
        "against": "truth", "status": "ok", "error": None, "metrics": {"mae_m": mae_m},
        "setup_s": 0.1, "first_call_s": 0.1, "ms": ms, "ms_iqr": 0.5, "peak_mb": 1.0, **more,
    }  # fmt: skip


FIRST = [row("a", 0.01, 10.0), row("b", 0.02, 5.0)]


def test_clocks_may_differ_and_nothing_else():
    slower = [row("a", 0.01, 10.4), row("b", 0.02, 7.0, peak_mb=9.0)]
    assert reruns.differing(FIRST, slower) == []
    assert reruns.times(FIRST, slower)["within_iqr"] == 0.5
    last_bit = [row("a", 0.01 + 2e-18, 10.0), row("b", 0.02, 5.0)]
    assert reruns.differing(FIRST, last_bit) == ["wall a ['metrics']"]
    assert reruns.differing(FIRST, FIRST[:1]) == ["2 rows and 1"]


def test_ranks_follow_the_error():
    assert reruns.ranks(FIRST) == {"walls": ["a", "b"]}
    assert reruns.ranks([row("a", 0.03, 1.0), FIRST[1]]) == {"walls": ["b", "a"]}


@pytest.mark.parametrize("what", ["twice", "killed"])
def test_a_whole_comparison(what, tmp_path, capsys):
    suite = tmp_path / "tiny.toml"
    suite.write_text(
        'name = "tiny"\nsensor = "deeptof:width=12,height=9"\nscenes = ["wall:range=2"]\n'
        'methods = ["single", "crt:max_range_m=0"]\nrepeats = 1\n'
    )
    given = [what, str(suite), "--out", str(tmp_path / "out"), "--kills", "1"]
    assert reruns.main([*given, "--", "--jobs", "2"]) == 0
    assert '"points": 2' in capsys.readouterr().out
    kept = tmp_path / "out" / what / "results.jsonl"
    rows = [json.loads(line) for line in kept.read_text().splitlines()]
    rows[0]["metrics"]["mae_m"] *= 1.0001
    kept.write_text("".join(json.dumps(line) + "\n" for line in rows))
    assert reruns.main(given) == 1
