"""Tables of local sensitivity, from planted rows."""

import json

from toftools.bench.sensitivity_report import local


def row(value, noise, *, seed=0, status="ok", method="mine", axis="a", error=None):
    figures = {"noise": noise, "jumps": 0.0, "scale": 0.5, "shift_m": None}
    return {
        "axis": axis, "value": value, "seed": seed, "method": method, "params": {},
        "status": status, "metrics": {"median_m": 0.006745} if status == "ok" else {},
        "bound_m": 0.001, "spectral_radius": None, "sensitivity_error": error,
        "sensitivity": figures if status == "ok" and error is None else None,
    }  # fmt: skip


def test_easy_end_and_break_stand_in_the_table(tmp_path):
    values = (1, 10, 100, 1000)
    rows = [row(v, n + s, seed=s) for n, v in enumerate(values) for s in (0, 1)]
    told_ = [{"axis": "a", "label": "mine", "breaks_at": 40.0},  # next to 100 along the logarithm
             {"axis": "a", "label": "other", "breaks_at": None}]  # fmt: skip
    (tmp_path / "stability.json").write_text(json.dumps(told_))
    found = local(tmp_path, rows)
    assert found["table"]["rows"] == [["mine", "2.00", "0.00", "50.00", "–", "10.0", "–", ""]]
    body = found["axes"][0]["table"]["rows"]
    assert [line[:3] for line in body] == [["mine at 1", "easiest", "0.50"],
                                           ["mine at 100", "breaks", "2.50"]]  # fmt: skip
    kept = json.loads((tmp_path / "sensitivity.json").read_text())
    assert [line["noise"] for line in kept] == [0.5, 1.5, 2.5, 3.5]
    assert all(line["shift_m"] is None for line in kept)


def test_points_that_failed_keep_their_place(tmp_path):
    rows = [row(1, 0, status="failed"), row(2, 7), row(3, 0, error="it raised"),
            row(1, 0, method="kde", status="unsuited"),
            row(1, 0, method="oracle", status="failed")]  # fmt: skip
    found = local(tmp_path, rows)
    assert [line[0] for line in found["table"]["rows"]] == ["mine"]
    assert found["table"]["rows"][0][-1] == "2 of 3" and found["notes"] == ["mine: it raised"]
    assert found["axes"][0]["table"]["rows"][0][:3] == ["mine at 1", "easiest", "–"]


def test_without_axes_and_without_sensitivity(tmp_path):
    plain = {k: v for k, v in row(1, 2.0).items() if k not in ("axis", "value", "seed")}
    found = local(tmp_path, [plain])
    assert found["axes"] == [] and found["table"]["rows"][0][1] == "2.00"
    assert not (tmp_path / "sensitivity.csv").exists()
    old = {k: v for k, v in plain.items() if not k.startswith(("sens", "bound", "spec"))}
    assert local(tmp_path, [old]) == {} and local(tmp_path, []) == {}
