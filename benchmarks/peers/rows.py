"""Tasks of the side-by-side run: each measures ours and a peer by turns and gives rows of a table.

A row says what was done, by whom, with what error and in how many milliseconds; `per` is what the
milliseconds are of.
"""

import importlib.util
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toftools._native import limit_threads
from toftools._transfer import Patches, gather
from toftools.correct.sra import sra
from toftools.correct.sra_lp import sra_lp
from toftools.sensors import sensor as preset
from toftools.types import Phasors
from toftools.units import range_to_phase

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from reference_fuchs import transfer


@dataclass(frozen=True)
class Row:
    """One comparison: errors in the unit that `error` names, times in ms."""

    task: str
    error: str
    per: str
    ours: str
    our_error: float
    our_ms: float
    peer: str
    peer_error: float
    peer_ms: float
    note: str = ""
    equal_error_ms: float | None = None  # what the peer takes until its error is ours, if known


def by_turns(runs, repeats):
    """Least milliseconds of each function, which take turns; the first round warms up."""
    times = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: min(found[1:]) for name, found in times.items()}


def light_between_patches(*, quick):
    """All-pairs transfer of phasors against the same sum in numpy arrays, float64."""
    limit_threads(1)
    side = 300 if quick else 2400
    rng = np.random.default_rng(0)
    normal = rng.standard_normal((3, side))
    some = Patches(
        rng.uniform(0, 2, (3, side)).astype(np.float32),
        (normal / np.linalg.norm(normal, axis=0)).astype(np.float32),
        np.full(side, 1e-3, np.float32),
    )
    light, freqs = np.ones((1, side), np.complex64), np.array([70e6])
    at, facing = (a.astype(float) for a in (some.position, some.normal))
    area = some.area_m2.astype(float)

    def plain():
        return light[0].astype(complex) @ transfer(at, facing, at, facing, area, freqs[0]).T

    ms = by_turns(
        {"ours": lambda: gather(some, some, light, freqs), "numpy": plain}, 2 if quick else 9
    )
    exact = plain()
    error = np.abs(gather(some, some, light, freqs)[0] - exact).max() / np.abs(exact).max()
    task = f"light between {side} x {side} patches, 70 MHz"
    return [Row(task, "millionths of the largest", "call", "_transfer.gather", 1e6 * float(error),
                ms["ours"], "plain numpy, float64", 0.0, ms["numpy"])], []  # fmt: skip


SRA_SENSORS = {
    "40/70 MHz, limit 4 m": ("opt8241", 4.0),
    "80/16/120 MHz": ("kinect2_nominal:width=320,height=240", 0.0),
}

SRA_QUICK = {"40/70 MHz": ("opt8241:width=32,height=24", 0.0)}


def two_returns(camera, seed=0):
    """Two returns per pixel with noise of 1 %, and the range of the first."""
    rng = np.random.default_rng(seed)
    shape = camera.camera.shape
    first, apart, ratio = (rng.uniform(*span, shape) for span in ((0.5, 2), (0.3, 2), (0.05, 0.8)))
    freqs = camera.modulation.freqs_hz[:, None, None]
    z = np.exp(1j * range_to_phase(first, freqs))
    z += ratio * np.exp(1j * range_to_phase(first + apart, freqs))
    z += 0.01 * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    return first, Phasors(z.astype(np.complex64), np.full(z.shape, 0.01, np.float32))


def size(camera):
    height, width = camera.camera.shape
    return f"{width} x {height} pixels"


def sparse_reflections(*, quick):
    """SRA of a frame against one scipy.optimize.linprog per pixel, on the same pixels."""
    limit_threads(1)
    side, cases = (3, SRA_QUICK) if quick else (20, SRA_SENSORS)
    rows = []
    for name, (text, limit) in cases.items():
        camera = preset(text)
        truth, frame = two_returns(camera)
        ours, program = sra(camera, max_range_m=limit), sra_lp(camera, max_range_m=limit)
        some = Phasors(frame.values[:, :side, :side], frame.sigma[:, :side, :side])
        ms = by_turns(
            {"ours": lambda f=frame, r=ours: r(f), "program": lambda f=some, r=program: r(f)},
            1 if quick else 3,
        )
        fast, slow = ours(frame).range_m[:side, :side], program(some).range_m
        same = float((np.abs(fast - slow) < 0.02).mean())
        errors = [1e3 * float(np.nanmedian(np.abs(m - truth[:side, :side]))) for m in (fast, slow)]
        rows.append(
            Row(f"sparse reflections, two returns, {name}", "mm median", size(camera),
                "sra", errors[0], ms["ours"], "scipy linprog per pixel", errors[1],
                ms["program"] * truth.size / side**2,
                f"linprog timed on {side**2} pixels; {100 * same:.1f} % of them agree within 2 cm")
        )  # fmt: skip
    return rows, []


def unwrapping(result):
    """Rows out of what unwrapping_peers.py measured."""
    per = size(preset(result["about"]["sensor"]))
    rows = []
    for scene, found in result["scenes"].items():
        for mine, peer in PAIRS:
            if peer not in found:
                continue
            a, b = found[mine], found[peer]
            wrong = f"wrong wraps {100 * a['wrong']:.2f} %, peer {100 * b['wrong']:.2f} %"
            rows.append(
                Row(f"unwrapping, {scene}", "mm mean", per, mine, 1e3 * a["mae_m"],
                    a["ms"], peer, 1e3 * b["mae_m"], b["ms"], wrong)
            )  # fmt: skip
    return rows, result["about"]["missing"]


PAIRS = (
    ("crt", "crt in plain numpy"),
    ("semi_global", "scikit-image unwrap_phase"),
    ("semi_global", "OpenCV phase_unwrapping"),
)


def light_transport(*, quick, log):
    """A Cornell box with 8 bounces against mitransient: centres of pixels away from edges."""
    if importlib.util.find_spec("mitransient") is None:
        return [], ["mitransient is not installed and is left out"]
    import radiosity

    from . import reach
    from .views import CORNELL, View

    size, samples, steps = ((24, 16), 16, 1) if quick else ((160, 120), 256, 3)
    view = View(CORNELL, "cornell", "hfov_deg=39.3077", size, 8, samples, 4)
    with tempfile.TemporaryDirectory() as folder:
        found = radiosity.run_view(view, Path(folder), 1 if quick else 3, steps, log)
    known = {name: [p for p in points if p.known] for name, points in found["points"].items()}
    theirs, rows, missing = known[radiosity.BEST], [], []
    for name in (radiosity.RADIOSITY, radiosity.PATH):
        ours = known[name]
        if not (ours and theirs):
            missing.append(f"light transport by {name} errs less than its reference and is no row")
            continue
        (our_s, our_m), (their_s, their_m) = finest(ours), finest(theirs)
        told = setting(ours, tolerance=name == radiosity.RADIOSITY)
        until = reach.reach(theirs, our_m)
        note = "a process and all threads each"
        if until is not None:
            note += f"; the peer takes {until.seconds:.3g} s to our error ({until.how})"
        rows.append(
            Row(f"light transport, Cornell box {size[0]} x {size[1]}, 20 MHz", "mm rms", "frame",
                f"{name}, {told}", 1e3 * our_m, 1e3 * our_s,
                f"mitransient, {setting(theirs, tolerance=False)}", 1e3 * their_m, 1e3 * their_s,
                note, None if until is None else 1e3 * until.seconds)
        )  # fmt: skip
    return rows, missing


def finest(points):
    """Seconds and error in m at the finest setting whose error stands above the reference's."""
    return min(points[-1].seconds), float(np.sqrt(np.mean(points[-1].mean_square_m2)))


def setting(points, *, tolerance):
    return f"{points[-1].samples} mm" if tolerance else f"{points[-1].samples} samples"
