"""The page of findings: figures come from the run, and what it does not bear out is refused."""

import json
import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import stress_page

ROOT = Path(__file__).parent.parent
ALBEDO = stress_page.FINDINGS[0]


def run(folder, network_m):
    """Rows of one axis, as `toftools bench stress` leaves them."""
    (folder / "figures").mkdir(parents=True)
    (folder / "figures" / "axis-albedo.svg").write_text("<svg/>")
    told = {"axis": "albedo", "breaks_at": None, "benign_m": 0.01, "flags": ["overconfident"]}
    labels = (stress_page.CRT, stress_page.NET, stress_page.AUTO, stress_page.PLAIN)
    (folder / "stability.json").write_text(json.dumps([{**told, "label": one} for one in labels]))
    rows = []
    for value, errors in ((0.1, (0.01, network_m, 0.03, 0.01)), (0.3, (0.02,) * 4),
                          (0.5, (0.03, 0.01, 0.01, 0.01))):  # fmt: skip
        for label, mae_m in zip(labels, errors, strict=True):
            name, _, dial = label.partition(":")
            key, _, text = dial.partition("=")
            params = {key: int(text) if text.isdigit() else text} if key else {}
            rows.append({
                "suite": "stress", "capture": "v", "capture_id": f"v-{value}",
                "group": "axis: albedo", "axis": "albedo", "value": value, "seed": 0,
                "method": name, "params": params,
                "against": "truth", "status": "ok", "error": None, "metrics": {"mae_m": mae_m},
                "setup_s": 1.0, "first_call_s": 1.0, "ms": 1.0, "ms_iqr": 0.1, "peak_mb": 1.0,
                "machine": {"cpu": "some", "threads": 1, "cores": 1, "system": "x"}, "versions": {},
            })  # fmt: skip
    (folder / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_figures_are_those_of_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(stress_page, "FINDINGS", [ALBEDO])
    out = tmp_path / "docs"
    out.mkdir()
    page = stress_page.page(run(tmp_path / "run", 0.08), out)
    assert "`crt` errs by 1.00 cm, `network` by 8.00" in page
    assert (out / "axis-albedo.svg").is_file() and "| `network` | holds (1.00) o |" in page


def test_a_finding_that_no_longer_holds_stops_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(stress_page, "FINDINGS", [ALBEDO])
    with pytest.raises(ValueError, match="does not bear out: Where least light bounces"):
        stress_page.page(run(tmp_path / "run", 0.012), tmp_path)


def test_the_committed_page_has_every_finding_and_its_curve():
    page = (ROOT / "docs" / "stress" / "index.md").read_text(encoding="utf-8")
    for title, axis, *_ in stress_page.FINDINGS:
        assert f"### {title}" in page and f"![{axis}]" in page
    for name in re.findall(r"\]\((axis-[^)]+)\)", page):
        assert (ROOT / "docs" / "stress" / name).is_file()
