"""A chain survives the disk bit for bit, and files that are not chains say so in one sentence."""

import json
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import pytest

from toftools.calib.chain import Chain, applied, chain_for, extended
from toftools.calib.common_phase import CommonPhase
from toftools.calib.fixed_pattern import FixedPattern
from toftools.calib.stage import SLOTS, Residual, Stage
from toftools.calib.store import load_chain, save_chain
from toftools.conditions import Conditions, with_conditions
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Camera, Phasors, Scene, Shot

OWN = (__name__,)


@dataclass(frozen=True, eq=False)
class Turn:
    """A toy stage with every kind of value a stage may hold."""

    offset_rad: np.ndarray
    map_rad: np.ndarray
    camera: Camera
    names: tuple[str, ...] = ("a", "b")
    limit: float = float("nan")
    residual: Residual = field(default_factory=Residual)
    slot: ClassVar[str] = "fixed_pattern"

    def __call__(self, phasors):
        turn = np.exp(-1j * (self.offset_rad[:, None, None] + self.map_rad))
        return replace(phasors, values=(phasors.values * turn).astype(np.complex64))


@dataclass(frozen=True, eq=False)
class Later(Turn):
    slot: ClassVar[str] = "temperature"
    needs: tuple[str, ...] = ("sensor_c",)
    sensor_c: float = float("nan")

    def at(self, **temperatures):
        return replace(self, sensor_c=temperatures["sensor_c"])


DEVICE = sensor("opt8241:width=20,height=12")


def turn(cls=Turn, **changes):
    rng = np.random.default_rng(3)
    values = {
        "offset_rad": rng.normal(size=2),
        "map_rad": rng.normal(size=(2, 12, 20)),
        "camera": DEVICE.camera,
        "residual": Residual("mm", 3.0, 1.0, n=12, notes=("one sentence.",)),
        **changes,
    }
    return cls(**values)


def test_toy_is_a_stage():
    assert isinstance(turn(), Stage)


def test_round_trip_is_exact(tmp_path):
    chain = extended(chain_for(DEVICE), turn())
    save_chain(tmp_path / "cal.json", chain)
    again = load_chain(tmp_path / "cal.json", trusted=OWN)
    old, new = chain.stages[0], again.stages[0]
    np.testing.assert_array_equal(old.offset_rad, new.offset_rad)
    np.testing.assert_array_equal(old.map_rad, new.map_rad)
    np.testing.assert_array_equal(old.camera.K, new.camera.K)
    assert (new.names, new.residual) != ((), None)
    assert new.names == old.names
    assert new.residual.notes == old.residual.notes
    assert np.isnan(new.limit) and np.isnan(new.residual.held_out)
    assert again.freqs_hz.tolist() == chain.freqs_hz.tolist()
    assert (again.sensor, again.width, again.height) == (chain.sensor, chain.width, chain.height)


def test_a_person_can_read_it(tmp_path):
    save_chain(tmp_path / "cal.json", extended(chain_for(DEVICE), turn()))
    document = json.loads((tmp_path / "cal.json").read_text())
    assert document["sensor"]["freqs_hz"] == [40e6, 70e6]
    assert document["residuals"][0]["before"] == 3.0
    assert document["residuals"][0]["held_out"] is None
    assert len((tmp_path / "cal.json").read_text()) < 5000


def test_saving_again_leaves_one_archive(tmp_path):
    path = tmp_path / "cal.json"
    save_chain(path, extended(chain_for(DEVICE), turn()))
    first = set(tmp_path.iterdir())
    save_chain(path, extended(chain_for(DEVICE), turn(map_rad=np.zeros((2, 12, 20)))))
    second = set(tmp_path.iterdir())
    assert len(first) == len(second) == 2
    assert first != second
    load_chain(path, trusted=OWN)


def test_killed_between_archive_and_json_keeps_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "cal.json"
    save_chain(path, extended(chain_for(DEVICE), turn()))

    def die(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("toftools.calib.store.json.dumps", die)
    with pytest.raises(KeyboardInterrupt):
        save_chain(path, extended(chain_for(DEVICE), turn(map_rad=np.zeros((2, 12, 20)))))
    monkeypatch.undo()
    assert load_chain(path, trusted=OWN).stages[0].map_rad.any()


def edited(path, change):
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


HOSTILE = {
    "class": (lambda d: d["stages"][0].update({"class": "os:system"}), "class|no '?os|stage"),
    "format": (lambda d: d.update(format="other"), "format"),
    "version": (lambda d: d.update(version=9), "version"),
    "sha": (lambda d: d["arrays"].update(sha256="0"), "copy both"),
    "outside": (lambda d: d["arrays"].update(file="../x.npz"), "beside"),
    "gone": (lambda d: d["arrays"].update(file="cal.0.npz"), "missing"),
    "field": (lambda d: d["stages"][0].update(surprise=1), "surprise"),
    "sensor": (lambda d: d.pop("sensor"), "sensor"),
    "stages": (lambda d: d.update(stages=[3]), "stage"),
    "number": (lambda d: d["stages"][0].update(limit={"number": "1e9"}), "1e9"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_a_sentence(tmp_path, name):
    path = tmp_path / "cal.json"
    save_chain(path, extended(chain_for(DEVICE), turn()))
    change, expected = HOSTILE[name]
    edited(path, change)
    with pytest.raises(ValueError, match=expected) as caught:
        load_chain(path, trusted=OWN)
    assert "cal.json" in str(caught.value)


WRONG = {
    "residual": lambda d: d["stages"][0]["residual"].update(before="evil"),
    "notes": lambda d: d["stages"][0]["residual"].update(notes=5),
    "width": lambda d: d["sensor"].update(width=-64),
    "freqs": lambda d: d["sensor"].update(freqs_hz=[float("nan"), 1e7]),
    "size": lambda d: d["sensor"].update(width=21),
    "arrays": lambda d: d.pop("arrays"),
}


@pytest.mark.parametrize("name", WRONG)
def test_edited_files_name_themselves(tmp_path, name):
    path = tmp_path / "cal.json"
    stage = FixedPattern(np.zeros((2, 12, 20)) + 0.1, np.ones((2, 12, 20)) * 1e-3)
    save_chain(path, extended(chain_for(DEVICE), stage))
    load_chain(path)
    edited(path, WRONG[name])
    with pytest.raises(ValueError, match=r"cal\.json is not a readable calibration"):
        load_chain(path)


def test_a_number_too_long_for_python(tmp_path):
    path = tmp_path / "cal.json"
    path.write_text('{"format": ' + "9" * 5000 + "}")
    with pytest.raises(ValueError, match=r"cal\.json is no calibration"):
        load_chain(path)


def test_stages_of_other_frequencies_are_refused(tmp_path):
    path, other = tmp_path / "cal.json", sensor("kinect2_nominal:width=20,height=12")
    save_chain(path, extended(chain_for(other), CommonPhase([0.1] * 3, [1e-3] * 3, [25.0] * 2)))
    edited(path, lambda d: d["sensor"].update(freqs_hz=[40e6, 70e6]))
    with pytest.raises(ValueError, match="common_phase"):
        load_chain(path)


def test_a_backup_beside_it_stays_readable(tmp_path):
    path, backup = tmp_path / "cal.json", tmp_path / "cal_before.json"
    save_chain(path, extended(chain_for(DEVICE), turn()))
    backup.write_bytes(path.read_bytes())
    save_chain(path, extended(chain_for(DEVICE), turn(map_rad=np.zeros((2, 12, 20)))))
    assert load_chain(backup, trusted=OWN).stages[0].map_rad.any()
    assert not load_chain(path, trusted=OWN).stages[0].map_rad.any()


def test_files_that_it_did_not_write_stay(tmp_path):
    own = tmp_path / "cal.h5"
    own.write_bytes(b"mine")
    told = {"format": "toftools-calibration", "version": 1, "arrays": {"file": "cal.h5"}}
    (tmp_path / "cal.json").write_text(json.dumps(told))
    save_chain(tmp_path / "cal.json", extended(chain_for(DEVICE), turn()))
    assert own.read_bytes() == b"mine"
    (tmp_path / "notes.json").write_text('{"precious": 1}')
    with pytest.raises(ValueError, match="no calibration"):
        save_chain(tmp_path / "notes.json", extended(chain_for(DEVICE), turn()))
    assert json.loads((tmp_path / "notes.json").read_text()) == {"precious": 1}


def test_links_are_followed_by_both_files(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "cal.json").symlink_to(tmp_path / "real" / "cal_1.json")
    link = tmp_path / "link.json"
    link.symlink_to(tmp_path / "real" / "cal_1.json")
    save_chain(link, extended(chain_for(DEVICE), turn()))
    load_chain(tmp_path / "real" / "cal_1.json", trusted=OWN)


def test_what_json_cannot_hold_leaves_nothing(tmp_path):
    bad = replace(extended(chain_for(DEVICE), turn()), notes={"x": float("nan")})
    with pytest.raises(ValueError, match="nothing was written"):
        save_chain(tmp_path / "cal.json", bad)
    assert not list(tmp_path.iterdir())


def test_whole_numbers_stay_whole(tmp_path):
    chain = extended(chain_for(DEVICE), turn(limit=np.int64(33)))
    save_chain(tmp_path / "cal.json", chain)
    assert load_chain(tmp_path / "cal.json", trusted=OWN).stages[0].limit == 33
    assert isinstance(load_chain(tmp_path / "cal.json", trusted=OWN).stages[0].limit, int)


def test_own_classes_need_trust(tmp_path):
    save_chain(tmp_path / "cal.json", extended(chain_for(DEVICE), turn()))
    with pytest.raises(ValueError, match="trust"):
        load_chain(tmp_path / "cal.json")


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00", "{" * 5000])
def test_not_json(tmp_path, text):
    (tmp_path / "cal.json").write_text(text)
    with pytest.raises(ValueError, match="no calibration"):
        load_chain(tmp_path / "cal.json")


def test_order_is_enforced():
    chain = extended(chain_for(DEVICE), turn(Later))
    with pytest.raises(ValueError, match="order"):
        extended(chain, turn())
    with pytest.raises(ValueError, match="order"):
        Chain("x", 20, 12, DEVICE.modulation.freqs_hz, (turn(Later), turn()))
    assert [s.slot for s in extended(extended(chain_for(DEVICE), turn()), turn(Later)).stages] == [
        "fixed_pattern",
        "temperature",
    ]
    assert SLOTS.index("lens") == 0


def capture():
    return analytic(Scene("wall", {"range": 1.5}))(Shot(DEVICE, seed=1))


def test_applied_chain_turns_phasors_and_says_so():
    chain, raw = extended(chain_for(DEVICE), turn()), capture()
    done = applied(chain, raw)
    np.testing.assert_array_equal(done.phasors.values, turn()(raw.phasors).values)
    assert done.provenance["calibrated"] == ["fixed_pattern"]


def test_another_camera_is_refused():
    other = sensor("opt8241:width=24,height=12")
    with pytest.raises(ValueError, match="24 x 12"):
        applied(extended(chain_for(other), turn()), capture())


def test_missing_temperature_names_the_file():
    raw = with_conditions(capture(), Conditions("wall", distance_m=1.5), file="w.h5")
    chain = extended(chain_for(DEVICE), turn(Later))
    with pytest.raises(ValueError, match=r"w\.h5 does not say sensor_c"):
        applied(chain, raw)
    warm = with_conditions(raw, Conditions("wall", distance_m=1.5, sensor_c=30.0))
    assert isinstance(applied(chain, warm).phasors, Phasors)
