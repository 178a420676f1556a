"""The convention is found where the scene can tell it, and not claimed where it cannot."""

import json
import os
from itertools import permutations
from pathlib import Path

import foreign_files as foreign
import numpy as np
import pytest
from click.testing import CliRunner

from toftools.camera import pinhole
from toftools.cli.inspect import command
from toftools.io.convention import _jackknife, propose, steps_text
from toftools.io.export import write_answer
from toftools.io.inspect import neighbour_noise, reference_range, summary
from toftools.io.native import write_capture
from toftools.phasor import modulate
from toftools.types import Capture, DepthMap, Modulation, Phasors, Sensor, Taps, Truth
from toftools.units import ambiguity_m, range_to_phase

SHAPE = (48, 64)
FREQS = np.array([60e6, 40e6])
FOUR = np.radians([0, 90, 180, 270])


def slope(low_m=0.5, high_m=3.0):
    return np.linspace(low_m, high_m, SHAPE[0] * SHAPE[1]).reshape(SHAPE)


def wrong_capture(range_m, *, sign=1, order=(0, 1, 2, 3), offset_m=0.0, steps=FOUR, noise=0.0):
    """Taps whose file order, sign and offset differ from what the sensor claims."""
    rng = np.random.default_rng(11)
    z = 100 * np.exp(1j * sign * range_to_phase(range_m + offset_m, FREQS[:, None, None]))
    taps = modulate(z, 200.0, np.broadcast_to(steps, (2, len(steps))))[:, list(order)]
    taps = taps + noise * rng.normal(size=taps.shape)
    sensor = Sensor(pinhole(SHAPE[1], SHAPE[0], hfov_deg=60), Modulation(FREQS, steps))
    return Capture(sensor, taps=Taps(taps, "DN"))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_every_order_and_sign_is_found(order, sign):
    """Whatever was done to the taps, the proposal undoes it up to a common rotation."""
    best = propose(wrong_capture(slope(), sign=sign, order=order), slope())
    assert best.decided
    np.testing.assert_allclose(best.coherence, 1, atol=1e-6)
    proposed = best.steps_rad[0] * best.sign
    true = sign * FOUR[list(order)]
    rotation = np.exp(1j * (proposed - true))
    # The rotation is the offset: a quarter turn of tap order is a quarter ambiguity range.
    np.testing.assert_allclose(rotation, rotation[0], atol=1e-9)
    turns = best.sign * np.angle(rotation[0]) / (2 * np.pi)
    error = best.offset_m / ambiguity_m(FREQS) - best.sign * turns
    np.testing.assert_allclose(error - np.round(error), 0, atol=1e-6)


def test_planted_offset_comes_back():
    best = propose(wrong_capture(slope(), offset_m=0.3), slope())
    assert best.sign == 1
    assert steps_text(best.steps_rad[0]) == "0/90/180/270"
    np.testing.assert_allclose(best.offset_m, 0.3, atol=1e-6)


def test_three_taps_know_only_the_sign():
    steps = np.radians([0, 120, 240])
    best = propose(wrong_capture(slope(), sign=-1, order=(0, 1, 2), steps=steps), slope())
    assert best.sign == -1
    assert best.decided


def test_many_taps_are_taken_in_the_order_given():
    steps = np.radians(np.arange(8) * 45)
    best = propose(wrong_capture(slope(), order=range(8), steps=steps), slope())
    assert (best.sign, best.decided) == (1, True)
    np.testing.assert_allclose(best.coherence, 1, atol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_phasors_without_taps(sign):
    z = np.exp(1j * sign * range_to_phase(slope(), FREQS[:, None, None]))
    sensor = Sensor(pinhole(SHAPE[1], SHAPE[0], hfov_deg=60), Modulation(FREQS))
    best = propose(Capture(sensor, phasors=Phasors(z)), slope())
    assert (best.sign, best.decided, best.steps_rad) == (sign, True, None)


def test_a_flat_reference_cannot_decide_the_sign_and_says_so():
    flat = np.full(SHAPE, 1.3)
    best = propose(wrong_capture(flat, noise=5.0), flat)
    assert not best.decided
    assert "spreads by only 0.00 rad" in best.reason


def test_noise_alone_decides_nothing():
    rng = np.random.default_rng(5)
    z = rng.normal(size=(2, *SHAPE)) + 1j * rng.normal(size=(2, *SHAPE))
    sensor = Sensor(pinhole(SHAPE[1], SHAPE[0], hfov_deg=60), Modulation(FREQS))
    best = propose(Capture(sensor, phasors=Phasors(z)), slope())
    assert not best.decided
    assert "no hypothesis fits" in best.reason


def test_standard_error_of_the_offset_is_the_spread_of_the_offset():
    """Over 60 noisy captures: (estimate - truth) / error has variance 1 (chi-squared z-test)."""
    rng = np.random.default_rng(2)
    sensor = Sensor(pinhole(SHAPE[1], SHAPE[0], hfov_deg=60), Modulation(FREQS[:1]))
    clean = np.exp(1j * range_to_phase(slope() + 0.2, 60e6))[None]
    scores = []
    for _ in range(60):
        noise = 0.2 * (rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape))
        best = propose(Capture(sensor, phasors=Phasors(clean + noise)), slope())
        scores.append((best.offset_m[0] - 0.2) / best.offset_se_m[0])
    # Sum of 60 squares of t variables with 63 degrees: mean 60 * 63/61, variance about 2 * 60.
    score = (np.sum(np.square(scores)) - 62) / np.sqrt(2 * 60 * 1.1)
    assert abs(score) < 3.3


def test_jackknife_of_a_mean_is_its_standard_error():
    values = np.random.default_rng(8).normal(size=20)
    without = (values.sum() - values) / 19
    assert _jackknife(without) == pytest.approx(values.std(ddof=1) / np.sqrt(20), rel=1e-12)


def test_standard_error_grows_with_the_correlation_of_residuals():
    """A wiggle over the image is no independent error per pixel: the block error sees it."""
    sensor = Sensor(pinhole(SHAPE[1], SHAPE[0], hfov_deg=60), Modulation(FREQS[:1]))
    wiggle = 0.02 * np.sin(np.linspace(0, 4 * np.pi, SHAPE[1]))[None, :]
    z = np.exp(1j * range_to_phase(slope() + wiggle, 60e6))[None]
    best = propose(Capture(sensor, phasors=Phasors(z)), slope())
    per_pixel = wiggle.std() / np.sqrt(SHAPE[0] * SHAPE[1])
    assert best.offset_se_m[0] > 4 * per_pixel


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c, r: (Capture(c.sensor, depth=DepthMap(r[:, :])), r), "distances only"),
        (lambda c, r: (c, r[:-1]), "the reference is"),
        (lambda c, r: (c, np.full(SHAPE, np.nan)), "only 0 pixels"),
    ],
)
def test_what_cannot_be_compared_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        propose(*change(wrong_capture(slope()), slope()))


# noise and wraps


def test_neighbour_noise_on_a_curved_scene():
    rng = np.random.default_rng(4)
    v, u = np.mgrid[0:240, 0:320]
    surface = 2 + 0.3 * np.sin(u / 60) + v / 200.0
    surface[100:, 150:] += 0.5  # an edge
    got = neighbour_noise(surface + 0.004 * rng.normal(size=surface.shape))
    # The median of N correlated differences is good to about 1.6 / sqrt(N / 3): 1 %.
    assert got == pytest.approx(0.004, rel=0.03)


def test_phase_noise_of_each_frequency_and_its_report():
    rng = np.random.default_rng(6)
    z = 50 * np.exp(1j * range_to_phase(slope(0.5, 9.0), FREQS[:, None, None]))
    z = z + rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape)
    sensor = Sensor(pinhole(SHAPE[1], SHAPE[0], hfov_deg=60), Modulation(FREQS))
    capture = Capture(sensor, phasors=Phasors(z, sigma=np.ones(z.shape)))
    noise = summary(capture)["noise"]
    expected = ambiguity_m(FREQS) / (2 * np.pi) / 50
    np.testing.assert_allclose(noise["reported_m"], expected, rtol=0.01)
    # 64 columns x 48 rows: the median is good to 1.6 / sqrt(3000 / 3), 5 %.
    np.testing.assert_allclose(noise["estimated_m"], expected, rtol=0.15)


def test_wraps_are_counted_against_the_truth():
    sensor = Sensor(pinhole(SHAPE[1], SHAPE[0], hfov_deg=60), Modulation(FREQS))
    range_m = slope(0.0, 10.0)
    z = np.exp(1j * range_to_phase(range_m, FREQS[:, None, None]))
    found = summary(Capture(sensor, phasors=Phasors(z), truth=Truth(range_m)))
    turns = ambiguity_m(FREQS) / 10
    np.testing.assert_allclose(found["wraps"]["share"], 1 - turns, atol=1e-3)
    assert found["wraps"]["most"] == np.floor(1 / turns).astype(int).tolist()


# the command


def run(*arguments):
    result = CliRunner().invoke(command, [str(argument) for argument in arguments])
    if result.exception:
        raise result.exception
    return result.output


@pytest.mark.parametrize("name", foreign.MAKERS)
def test_every_format_can_be_inspected(name, tmp_path):
    path = foreign.MAKERS[name](tmp_path)
    text = foreign.FORCED.get(name, name)
    lines = run(path, "--format", text)
    assert f"{foreign.WIDTH} x {foreign.HEIGHT} px" in lines
    found = json.loads(run(path, "--format", text, "--json"))
    assert found["provenance"]["format"] == name
    assert "NaN" not in json.dumps(found)


def test_wrong_convention_is_proposed_and_can_be_applied(tmp_path):
    """The text after "to apply" is a --format that makes the phase agree."""
    path = foreign.melexis_npy(tmp_path, sign=-1, offset_m=0.4)
    found = json.loads(run(path, "--json"))["proposal"]
    assert found["sign"] == -1
    assert found["reference"] == "the distance in the file"
    again = json.loads(run(path, "--json", "--format", found["apply"]))["proposal"]
    assert again["sign"] == 1
    # The proposal is printed with 0.1 mm.
    assert abs(again["offset_m"][0]) < 1e-4


def test_another_file_serves_as_reference(tmp_path):
    capture = wrong_capture(slope(), sign=-1)
    write_capture(tmp_path / "c.h5", capture)
    write_answer(tmp_path / "d.npz", DepthMap(slope()), capture)
    assert "proposal" not in run(tmp_path / "c.h5")
    lines = run(tmp_path / "c.h5", "--reference", tmp_path / "d.npz")
    assert "against the reference file: phase falls with range" in lines
    assert "certainty   decided" in lines
    write_answer(tmp_path / "e.npz", DepthMap(slope()[:5, :5]),
                 Capture(Sensor(pinhole(5, 5, hfov_deg=60), Modulation(FREQS)),
                         depth=DepthMap(slope()[:5, :5])))  # fmt: skip
    with pytest.raises(ValueError, match=r"the reference is \(5, 5\)"):
        run(tmp_path / "c.h5", "--reference", tmp_path / "e.npz")


def test_a_reference_without_distances_is_refused():
    with pytest.raises(ValueError, match="holds no distances"):
        reference_range(wrong_capture(slope()), "c.h5")


def test_a_capture_of_a_few_pixels_is_described_without_a_proposal(tmp_path):
    sensor = Sensor(pinhole(3, 2, hfov_deg=60), Modulation(FREQS))
    z, range_m = np.ones((2, 2, 3), np.complex64), np.full((2, 3), 1.0)
    write_capture(tmp_path / "c.h5", Capture(sensor, phasors=Phasors(z), truth=Truth(range_m)))
    found = json.loads(run(tmp_path / "c.h5", "--json"))
    assert found["proposal"] is None
    assert found["noise"]["estimated_m"] == [None, None]


def test_an_undecided_proposal_is_not_offered_for_use(tmp_path):
    flat = np.full(SHAPE, 1.3)
    capture = wrong_capture(flat)
    write_capture(tmp_path / "c.h5", Capture(capture.sensor, taps=capture.taps, truth=Truth(flat)))
    lines = run(tmp_path / "c.h5")
    assert "NOT decided" in lines
    assert "to apply" not in lines


def test_real_melexis_offset():
    folder = os.environ.get("TOFTOOLS_DATA")
    if not folder or not Path(folder, "snapshot_lidar_mlx75027_60MHz").exists():
        pytest.skip("TOFTOOLS_DATA is not set, or has no Melexis set")
    found = json.loads(run(Path(folder, "snapshot_lidar_mlx75027_60MHz"), "--json"))["proposal"]
    assert found["decided"]
    assert found["sign"] == 1
    assert found["steps_deg"] == ["0/90/180/270"]
    assert found["coherence"][0] == pytest.approx(0.9996, abs=5e-5)
    assert found["offset_m"][0] == pytest.approx(-1.105, abs=5e-4)
