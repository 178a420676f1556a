"""conditions.csv: what people type, what a hostile table tries, and what a recording carries."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from toftools.conditions import Conditions, conditions_of, name_of, with_conditions
from toftools.io.conditions import (
    COLUMNS,
    labelled,
    open_labelled,
    read_conditions,
    write_conditions,
)
from toftools.io.native import write_capture
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Scene, Shot


@pytest.fixture(scope="module")
def frame():
    camera = sensor("deeptof:width=6,height=4")
    return analytic(Scene("wall"))(Shot(camera, noisy=False))


@pytest.fixture
def folder(tmp_path, frame):
    for name in ("a.h5", "b.h5"):
        write_capture(tmp_path / name, frame)
    return tmp_path


def table(folder, text):
    (folder / "conditions.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def test_a_table_as_people_write_it(folder):
    text = (
        "\ufeffkind, file ,distance_m,normal,sensor_c,,\r\n"
        "# walls\r\n\r\n"
        'wall,"a.h5",2.5,0.1+0+-0.9,41.5,,\r\n'
        "dark,b.h5\r\n"
    )
    found = read_conditions(table(folder, text))
    assert list(found) == ["a.h5", "b.h5"]
    first, second = found.values()
    assert (first.kind, first.distance_m, first.normal) == ("wall", 2.5, (0.1, 0.0, -0.9))
    assert first.sensor_c == 41.5
    assert math.isnan(first.light_c)
    assert second.kind == "dark"
    assert not second.known
    assert vars(read_conditions(folder / "conditions.csv")["a.h5"])["distance_m"] == 2.5


def test_what_is_written_reads_back_to_the_last_digit(folder):
    rng = random.Random(3)
    told = {
        "a.h5": Conditions("rail", rng.random(), (rng.random(), -1e-3, -rng.random()), 1e-9 / 3),
        "b.h5": Conditions("flat", exposure=1 / 3, sensor_c=-12.125, reference="depth"),
    }
    path = write_conditions(folder, told)
    back = read_conditions(folder)
    assert path.name == "conditions.csv"
    assert [repr(x) for x in map(vars, back.values())] == [
        repr(x) for x in map(vars, told.values())
    ]
    assert "light_c" not in path.read_text().splitlines()[0]


BAD = {
    "unknown column": ("file,kind,distance\na.h5,wall,2", r"there is no column 'distance'"),
    "semicolons": ("file;kind\na.h5;wall", r"separate columns by commas"),
    "no kind column": ("file,distance_m\na.h5,2", r"lacks the columns file and kind"),
    "column twice": ("file,kind,kind\na.h5,wall,wall", r"column kind twice"),
    "word for number": ("file,kind,distance_m\na.h5,wall,2 m", r"line 2: got distance_m '2 m'"),
    "nan": ("file,kind,distance_m\na.h5,wall,nan", r"line 2: got distance_m 'nan'"),
    "too large": ("file,kind,distance_m\na.h5,wall,1e999", r"line 2: distance_m must be positive"),
    "decimal comma": ("file,kind,distance_m\na.h5,wall,2,5", r"line 2: got 4 cells under 3"),
    "negative": ("file,kind,distance_m\na.h5,wall,-2", r"line 2: distance_m must be positive"),
    "short normal": ("file,kind,normal\na.h5,wall,0+1", r"line 2: got normal '0\+1'"),
    "normal away": ("file,kind,normal\na.h5,wall,0+0+1", r"line 2: normal must be three"),
    "kelvin": ("file,kind,sensor_c\na.h5,wall,300", r"line 2: sensor_c must be degrees"),
    "unknown kind": ("file,kind\na.h5,wand", r"line 2: got the kind 'wand'"),
    "no kind": ("file,kind\na.h5,", r"line 2: the kind is empty"),
    "no name": ("file,kind\n,wall", r"line 2: the file has no name"),
    "twice": ("file,kind\na.h5,wall\n./a.h5,wall", r"line 3: a.h5 has a line already, line 2"),
    "missing": ("file,kind\na.h5,wall\nc.h5,wall", r"line 3: there is no file c.h5"),
    "outside": ("file,kind\n../a.h5,wall", r"line 2: ../a.h5 lies outside"),
    "absolute": ("file,kind\n/etc/passwd,wall", r"line 2: /etc/passwd lies outside"),
    "drive": ("file,kind\nC:\\a.h5,wall", r"line 2: .* lies outside"),
    "control": ("file,kind\na\x00.h5,wall", r"line 2: .* is no file name"),
    "long name": ("file,kind\n" + "x" * 5000 + ",wall", r"line 2: .* is no file name"),
    "open quote": ('file,kind\n"a.h5,wall\n', r"line 2: unexpected end of data"),
    "huge cell": ("file,kind\na.h5," + "x" * 200_000, r"line 2: field larger than field limit"),
    "not text": (b"file,kind\na.h5,wall\n\xff\xfe,wall", r"line 3: not UTF-8"),
    "empty": ("", r"names no file"),
    "header only": ("file,kind\n", r"names no file"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_table_is_refused_in_one_sentence_with_its_line(folder, name):
    text, message = BAD[name]
    with pytest.raises(ValueError, match=message) as error:
        read_conditions(table(folder, text))
    assert "conditions.csv" in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_garbage_never_raises_anything_else(folder):
    rng = np.random.default_rng(5)
    good = b"file,kind,distance_m,normal\na.h5,wall,2,0+0+-1\nb.h5,dark,,\n"
    for _ in range(300):
        data = bytearray(good)
        for place in rng.integers(0, len(data), rng.integers(1, 6)):
            data[place] = rng.integers(0, 256)
        try:
            found = read_conditions(table(folder, bytes(data)))
        except ValueError as error:
            assert "conditions.csv" in str(error)
        else:
            assert found


def test_no_table_and_no_folder(tmp_path):
    with pytest.raises(ValueError, match="no such file"):
        read_conditions(tmp_path)
    with pytest.raises(ValueError, match="is no folder"):
        labelled(tmp_path / "nothing")
    with pytest.raises(ValueError, match=r"holds neither conditions\.csv nor capture files"):
        labelled(tmp_path)


def test_the_table_wins_over_the_file_and_the_file_over_nothing(folder, frame):
    write_capture(folder / "c.h5", with_conditions(frame, Conditions("rail", distance_m=3.0)))
    (folder / "notes.txt").write_text("not a recording")
    told = read_conditions(table(folder, "file,kind,distance_m\nb.h5,wall,2\nc.h5,gray,4\n"))
    paths = labelled(folder)
    assert [path.name for path in paths] == ["b.h5", "c.h5", "a.h5"]
    opened = open_labelled(folder / "c.h5", told["c.h5"])
    assert conditions_of(opened).kind == "gray"
    assert conditions_of(opened).distance_m == 4
    assert name_of(opened) == "c.h5"
    own = open_labelled(folder / "c.h5")
    assert conditions_of(own).distance_m == 3
    assert name_of(own) == "c.h5"
    with pytest.raises(ValueError, match=r"^a\.h5 does not say under what conditions"):
        open_labelled(folder / "a.h5")


def test_broken_conditions_inside_a_file_are_refused_by_name(folder, frame):
    for bad in ({"kind": "wand"}, {"kind": "wall", "distance_m": "far"}, 7, {"kind": ["wall"]}):
        write_capture(folder / "c.h5", replace(frame, provenance={"conditions": bad}))
        with pytest.raises(ValueError, match=r"^c\.h5"):
            open_labelled(folder / "c.h5")


def test_recordings_elsewhere_than_the_table(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("tables") / "mine.csv"
    other.write_text("file,kind\na.h5,wall\n")
    assert list(read_conditions(other, home=folder)) == ["a.h5"]
    with pytest.raises(ValueError, match=r"mine\.csv, line 2: there is no file a\.h5"):
        read_conditions(other)


def test_columns_are_the_fields_of_conditions():
    assert set(COLUMNS) == {"file", *vars(Conditions("wall"))}


def test_other_units_are_hinted_at():
    for wrong in ({"distance_m": 1500.0}, {"distance_m": 1.5, "delay_s": 12.5}):
        with pytest.raises(ValueError, match="check the units"):
            Conditions("wall", **wrong)


@pytest.mark.parametrize("told", [True, False], ids=["in the table", "not in it"])
def test_a_file_that_was_cut_off_says_so(tmp_path, told):
    capture = analytic(Scene("wall", {"range": 1.0}))(Shot(sensor("deeptof:width=8,height=6")))
    write_capture(tmp_path / "a.h5", capture)
    whole = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "b.h5").write_bytes(whole[: len(whole) // 2])
    lines = ["file,kind,distance_m", "a.h5,wall,1.0", *(["b.h5,wall,1.0"] if told else [])]
    (tmp_path / "conditions.csv").write_text("\n".join(lines) + "\n")
    assert [path.name for path in labelled(tmp_path)] == ["a.h5", "b.h5"]
    with pytest.raises(ValueError, match=r"b\.h5 is damaged or cut off"):
        open_labelled(tmp_path / "b.h5", Conditions("wall", distance_m=1.0))
