"""Temperature: planted slopes come back with honest intervals, and no more of them than needed."""

from dataclasses import replace

import numpy as np
import pytest
from phase_rig import NOMINAL, wall

from toftools.calib.chain import at_conditions
from toftools.calib.residuals import phase_error_rad
from toftools.calib.temperature import Temperature, temperature
from toftools.registry import CALIBRATIONS
from toftools.types import Phasors

SLOPES = np.array([[1.2e-3, -0.5e-3], [2.5e-3, 0.8e-3]])  # rad/K of sensor and light at 40, 70 MHz
REFERENCE = np.array([34.0, 41.0])


def temperatures(count=16, *, together=False):
    time = np.linspace(0, 1, count)
    sensor = 22 + 16 * (1 - np.exp(-3 * time))
    light = 3 + 1.2 * sensor if together else 22 + 22 * (1 - np.exp(-8 * time))
    return np.stack([sensor, light], axis=1)


def warmup(seed=0, *, slopes=SLOPES, celsius=None, hit=(), off_m=2e-3, names=(0, 1), extra=None,
           reference=True, sigma=True):  # fmt: skip
    """Frames of a warm-up of a wall 2 mm off its place, and a wall at the reference."""
    celsius = temperatures() if celsius is None else celsius
    frames = []
    for k, row in enumerate(celsius):
        phase = slopes @ (row - REFERENCE) + (0.3 if k in hit else 0) + (extra(k) if extra else 0)
        told = {("sensor_c", "light_c")[i]: float(row[i]) for i in names}
        frames.append(
            wall(1.2, phase_rad=phase[:, None, None], off_m=off_m, seed=1000 * seed + k,
                 kind="warmup", file=f"warm_{k:02d}.h5", sigma=sigma, **told)
        )  # fmt: skip
    if reference:
        told = dict(zip(("sensor_c", "light_c"), REFERENCE.tolist(), strict=True))
        frames.append(wall(1.5, seed=1000 * seed + 999, **told))
    return frames


def test_planted_slopes_lie_in_their_intervals():
    inside = []
    for seed in range(40):
        stage = temperature(warmup(seed, hit=(5, 11)))
        assert stage.needs == ("sensor_c", "light_c")
        inside.append(np.abs(stage.slope_rad_per_k - SLOPES) < 1.96 * stage.sigma_rad_per_k)
    assert np.mean(inside, axis=0).min() >= 0.9
    assert (stage.sigma_rad_per_k < 2e-4).all()
    assert stage.reference_c == pytest.approx(REFERENCE)
    assert stage.span_c[1] == pytest.approx([22, 44], abs=0.1)
    assert "taken for outliers and left out: warm_05.h5, warm_11.h5" in stage.residual.notes


def test_drift_is_taken_off_at_the_temperatures_of_the_frame():
    stage = temperature(warmup(1))
    celsius = np.array([30.0, 36.0])
    hot = wall(1.2, phase_rad=(SLOPES @ (celsius - REFERENCE))[:, None, None], seed=77,
               kind="check", sensor_c=30.0, light_c=36.0)  # fmt: skip
    out = at_conditions(stage, hot)(hot.phasors)
    left = phase_error_rad(replace(hot, phasors=out)).mean(axis=(1, 2))
    assert np.abs(phase_error_rad(hot).mean(axis=(1, 2))).max() > 0.01
    assert left == pytest.approx([0, 0], abs=2e-3)
    assert np.array_equal(out.sigma, hot.phasors.sigma)


def test_agrees_with_plain_least_squares_on_clean_frames():
    captures = warmup(2)
    frames = captures[:-1]
    mean = np.array([phase_error_rad(c).mean(axis=(1, 2)) for c in frames])
    celsius = temperatures()
    design = np.column_stack([np.ones(len(frames)), celsius - celsius.mean(axis=0)])
    twin = np.linalg.lstsq(design, mean, rcond=None)[0][1:].T
    stage = temperature(captures)
    assert np.abs(stage.slope_rad_per_k - twin).max() < 0.5 * stage.sigma_rad_per_k.min()


def test_no_drift_gives_a_stage_that_does_nothing():
    stage = temperature(warmup(3, slopes=np.zeros((2, 2))))
    assert stage.needs == ()
    assert "held-out parts of the warm-up show no drift" in stage.residual.notes[0]
    z = Phasors(np.ones((2, 2, 2)))
    assert np.array_equal(stage(z).values, z.values)
    assert np.array_equal(stage.at()(z).values, z.values)


def test_one_temperature_is_enough_where_only_one_drifts():
    needs = [temperature(warmup(seed, slopes=SLOPES * [1, 0])).needs for seed in range(4, 8)]
    assert needs.count(("sensor_c",)) >= 3


def test_one_known_temperature_stands_for_both():
    stage = temperature(warmup(4, names=(0,)))
    assert stage.needs == ("sensor_c",)
    assert "only sensor_c is known" in stage.residual.notes[0]
    assert np.isnan(stage.reference_c[1])
    assert stage.at(sensor_c=30.0).sensor_c == 30.0


def test_temperatures_that_rise_together_are_fitted_as_one():
    celsius = temperatures(together=True)
    stage = temperature(warmup(5, celsius=celsius))
    assert len(stage.needs) == 1
    assert "rise together" in stage.residual.notes[0]
    column = ("sensor_c", "light_c").index(stage.needs[0])
    sum_of_both = SLOPES @ ([1, 1.2] if column == 0 else [1 / 1.2, 1])
    error = np.abs(stage.slope_rad_per_k[:, column] - sum_of_both)
    assert (error < 3 * stage.sigma_rad_per_k[:, column]).all()


def test_reference_without_walls_is_where_the_warmup_reads_right():
    captures = warmup(6, off_m=0.0, reference=False)
    stage = temperature(captures)
    assert "no wall says its sensor_c and light_c" in stage.residual.notes[0]
    drift = stage.slope_rad_per_k @ (stage.reference_c - REFERENCE)
    assert np.abs(drift).max() < 5e-3, "against 40 mrad over the warm-up"


def test_two_targets_have_an_offset_each():
    one = warmup(7)
    moved = [
        wall(1.8, phase_rad=(SLOPES @ (row - REFERENCE))[:, None, None], off_m=-0.02, seed=k,
             kind="warmup", sensor_c=float(row[0]), light_c=float(row[1]))
        for k, row in enumerate(temperatures(8))
    ]  # fmt: skip
    stage = temperature([*one, *moved])
    assert stage.residual.n == 2 * (16 + 8), "none is taken for an outlier"
    assert (np.abs(stage.slope_rad_per_k - SLOPES) < 3 * stage.sigma_rad_per_k).all()


def test_hysteresis_is_noted():
    stage = temperature(warmup(8, extra=lambda k: 0.01 * np.sin(k / 3)))
    assert any("follow the order of the frames" in note for note in stage.residual.notes)
    calm = temperature(warmup(8))
    assert not any("follow the order" in note for note in calm.residual.notes)
    assert stage.sigma_rad_per_k.max() > 2 * calm.sigma_rad_per_k.max()


def test_residual_is_that_of_frame_means():
    left = temperature(warmup(9)).residual
    assert left.before > 2
    assert left.after < 1.3 * left.noise
    assert left.after < left.held_out < 3 * left.noise
    assert left.n == 2 * 16
    assert np.isnan(temperature(warmup(9, sigma=False)).residual.noise)


def test_extrapolation_and_missing_temperatures():
    stage = temperature(warmup(10))
    assert not any("extrapolated" in n for n in stage.at(sensor_c=30, light_c=30).residual.notes)
    notes = stage.at(sensor_c=60, light_c=30).residual.notes
    assert any("sensor_c of 60.0 lies outside the 22.0 to 37.2 degrees" in note for note in notes)
    z = Phasors(np.ones((2, 2, 2)))
    with pytest.raises(ValueError, match="needs sensor_c and light_c; set them with at"):
        stage(z)
    with pytest.raises(ValueError, match="needs light_c; set"):
        stage.at(sensor_c=30.0)
    assert stage.at(sensor_c=30, light_c=30).error_rad(np.zeros((2, 3)), np.zeros(2)).shape == (
        2,
        1,
    )
    with pytest.raises(ValueError, match="2 frequencies, got phasors of 1"):
        stage.at(sensor_c=30, light_c=30)(Phasors(np.ones((1, 2, 2))))


def test_refusals_name_the_file():
    frames = warmup(11)
    gap = warmup(11, names=())[3]
    with pytest.raises(ValueError, match=r"warm_03\.h5 does not say sensor_c, which other frames"):
        temperature([*frames[:3], gap, *frames[4:]])
    with pytest.raises(ValueError, match=r"warm_00\.h5 says neither sensor_c nor light_c"):
        temperature(warmup(11, names=()))
    with pytest.raises(ValueError, match="4 frames of kind warmup, got 3"):
        temperature(frames[:3])
    with pytest.raises(ValueError, match="temperature needs captures of kind warmup; got 1 wall"):
        temperature(frames[-1:])
    with pytest.raises(ValueError, match=r"the warm-up spans 0\.0 K, wanted 2 K"):
        temperature(warmup(11, celsius=np.full((6, 2), 30.0)))
    black = replace(frames[4], phasors=Phasors(frames[4].phasors.values * 0))
    with pytest.raises(ValueError, match=r"warm_04\.h5 has 0 % usable pixels"):
        temperature([*frames[:4], black, *frames[5:]])


GOOD = {
    "slope_rad_per_k": [[1e-3, 0.0]],
    "sigma_rad_per_k": [[1e-4, 0.0]],
    "reference_c": [25.0, np.nan],
    "span_c": [[20.0, 40.0], [np.nan, np.nan]],
    "needs": ("sensor_c",),
}


@pytest.mark.parametrize(
    "changed",
    [
        {"slope_rad_per_k": [[np.nan, 0.0]]},
        {"slope_rad_per_k": [[1e-3, 1e-3]]},
        {"slope_rad_per_k": [[1e-3]]},
        {"sigma_rad_per_k": [[-1e-4, 0.0]]},
        {"reference_c": [np.nan, 25.0]},
        {"reference_c": [25.0]},
        {"span_c": [[1.0, 2.0]]},
        {"needs": ("room_c",)},
    ],
)
def test_hostile_fields_are_refused(changed):
    assert Temperature(**GOOD).needs == ("sensor_c",)
    with pytest.raises(ValueError, match="must"):
        Temperature(**{**GOOD, **changed})


def test_it_is_registered():
    assert CALIBRATIONS["temperature"].load() is temperature
    assert NOMINAL.modulation.n_freqs == 2
