"""The command line as a user meets it: exit codes, one-sentence errors, JSON on stdout."""

import json
import os
import re
import subprocess
import sys

import h5py
import numpy as np
import pytest

from toftools.camera import rays
from toftools.cli import VERBS, main
from toftools.registry import CORRECTIONS, READERS
from toftools.sensors import PRESETS, sensor
from toftools.sim.analytic import SCENES


def run(*args):
    done = subprocess.run([sys.executable, "-m", "toftools", *map(str, args)], capture_output=True,
                          text=True, check=False)  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def call(capsys, *args):
    """The same in this process: fast, for the many cases."""
    with pytest.raises(SystemExit) as caught:
        main([str(a) for a in args])
    out = capsys.readouterr()
    return caught.value.code, out.out, out.err


@pytest.fixture(scope="module")
def capture_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("cli") / "two.h5"
    code, _, err = run("simulate", "two_returns:range=2", "--sensor", "opt8241:width=24,height=18",
                       "--out", path, "--seed", 4)  # fmt: skip
    assert code == 0, err
    return path


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(capsys, verb):
    code, out, _ = call(capsys, verb, "--help")
    assert code == 0
    assert "Usage: toftools" in out


def test_help_names_what_can_be_typed(capsys):
    def help_of(verb):
        return call(capsys, verb, "--help")[1]

    assert "two_returns:range=2,extra=0.7,ratio=0.3,albedo=0.5\n" in help_of("simulate")
    named = [(SCENES, "simulate"), (PRESETS, "simulate"), (CORRECTIONS, "correct"),
             (READERS, "convert"), (READERS, "inspect"), (READERS, "cloud")]  # fmt: skip
    for words, verb in named:
        assert set(words) <= set(re.findall(r"\w+", help_of(verb)))


def test_version_and_unknown_verb(capsys):
    code, out, _ = call(capsys, "--version")
    assert (code, out.split()[0]) == (0, "toftools,")
    code, _, err = call(capsys, "simulat")
    assert code == 2
    assert "simulat" in err


def test_simulate_says_what_it_made_as_json(capsys, tmp_path):
    code, out, _ = call(capsys, "simulate", "cavity:radius=2", "--no-noise", "--json", "--sensor",
                        "deeptof:width=8,height=8", "--out", tmp_path / "c.h5")  # fmt: skip
    assert code == 0
    made = json.loads(out)
    assert made["scene"] == "cavity"
    assert made["seed"] is None


@pytest.mark.parametrize("suffix", ["npz", "png", "ply", "h5"])
def test_correct_writes_every_form(capsys, capture_file, tmp_path, suffix):
    target = tmp_path / f"answer.{suffix}"
    code, out, err = call(capsys, "correct", capture_file, "--method", "crt", "--out", target)
    assert code == 0, err
    assert "100.0% of pixels" in out
    assert target.stat().st_size > 0


@pytest.mark.parametrize("library", ["ros", "opencv", "open3d"])
def test_inspect_prints_intrinsics_for_other_libraries(capsys, capture_file, library):
    code, out, _ = call(capsys, "inspect", capture_file, "--intrinsics", library)
    assert code == 0
    assert "17.25" in out  # focal length: 230 px of the preset at 24 of 320 columns
    if library != "ros":
        json.loads(out)


def test_correct_json_and_answer_agree(capsys, capture_file, tmp_path):
    target = tmp_path / "answer.npz"
    code, out, _ = call(capsys, "correct", capture_file, "--method", "single:freq_index=1", "--out",
                        target, "--json")  # fmt: skip
    summary = json.loads(out)
    with np.load(target, allow_pickle=False) as answer:
        for key in ("range_m", "z_m", "sigma_m", "status"):
            assert key in answer.files
        assert summary["median_range_m"] == pytest.approx(float(np.nanmedian(answer["range_m"])))
        assert (answer["z_m"] <= answer["range_m"]).all()
    assert (code, summary["valid_share"]) == (0, 1.0)


@pytest.mark.parametrize("method", ["crt", "sra", "kde", "single"])
def test_every_answer_carries_an_amplitude(capsys, capture_file, tmp_path, method):
    with h5py.File(capture_file) as file:
        expected = np.abs(file["phasors"][0])
    for suffix in ("npz", "h5", "ply"):
        out = tmp_path / f"a.{suffix}"
        code, _, err = call(capsys, "correct", capture_file, "--method", method, "--out", out)
        assert code == 0, err
    with np.load(tmp_path / "a.npz") as answer, h5py.File(tmp_path / "a.h5") as file:
        assert np.array_equal(answer["amplitude"], expected)
        assert np.array_equal(file["depth/amplitude"], expected)
    assert b"property float amplitude" in (tmp_path / "a.ply").read_bytes()
    code, _, err = call(capsys, "cloud", tmp_path / "a.npz", "--colour", "amplitude", "--out",
                        tmp_path / "a.html")  # fmt: skip
    assert code == 0, err


def test_amplitude_is_not_made_up(capsys, tmp_path):
    """A depth alone enters as unit phasors, which say nothing about the signal."""
    np.savez(tmp_path / "d.npz", range_m=np.full((4, 6), 2.0), K=np.diag([50.0, 50, 1]))
    out = tmp_path / "a.npz"
    code, _, err = call(capsys, "correct", tmp_path / "d.npz", "--method", "crt", "--out", out)
    assert code == 0, err
    with np.load(out) as answer:
        assert "amplitude" not in answer.files


def test_an_answer_that_is_none_is_refused(capsys, capture_file, monkeypatch, tmp_path):
    (tmp_path / "mine_text.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    code, _, err = call(capsys, "correct", capture_file, "--method", "mine_text:text", "--out",
                        "a.npz")  # fmt: skip
    assert code == 2
    assert "gave str, wanted a DepthMap" in err


BAD = [
    (["simulate", "korner", "--out", "x.h5"], "unknown scene 'korner'"),
    (["simulate", "wall:colour=3", "--out", "x.h5"], "has no parameter 'colour'"),
    (["simulate", "wall:range=2,tilt", "--out", "x.h5"], "wanted key=value"),
    (["simulate", "wall", "--sensor", "nikon", "--out", "x.h5"], "unknown sensor 'nikon'"),
    (["simulate", "wall", "--sensor", "deeptof:freqs=20", "--out", "x.h5"], "give Hz, not MHz"),
    (["simulate", "wall", "--sensor", "deeptof:width=0", "--out", "x.h5"], "width and height"),
    (["simulate", "wall", "--out", "no/such/folder/x.h5"], "choose a writable folder"),
    (["simulate", "wall", "--engine", "magic", "--out", "x.h5"], "unknown name 'magic'"),
    (["correct", "missing.h5", "--out", "x.npz"], "missing.h5"),
    (["correct", "CAPTURE", "--method", "nope", "--out", "x.npz"], "unknown name 'nope'"),
    (["correct", "CAPTURE", "--method", "crt:foo=1", "--out", "x.npz"], "has no parameter 'foo'"),
    (["correct", "CAPTURE", "--method", "a.b:c", "--out", "x.npz"], "cannot load method 'a.b:c'"),
    (["correct", "CAPTURE", "--out", "x.xyz"], "x.xyz"),
    (["correct", "CAPTURE"], "Missing option '--out'"),
    (["bench", "nosuite", "--out", "b"], "no suite 'nosuite'; built in:"),
    (["bench", "score", "."], "start with: toftools bench run"),
    (["bench", "report", "."], "run: toftools bench score"),
    (["convert", "missing.bin", "--out", "x.h5"], "missing.bin"),
    (["inspect", "missing.bin"], "missing.bin"),
    (["cloud", "missing.npz", "--out", "x.ply"], "missing.npz"),
]


TO = ["--out", "x.h5"]
TYPED = [
    (["simulate", "wall:range=abc"], "got range='abc', wanted a number such as 2"),
    (["simulate", "wall:range=nan"], "got range=nan, wanted a number"),
    (["simulate", "wall:range=1e400"], "got range=inf, wanted a number"),
    (["simulate", "wall:range=1+2"], "wanted a number"),
    (["simulate", "wall:ambient_e=x"], "got ambient_e='x', wanted a number"),
    (["simulate", "wall:ambient_e=-1"], "must be non-negative"),
    (["simulate", "room.xml"], "got nothing there at room.xml, wanted a scene file"),
    (["simulate", "scenes/room"], "got the file 'scenes/room', whose kind is not known"),
    (["simulate", "wall:kind"], "wanted key=value"),
    (["simulate", "wall:range=2,range=3"], "got range twice"),
    (["simulate", "corner:angle=x"], "got angle='x', wanted a number such as 90"),
    (["simulate", "cavity:radius=true"], "got radius=True, wanted a number"),
    (["simulate", "wall", "--sensor", "deeptof:contrast=abc"], "got contrast='abc', wanted"),
    (["simulate", "wall", "--sensor", "deeptof:contrast=true"], "got contrast=True, wanted"),
    (["simulate", "wall", "--sensor", "deeptof:signal_e=inf"], "got signal_e=inf, wanted"),
    (["simulate", "wall", "--sensor", "deeptof:width=1.5"], "wanted a whole number such as 256"),
    (["simulate", "wall", "--sensor", "deeptof:hfov_deg=wide"], "got hfov_deg='wide', wanted"),
    (["simulate", "wall", "--sensor", "deeptof:freqs=fast"], "wanted numbers joined by +"),
    (["simulate", "wall", "--sensor", "deeptof:freqs=20e6+x"], "wanted numbers joined by +"),
    (["simulate", "wall", "--sensor", "deeptof:steps=0+x+2"], "wanted numbers joined by +"),
    (["simulate", "wall", "--sensor", "deeptof:steps=true"], "wanted numbers joined by +"),
    (["simulate", "wall", "--sensor", "deeptof:waveform=3"], "got waveform=3, wanted a word"),
    (["simulate", "wall", "--sensor", "deeptof:width"], "wanted key=value"),
    (["correct", "CAPTURE", "--method", "crt:max_range_m=abc"], "wanted a number such as 0"),
    (["correct", "CAPTURE", "--method", "crt:max_range_m=nan"], "got max_range_m=nan, wanted"),
    (["correct", "CAPTURE", "--method", "crt:kind"], "wanted key=value"),
    (["correct", "CAPTURE", "--method", "kde:window_px=abc"], "wanted a whole number"),
    (["correct", "CAPTURE", "--method", "kde:hypotheses=2.5"], "wanted a whole number"),
    (["correct", "CAPTURE", "--method", "sra:grid_m=abc"], "got grid_m='abc', wanted a number"),
    (["correct", "CAPTURE", "--method", "single:freq_index=a"], "wanted a whole number such as 0"),
    (["correct", "CAPTURE", "--method", "single:freq_index=0.5"], "wanted a whole number"),
    (["correct", "CAPTURE", "--method", "math:pi"], "wanted a function"),
]
BAD += [([*args, *TO], message) for args, message in TYPED]


@pytest.mark.parametrize(("args", "message"), BAD, ids=[" ".join(args) for args, _ in BAD])
def test_bad_input_is_one_sentence_exit_code_two_and_no_file(
    capsys, monkeypatch, tmp_path, capture_file, args, message
):
    monkeypatch.chdir(tmp_path)
    args = [str(capture_file) if a == "CAPTURE" else a for a in args]
    code, out, err = call(capsys, *args)
    assert code == 2
    assert message in err
    assert "Traceback" not in err
    assert out == ""
    assert len([line for line in err.splitlines() if "rror" in line]) == 1
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


MINE = """
import numpy as np
from toftools.types import DepthMap

def make(sensor, *, range_m=1.5):
    def run(phasors):
        return DepthMap(np.full(phasors.values.shape[1:], range_m))
    return run

def text(sensor):
    return lambda phasors: "no depth"

NUMBER = 3
"""


def console(folder, *args):
    """The installed command, whose sys.path holds neither the current folder nor PYTHONPATH."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-P", "-c", "from toftools.cli import main; main()", *map(str, args)],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_a_method_in_the_current_folder_is_found_by_the_installed_command(capture_file, tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "h5py.py").write_text("raise RuntimeError('this is not the library')")
    done = console(tmp_path, "correct", capture_file, "--method", "mine:make:range_m=2.5", "--out",
                   "a.npz", "--json")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["median_range_m"] == 2.5
    (tmp_path / "h5py.py").unlink()
    suite = f"methods = ['mine:make']\ncaptures = ['{capture_file}']\n"
    (tmp_path / "suite.toml").write_text(suite)
    done = console(tmp_path, "bench", "run", "suite.toml", "--out", "b", "--threads", "1")
    assert done.returncode == 0, done.stderr


def test_the_wide_lens_is_known_in_every_pixel():
    """Distortion that folds back would leave pixels without a ray; angles as solved by hand."""
    directions = rays(sensor("adtf3175").camera)
    assert np.isfinite(directions).all()
    y, x = 258, 511  # x / z of the last column by bisection of x D(x^2) = (511 - cx) / fx
    low, high, goal = 0.0, 5.0, (511 - 259.898773) / 252.511383
    for _ in range(60):
        r = (low + high) / 2
        bent = r * (1 + 0.23696414 * r**2 - 0.01807739 * r**4 + 0.00173649 * r**6)
        bent /= 1 + 0.5738449 * r**2 - 0.00448902 * r**4 + 0.00164395 * r**6
        low, high = (r, high) if bent < goal else (low, r)
    # The row lies 0.48 px off the axis, which turns the ray by less than 1e-3.
    assert directions[y, x, 0] / directions[y, x, 2] == pytest.approx(low, rel=1e-3)
    assert np.degrees(np.arccos(directions[y, 0] @ directions[y, x])) == pytest.approx(119.8, abs=1)


def test_whole_floats_and_endless_wells_are_fine(capsys, capture_file, tmp_path):
    out = tmp_path / "a.npz"
    method = "single:freq_index=1.0"
    assert call(capsys, "correct", capture_file, "--method", method, "--out", out)[0] == 0
    text = "deeptof:width=8.0,height=8,full_well_e=inf,steps=0+2.1+4.2"
    out = tmp_path / "c.h5"
    assert call(capsys, "simulate", "wall", "--sensor", text, "--out", out)[0] == 0


def test_full_disk_leaves_nothing_behind(capture_file, tmp_path):
    # A file size limit makes every write past 4 kB fail, as a full disk does.
    code = (
        "import resource, signal, sys\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "from toftools.cli import main\n"
        f"main(['simulate', 'wall', '--sensor', 'deeptof', '--out', r'{tmp_path / 'big.h5'}'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode in (1, 2), done.stderr
    assert "Traceback" not in done.stderr
    assert "big.h5" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_output_never_replaces_a_device_or_the_input_and_follows_links(
    capsys, capture_file, tmp_path
):
    import os

    fifo = tmp_path / "pipe.npz"
    os.mkfifo(fifo)
    code, _, err = call(capsys, "correct", capture_file, "--out", fifo)
    assert code == 2
    assert "not a plain file" in err
    assert fifo.is_fifo()
    mine = tmp_path / "mine.h5"
    mine.write_bytes(capture_file.read_bytes())
    code, _, err = call(capsys, "correct", mine, "--out", mine)
    assert code == 2
    assert "which is the input" in err
    assert mine.read_bytes() == capture_file.read_bytes()
    (tmp_path / "link.npz").symlink_to(tmp_path / "target.npz")
    code, _, _ = call(capsys, "correct", capture_file, "--out", tmp_path / "link.npz")
    assert code == 0
    assert (tmp_path / "link.npz").is_symlink()
    assert (tmp_path / "target.npz").is_file()


@pytest.mark.parametrize(
    ("body", "code", "message"),
    [
        ("def make(:", 2, "cannot load method 'planted_user:make': SyntaxError"),
        ("raise KeyError('x')", 2, "cannot load method 'planted_user:make': KeyError"),
        ("def make(s):\n    return lambda z: 1 / 0", 1, "failed: ZeroDivisionError"),
        ("def make(s):\n    return 5", 1, "failed: TypeError"),
    ],
)
def test_a_users_method_that_fails_is_one_line(tmp_path, capture_file, body, code, message):
    (tmp_path / "planted_user.py").write_text(body)
    command = [sys.executable, "-m", "toftools", "correct", str(capture_file), "--method",
               "planted_user:make", "--out", "x.npz"]  # fmt: skip
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == code
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "x.npz").exists()
