"""`toftools simulate` as a user meets it: engines, report, preview, progress, all errors."""

import contextlib
import io
import json
import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toftools.cli import main
from toftools.cli._report import missed
from toftools.io.native import read_capture
from toftools.sensors import PRESETS
from toftools.sim.analytic import SCENES
from toftools.sim.scenes import FILES, WORLDS

SMALL = ["--sensor", "deeptof:width=16,height=12", "--tol-mm", "50"]


def call(capsys, *args):
    with pytest.raises(SystemExit) as caught:
        main([str(a) for a in args])
    out = capsys.readouterr()
    return caught.value.code, out.out, out.err


def made(capsys, tmp_path, *args):
    """JSON of a run that must succeed, and its capture."""
    code, out, err = call(capsys, "simulate", *args, "--json", "--out", tmp_path / "c.h5")
    assert code == 0, err
    return json.loads(out), read_capture(tmp_path / "c.h5")


PAINT = '<bsdf type="diffuse"><rgb name="reflectance" value="{0},{0},{0}"/></bsdf>'
CUBE = f'<shape type="cube">{PAINT}</shape>'


def scene(body, at=(0, 0, 3), to=(0, 0, 0)):
    origin, target = (",".join(map(str, point)) for point in (at, to))
    view = f'<lookat origin="{origin}" target="{target}" up="0,1,0"/>'
    camera = f'<sensor type="perspective"><transform name="to_world">{view}</transform></sensor>'
    return f'<scene version="3.0.0">{camera}{body}</scene>'


BITMAP = (
    '<texture name="reflectance" type="bitmap"><string name="filename" value="gone.png"/></texture>'
)
FILES_MADE = {
    "good.xml": scene(CUBE.format(0.5)),
    "cut.xml": scene(CUBE.format(0.5))[:80],
    "empty.xml": "",
    "words.xml": "hello",
    "root.xml": '<shape type="cube"/>',
    "noshape.xml": scene(""),
    "nocamera.xml": f'<scene version="3.0.0">{CUBE.format(0.5)}</scene>',
    "nan.xml": scene(CUBE.format("nan")),
    "over.xml": scene(CUBE.format(1.2)),
    "under.xml": scene(CUBE.format(-0.2)),
    "nomesh.xml": scene('<shape type="obj"><string name="filename" value="gone.obj"/></shape>'),
    "noimage.xml": scene(f'<shape type="cube"><bsdf type="diffuse">{BITMAP}</bsdf></shape>'),
    "unknown.xml": scene('<shape type="cube"><bsdf type="unobtainium"/></shape>'),
    "noref.xml": scene('<shape type="cube"><ref id="gold"/></shape>'),
    "inside.xml": scene(CUBE.format(0.5), at=(0, 0, 0), to=(0, 0, 1)),
    "away.xml": scene(CUBE.format(0.5), to=(0, 0, 9)),
    "leaves.xml": scene('<shape type="ply"><string name="filename" value="../x.ply"/></shape>'),
    "cut.ply": "ply\nformat ascii 1.0\nelement vertex 3\n",
    "empty.obj": "",
    "junk.glb": "not a mesh",
    "dark.csv": "0 0\n90 0\n",
}

BAD_SCENES = [
    ("cut.xml", "cut.xml is not well-formed XML"),
    ("empty.xml", "empty.xml has 0 bytes"),
    ("words.xml", "words.xml is not well-formed XML"),
    ("root.xml", "wanted a <scene>"),
    ("noshape.xml", "the scene has no shapes"),
    ("nocamera.xml", "no sensor to take the pose from; give camera=x+y+z"),
    ("gone.xml", "got nothing there at gone.xml"),
    ("nan.xml", "got reflectance=nan of the material"),
    ("over.xml", "got reflectance=1.2 of the material"),
    ("under.xml", "got reflectance=-0.2 of the material"),
    ("nomesh.xml", "the scene names the file 'gone.obj', which is not in"),
    ("noimage.xml", "the scene names the file 'gone.png', which is not in"),
    ("unknown.xml", 'bsdf plugin of type "unobtainium"'),
    ("noref.xml", 'unresolved reference to "gold"'),
    ("inside.xml", "the camera stands inside a shape"),
    ("good.xml:camera=0+0+0,target=0+0+1", "the camera stands inside a shape"),
    ("away.xml", "the camera sees nothing"),
    ("leaves.xml", "wanted one inside its own folder"),
    ("good.xml:modulated=lamp", "which is no lamp of the scene; its lamps: none"),
    ("good.xml:albedo=2", "albedo must lie in 0..1"),
    ("good.xml:lamps=-1", "must be 0 or more, got -1"),
    ("good.xml:unit_m=0", "unit_m must be a positive number"),
    ("cut.ply", "found no triangles in cut.ply"),
    ("empty.obj", "empty.obj has 0 bytes"),
    ("junk.glb", "found no triangles in junk.glb"),
    ("gone.ply", "got no file at gone.ply"),
    ("cornell:material=gold", "got material 'gold', wanted one of: diffuse"),
    ("vshape:albedo=nan", "got albedo=nan, wanted a number"),
    ("vshape:albedo=1.5", "got 1.5"),
    ("room:seed=-1", "got seed=-1"),
    ("plates:gap=0", "gap must be a positive number"),
]
BAD = [([text, *SMALL], message) for text, message in BAD_SCENES]
BAD += [
    (["cornell", "--sensor", f"deeptof:{text}"], message)
    for text, message in [
        ("freqs=20", "freqs_hz must lie in 1e3..1e11 Hz, got [20.0]; give Hz, not MHz"),
        ("freqs=20e12", "freqs_hz must lie in 1e3..1e11 Hz"),
        ("freqs=-20e6", "freqs_hz must lie in 1e3..1e11 Hz"),
        ("beam=dark.csv", "intensities of 0 or more, not all 0"),
        ("signal_e=0", "noise terms must be positive"),
        ("emitter=0+0", "emitter_offset_m must be three finite metres, got [0.0, 0.0]"),
    ]
]
BAD += [
    (["wall", "--engine", "magic"], "unknown name 'magic'; known: analytic, radiosity, path"),
    (["wall", "--engine", "auto:antialias=2"], "auto takes no parameters"),
    (["wall", "--engine", "path:antialias=99"], "antialias must be 1..16"),
    (["wall", "--engine", "path:spp=9"], "path has no parameter 'spp'; it takes: antialias"),
    (["cornell", "--engine", "analytic"], "no closed form for scene 'cornell'"),
    (["good.xml", "--engine", "analytic"], "scene files have no closed form, take the engine path"),
    (["two_returns", "--engine", "path"], "has no geometry, take analytic"),
    (["wall", "--engine", "analytic", "--spp", "4"], "--spp counts paths"),
    (["wall", "--engine", "mine:text"], "gave str, wanted a Capture"),
    (["wall", "--tol-mm", "0"], "got --tol-mm 0, wanted a positive number"),
    (["wall", "--tol-mm", "nan"], "got --tol-mm nan, wanted a positive number"),
    (["wall", "--spp", "0"], "0 is not in the range"),
    (["wall", "--seed", "-1"], "-1 is not in the range"),
    (["wall", "--max-bounces", "-1"], "wanted auto or a whole number of bounces"),
    (["wall", "--max-bounces", "all"], "wanted auto or a whole number of bounces"),
    (["wall", "--preview", "x.jpg"], "name it *.png"),
    (["wall", "--preview", "no/x.png"], "choose a writable folder"),
    (["wall", "--out", "x.png"], "a capture file is HDF5, so name it *.h5"),
    (["wall", "--out", "no/x.h5"], "choose a writable folder"),
    (["wall", "--out", "folder.h5"], "is a directory"),
]


@pytest.mark.parametrize(("args", "message"), BAD, ids=[" ".join(args) for args, _ in BAD])
def test_bad_input_is_one_sentence_and_exit_code_two(capfd, monkeypatch, tmp_path, args, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.h5").mkdir()
    for name, text in FILES_MADE.items():
        Path(name).write_text(text)
    Path("mine.py").write_text("def text(scene):\n    return lambda shot: 'no capture'\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(tmp_path.rglob("*"))
    out = [] if "--out" in args else ["--out", "x.h5"]
    code, stdout, err = call(capfd, "simulate", *args, *out)  # capfd: libraries write past Python
    assert code == 2
    assert message in err
    assert stdout == ""
    lines = [line for line in err.splitlines() if not line.startswith(("Usage:", "Try ")) and line]
    assert len(lines) == 1, err
    left = {path for path in tmp_path.rglob("*") if "__pycache__" not in path.parts}
    assert left == before


def test_what_cannot_be_written_is_refused_before_anything_is_computed(
    capsys, monkeypatch, tmp_path
):
    def never(*_args, **_kwargs):
        raise AssertionError("computed first")

    monkeypatch.setattr("toftools.registry.Spec.build", never)
    for extra in (["--out", "no/c.h5"], ["--out", "c.h5", "--preview", "no/p.png"]):
        monkeypatch.chdir(tmp_path)
        code, _, err = call(capsys, "simulate", "wall", *extra)
        assert code == 2
        assert "choose a writable folder" in err
    assert list(tmp_path.iterdir()) == []


def test_help_names_every_scene_file_kind_and_sensor_and_loads_no_renderer():
    code = (
        "import sys\nfrom toftools.cli import main\n"
        "try:\n    main(['simulate', '--help'])\nexcept SystemExit: pass\n"
        "print(*sorted({m.split('.')[0] for m in sys.modules}), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    words = set(re.findall(r"[\w.]+", done.stdout))
    assert {*WORLDS, *SCENES} <= set(re.findall(r"\w+", done.stdout))
    assert set(PRESETS) <= words
    for suffix in FILES:
        assert suffix in done.stdout
    assert "* corner:range=2,angle=90,albedo=0.7" in done.stdout
    assert "  cornell:size=2,material=diffuse\n" in done.stdout
    loaded = set(done.stderr.split())
    assert not loaded & {"mitsuba", "drjit", "open3d", "matplotlib", "numba", "scipy", "h5py"}


def test_auto_says_which_engine_and_why(capsys, tmp_path):
    facts, capture = made(capsys, tmp_path, "wall", *SMALL)
    assert (facts["engine"], facts["engine_why"]) == ("analytic", "the scene has a closed form")
    assert capture.provenance["engine_why"] == facts["engine_why"]
    facts, capture = made(capsys, tmp_path, "corner", *SMALL)
    assert facts["engine"] == "radiosity"
    assert "ends after 1 indirect bounce" in facts["engine_why"]
    assert facts["max_bounces"] >= 1
    facts, _ = made(capsys, tmp_path, "corner", *SMALL, "--max-bounces", "1")
    assert (facts["engine"], facts["max_bounces"]) == ("analytic", 1)
    facts, _ = made(capsys, tmp_path, "corner", *SMALL, "--engine", "path:antialias=2")
    assert (facts["antialias"], facts["engine_why"]) == (2, "it was asked for")


def test_options_reach_the_engine(capsys, tmp_path):
    facts, capture = made(
        capsys, tmp_path, "vshape", "--sensor", "deeptof:width=16,height=12", "--spp", "8",
        "--max-bounces", "2", "--no-noise", "--seed", "5",
    )  # fmt: skip
    assert (facts["samples"], facts["max_bounces"]) == (8, 2)
    assert (facts["seed"], facts["path_seed"]) == (None, 5)
    assert facts["tolerance_met"] is None
    light = capture.truth.direct + capture.truth.one_bounce + capture.truth.rest
    assert np.allclose(capture.phasors.values, light, atol=1e-3 * np.abs(light).max())
    facts, _ = made(capsys, tmp_path, "vshape", *SMALL)
    assert facts["tolerance_mm"] == 50
    assert facts["standard_error_mm"] <= 50
    assert facts["wall_s"] > 0
    assert facts["peak_mb"] > 10


def test_the_report_says_what_was_modelled_and_why(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    lamp = '<shape type="sphere"><point name="center" value="0,3,0"/><emitter type="area">' \
           '<rgb name="radiance" value="4,4,4"/></emitter></shape>'  # fmt: skip
    Path("lit.xml").write_text(scene(CUBE.format(0.5) + lamp))
    code, out, err = call(capsys, "simulate", "lit.xml:lamps=0", *SMALL, "--out", "c.h5")
    assert code == 0, err
    for words in ("wrote c.h5: lit.xml:lamps=0, 16 x 12 px, 20 MHz",
                  "engine        radiosity, because a scene file has no closed form",
                  "0 modulated, 1 ambient, switched off", "not modelled", "caustics",
                  "% see a surface", "MB of memory"):  # fmt: skip
        assert words in out
    code, out, _ = call(capsys, "simulate", "lit.xml:lamps=0.2", *SMALL, "--out", "c.h5")
    assert "1 ambient, radiance 1 counts 0.2" in out
    code, out, _ = call(capsys, "simulate", "vshape:ambient_e=300", *SMALL, "--out", "c.h5")
    assert "tolerance     50 mm met over the image" in out
    assert "300 electrons per tap on every pixel, unmodulated" in out


def test_motion_that_no_tap_can_see_is_said_aloud(capsys, tmp_path):
    for scene_text, timing, words in (
        ("wall:velocity=0+0+1", "", "motion        NOT SEEN, as all taps are taken at once"),
        ("wall:velocity_mps=1", "", "motion        NOT SEEN"),
        ("wall:velocity=0+0+1", ",tap_interval_s=0.001", "motion        taps see the scene"),
    ):
        sensor = f"deeptof:width=16,height=12{timing}"
        code, out, err = call(
            capsys, "simulate", scene_text, "--sensor", sensor, "--out", tmp_path / "c.h5"
        )
        assert code == 0, err
        assert words in out
    _, out, _ = call(capsys, "simulate", "wall", *SMALL, "--out", tmp_path / "c.h5")
    assert "\n  motion" not in out


def test_darkness_is_said_aloud(capsys, tmp_path):
    code, out, _ = call(
        capsys, "simulate", "slab", *SMALL, "--max-bounces", "0", "--out", tmp_path / "c.h5"
    )
    assert code == 0
    assert "NONE gets modulated light" in out


def test_a_missed_tolerance_is_said_aloud_with_what_helps(capsys, tmp_path):
    code, out, _ = call(
        capsys, "simulate", "cornell", "--sensor", "deeptof:width=16,height=12", "--tol-mm", "0.01",
        "--engine", "path:max_samples=64", "--max-bounces", "3", "--out", tmp_path / "c.h5",
    )  # fmt: skip
    assert code == 0
    assert "0.01 mm NOT MET" in out
    assert "--engine path:max_samples=256" in out
    facts = {"tolerance_mm": 1.0, "standard_error_mm": 3.14, "samples": 64}
    assert "--tol-mm 3.2)" in missed(facts)
    assert "in 25.0% of the pixels" in missed({**facts, "within_tolerance": 0.75})


def test_preview_is_a_picture_beside_the_capture_or_where_it_is_wanted(
    capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    code, out, _ = call(capsys, "simulate", "vshape", *SMALL, "--preview", "--out", "v.h5")
    assert code == 0
    assert out.splitlines()[-1] == "wrote v.png"
    code, out, _ = call(
        capsys, "simulate", "two_returns", "--preview", "t.png", "--json", "--out", "c.h5"
    )
    assert json.loads(out)["preview"] == "t.png"
    for name in ("v.png", "t.png"):
        image = Image.open(name)
        assert image.width == 1260
        colours = np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)
        assert len(colours) > 500  # six maps, not a blank


def test_the_same_seed_makes_the_same_file(capsys, tmp_path):
    names = [tmp_path / "a.h5", tmp_path / "b.h5"]
    for name in names:
        assert call(capsys, "simulate", "tilted", *SMALL, "--seed", "3", "--out", name)[0] == 0
    assert names[0].read_bytes() == names[1].read_bytes()


def on_terminal(folder, *args, stop_after=None):
    """Output and exit code of the command on a terminal of its own."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "toftools", *args]
    process = subprocess.Popen(command, cwd=folder, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    seen = io.BytesIO()
    with contextlib.suppress(OSError):  # the terminal closes with its process
        while block := os.read(ours, 4096):
            seen.write(block)
            if stop_after is not None and stop_after in seen.getvalue():
                stop_after = None
                process.send_signal(signal.SIGINT)
    os.close(ours)
    return seen.getvalue().decode(), process.wait()


def test_progress_is_for_terminals(tmp_path):
    args = ["simulate", "vshape", *SMALL, "--engine", "path", "--out", "c.h5"]
    shown, code = on_terminal(tmp_path, *args)
    assert code == 0
    assert "\r\x1b[K0:00  " in shown
    assert "paths a pixel in" in shown
    assert shown.rpartition("\x1b[K")[2].startswith("wrote c.h5"), "the line stays in the way"
    command = [sys.executable, "-m", "toftools"]
    quiet = subprocess.run([*command, *args], cwd=tmp_path, capture_output=True, check=True)
    assert quiet.stderr == b""
    loud = subprocess.run([*command, "-v", *args], cwd=tmp_path, capture_output=True, check=True)
    assert b"INFO: 16 paths a pixel" in loud.stderr
    assert b"\r" not in loud.stderr


@pytest.mark.parametrize(("engine", "word"), [("radiosity", b"gathered"), ("path", b"bounces")])
def test_ctrl_c_stops_and_leaves_nothing(tmp_path, engine, word):
    shown, code = on_terminal(
        tmp_path, "simulate", "cornell", "--sensor", "kinect2", "--tol-mm", "0.1", "--out", "c.h5",
        "--engine", engine, stop_after=word,
    )  # fmt: skip
    assert code == 1
    assert shown.rstrip().endswith("stopped")
    assert "Traceback" not in shown
    assert list(tmp_path.iterdir()) == []
