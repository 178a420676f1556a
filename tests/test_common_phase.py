"""Common phase: planted constants come back with honest intervals, whatever the walls do."""

from dataclasses import replace

import numpy as np
import pytest
from phase_rig import NOMINAL, pattern, planted, wall

from toftools.calib.common_phase import CommonPhase, combined, common_phase
from toftools.calib.residuals import phase_error_rad, wrap_half
from toftools.conditions import Conditions, with_conditions
from toftools.registry import CALIBRATIONS
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Phasors, Scene, Shot
from toftools.units import range_to_phase

PLANTED = np.array([0.7, -3.1])  # the second lies so near half a turn that its pixels wrap
OFFSET = PLANTED[:, None, None]


def off(stage):
    return wrap_half(stage.phase_rad - PLANTED)


def test_planted_constants_lie_in_their_intervals():
    pixels = pattern(1, 0.05)
    inside = []
    for seed in range(60):
        walls = [
            wall(z, phase_rad=OFFSET + pixels, seed=10 * seed + i, file=f"wall_{i}.h5")
            for i, z in enumerate((1.0, 1.7, 2.6))
        ]
        stage = common_phase(walls)
        inside.append(np.abs(off(stage)) < 1.96 * stage.sigma_rad)
    assert np.mean(inside) >= 0.9
    assert stage.sigma_rad.max() < 1e-3


def test_intervals_hold_where_walls_are_misplaced():
    rng = np.random.default_rng(0)
    inside = []
    for seed in range(60):
        walls = [
            wall(z, phase_rad=OFFSET, seed=10 * seed + i, off_m=2e-3 * rng.normal())
            for i, z in enumerate(np.linspace(1, 3, 6))
        ]
        stage = common_phase(walls)
        inside.append(np.abs(off(stage)) < 1.96 * stage.sigma_rad)
    assert np.mean(inside) >= 0.9
    assert stage.sigma_rad.min() > 1e-3, "2 mm of wrong distance are 3 to 6 mrad a wall"


@pytest.mark.parametrize(("count", "spread"), [(3, 0.0), (3, 3e-3), (8, 0.0), (8, 3e-3)])
def test_combined_measurements_cover(count, spread):
    rng = np.random.default_rng(count)
    sigma = np.linspace(3e-4, 8e-4, count)
    runs = [combined(rng.normal(0, np.hypot(sigma, spread)), sigma) for _ in range(400)]
    share = np.mean([abs(mean) < 1.96 * sd for mean, sd in runs])
    assert 0.92 <= share <= 0.995


def test_one_wall_says_what_a_millimetre_costs():
    stage = common_phase([wall(1.5, phase_rad=OFFSET, off_m=1e-3)])
    wanted = range_to_phase(1e-3, NOMINAL.modulation.freqs_hz)
    assert off(stage) == pytest.approx(wanted * 1.13, abs=2e-3)  # mean of 1 / cosine is 1.1
    note = stage.residual.notes[0]
    assert f"1 mm of wrong wall distance is {wanted[0]:.4f} and {wanted[1]:.4f} rad" in note
    assert "one capture only" in note
    assert np.isnan(stage.residual.held_out)


def test_outlying_pixels_and_an_outlying_capture_move_nothing():
    pixels = pattern(1, 0.05)
    hit = np.random.default_rng(3).random(pixels.shape[1:]) < 0.04
    walls = [
        wall(z, phase_rad=OFFSET + pixels + np.where(hit, 1.5, 0), seed=i)
        for i, z in enumerate((1.0, 1.5, 2.0, 2.5))
    ]
    clean = [wall(z, phase_rad=OFFSET + pixels, seed=i) for i, z in enumerate((1.0, 1.5, 2.0, 2.5))]
    assert off(common_phase(walls)) == pytest.approx(off(common_phase(clean)), abs=1e-3)
    moved = common_phase([*clean, wall(3.0, phase_rad=OFFSET, off_m=0.1, file="moved.h5")])
    assert off(moved) == pytest.approx(off(common_phase(clean)), abs=1e-3)
    assert "moved.h5 is off the others most, by 1" in moved.residual.notes[0]


def test_walls_are_preferred_to_rails_and_checks_never_used():
    good = wall(1.5, phase_rad=OFFSET)
    bad = [wall(2.0, phase_rad=OFFSET + 1, kind=kind) for kind in ("rail", "check", "gray")]
    assert off(common_phase([*bad, good])) == pytest.approx([0, 0], abs=3e-3)
    rails = [wall(z, phase_rad=OFFSET, kind="rail", seed=i) for i, z in enumerate((1, 2, 3))]
    assert off(common_phase([*rails, bad[1]])) == pytest.approx([0, 0], abs=3e-3)


def test_a_pixel_missing_from_one_wall_does_not_bias_it():
    pixels = np.zeros((2, *NOMINAL.camera.shape))
    pixels[:, :, :12] = 0.2
    pixels -= pixels.mean(axis=(1, 2), keepdims=True)
    walls = [wall(z, phase_rad=OFFSET + pixels, seed=i) for i, z in enumerate((1.0, 1.4))]
    half = np.ones(NOMINAL.camera.shape, bool)
    half[:, :6] = False
    seen = walls[1].phasors
    walls[1] = replace(walls[1], phasors=Phasors(seen.values, seen.sigma, half))
    assert off(common_phase(walls)) == pytest.approx([0, 0], abs=3e-3)


def test_residual_in_millimetres():
    pixels = pattern(2, 0.05)
    walls = [wall(z, phase_rad=OFFSET + pixels, seed=i) for i, z in enumerate((1.0, 1.7))]
    left = common_phase(walls).residual
    assert left.unit == "mm"
    assert left.before > 500
    assert left.noise < left.after < 30, "the pattern of 0.05 rad stays"
    assert left.held_out == pytest.approx(left.after, rel=0.01)
    assert left.n == 2 * 2 * NOMINAL.camera.width * NOMINAL.camera.height


def test_without_sigma_the_answer_stays_and_the_noise_is_unknown():
    walls = [wall(z, phase_rad=OFFSET, seed=i, sigma=False) for i, z in enumerate((1.0, 1.7, 2.4))]
    stage = common_phase(walls)
    assert np.abs(off(stage)).max() < 3e-3
    assert np.abs(off(stage)).max() < 4 * stage.sigma_rad.max()
    assert np.isnan(stage.residual.noise)
    assert "no sigma" in " ".join(stage.residual.notes)


def test_reference_temperature_is_that_of_its_captures():
    told = [wall(1.5, seed=i, sensor_c=40.0 + i, light_c=45.0) for i in range(3)]
    stage = common_phase([*told, wall(1.2)])
    assert stage.reference_c == pytest.approx([41.0, 45.0])
    assert np.isnan(common_phase([wall(1.5)]).reference_c).all()
    warm = common_phase([wall(1.5, sensor_c=30.0), wall(1.5, sensor_c=45.0)])
    assert any("span 15.0 K of sensor_c" in note for note in warm.residual.notes)


def test_applied_it_takes_the_constant_off_and_keeps_sigma():
    capture = wall(1.5, phase_rad=OFFSET)
    stage = common_phase([capture])
    out = stage(capture.phasors)
    assert np.array_equal(out.sigma, capture.phasors.sigma)
    left = phase_error_rad(replace(capture, phasors=out))
    assert left.mean(axis=(1, 2)) == pytest.approx([0, 0], abs=1e-5)
    phase = np.zeros((2, 3, 4))
    assert stage.error_rad(phase, phase).shape == (2, 1, 1)
    with pytest.raises(ValueError, match="2 frequencies, got phasors of 1"):
        stage(Phasors(np.ones((1, 2, 2))))


def test_refusals_name_the_file():
    with pytest.raises(ValueError, match="common_phase needs captures of kind wall, or else rail"):
        common_phase([wall(1.0, kind="check")])
    with pytest.raises(ValueError, match="got none"):
        common_phase([])
    blind = with_conditions(wall(1.0), Conditions("wall"), file="blind.h5")
    with pytest.raises(ValueError, match=r"blind\.h5 does not say how far"):
        common_phase([blind])
    other = wall(1.0, nominal=sensor("opt8241:width=20,height=18"), file="small.h5")
    with pytest.raises(ValueError, match=r"small\.h5 has 20 x 18 px"):
        common_phase([wall(1.0), other])
    mixed = wall(1.0, nominal=sensor("opt8241:width=24,height=18,freqs=40e6+60e6"), file="f.h5")
    with pytest.raises(ValueError, match=r"f\.h5 was taken at 40 \+ 60 MHz"):
        common_phase([wall(1.0), mixed])


def unusable(values=None, valid=None, file="bad.h5"):
    capture = wall(1.0, file=file)
    old = capture.phasors
    values = old.values if values is None else values
    return replace(
        capture, phasors=Phasors(values, old.sigma, old.valid if valid is None else valid)
    )


def test_saturated_black_and_noisy_frames_are_named():
    shape = (2, *NOMINAL.camera.shape)
    with pytest.raises(ValueError, match=r"sat\.h5 has 0 % usable pixels"):
        common_phase([wall(1.0), unusable(valid=np.zeros(shape[1:], bool), file="sat.h5")])
    with pytest.raises(ValueError, match=r"black\.h5 has 0 % usable pixels"):
        common_phase([unusable(np.zeros(shape, np.complex64), file="black.h5")])
    with pytest.raises(ValueError, match=r"nan\.h5 has 0 % usable pixels"):
        common_phase([unusable(np.full(shape, np.nan, np.complex64), file="nan.h5")])
    dark = analytic(Scene("wall", {"range": 60.0, "albedo": 0.01}))(Shot(planted(NOMINAL, 0.0)))
    dark = with_conditions(replace(dark, sensor=NOMINAL), Conditions("wall", 60.0), file="dim.h5")
    with pytest.raises(ValueError, match=r"dim\.h5 holds noise instead of a phase at 40 MHz"):
        common_phase([wall(1.0), dark])


@pytest.mark.parametrize(
    "fields",
    [
        ([np.nan], [0.1], [np.nan] * 2),
        ([1.0], [0.1, 0.1], [np.nan] * 2),
        ([1.0], [-0.1], [np.nan] * 2),
        ([1.0], [np.nan], [np.nan] * 2),
        ([1.0], [0.1], [np.inf, 1]),
        ([1.0], [0.1], [1.0]),
        ("no", [0.1], [1.0, 1.0]),
    ],
)
def test_hostile_fields_are_refused(fields):
    with pytest.raises(ValueError, match="must"):
        CommonPhase(*fields)


def test_it_is_registered():
    assert CALIBRATIONS["common_phase"].load() is common_phase
