"""Fixed pattern: planted maps come back with honest sigma; what walls cannot tell is said."""

from dataclasses import replace

import numpy as np
import pytest
from phase_rig import NOMINAL, pattern, wall

from toftools.calib.fixed_pattern import FixedPattern, fixed_pattern
from toftools.calib.residuals import phase_error_rad
from toftools.camera import rays
from toftools.conditions import conditions_of, expected_range_m
from toftools.registry import CALIBRATIONS
from toftools.types import Phasors
from toftools.units import range_to_phase

PIXELS = pattern(1, 0.05)
DISTANCES = (1.0, 1.7, 2.6)
FREQS = NOMINAL.modulation.freqs_hz


def walls(seed=0, distances=DISTANCES, phase_rad=PIXELS, **given):
    return [
        wall(z, phase_rad=phase_rad, seed=100 * seed + i, file=f"wall_{i}.h5", **given)
        for i, z in enumerate(distances)
    ]


@pytest.mark.parametrize("distances", [DISTANCES, (1.5,)])
def test_planted_map_lies_in_its_intervals(distances):
    inside = []
    for seed in range(40):
        stage = fixed_pattern(walls(seed, distances))
        inside.append(np.abs(stage.map_rad - PIXELS) < 1.96 * stage.sigma_rad)
    assert 0.94 <= np.mean(inside) <= 0.965
    assert np.mean(inside, axis=0).min() > 0.7, "no pixel is wrong by itself"
    assert stage.sigma_rad.mean() < 0.02


def slow_pattern(captures):
    """Pixel by pixel in plain loops: weighted means over captures, each less its mean over pixels.

    The weights are those of the noise, the means are iterated as each needs the other.
    """
    errors = [phase_error_rad(c) for c in captures]
    sigmas = [c.phasors.sigma / np.abs(c.phasors.values) for c in captures]
    count, height, width = errors[0].shape
    out = np.zeros((count, height, width))
    for f in range(count):
        means = [float(e[f].mean()) for e in errors]
        for _ in range(20):
            for v in range(height):
                for u in range(width):
                    top = bottom = 0.0
                    for e, s, mean in zip(errors, sigmas, means, strict=True):
                        top += (e[f, v, u] - mean) / float(s[f, v, u]) ** 2
                        bottom += 1 / float(s[f, v, u]) ** 2
                    out[f, v, u] = top / bottom
            out[f] -= out[f].mean()
            means = [float((e[f] - out[f]).mean()) for e in errors]
    return out


def test_two_walls_agree_with_the_slow_twin():
    captures = walls(3, (1.0, 2.0))
    assert fixed_pattern(captures).map_rad == pytest.approx(slow_pattern(captures), abs=1e-6)


def test_cosine_belongs_to_the_true_distance():
    # A planted constant must not turn into a bowl, as it would if the phase were divided.
    bowl = fixed_pattern(walls(1, (0.8, 0.8, 0.8, 0.8), phase_rad=np.full((2, 1, 1), 1.0)))
    corner, middle = bowl.map_rad[:, :3, :3].mean(), bowl.map_rad[:, 8:10, 11:13].mean()
    assert abs(corner - middle) < 5e-3, "dividing by the cosine would make this 0.3 rad"


def test_map_has_zero_mean_and_wall_offsets_stay_out():
    stage = fixed_pattern(walls(2, off_m=0.0, phase_rad=PIXELS + 0.4))
    assert stage.map_rad.mean(axis=(1, 2)) == pytest.approx([0, 0], abs=1e-9)
    assert np.sqrt(np.mean((stage.map_rad - PIXELS) ** 2)) < 1.2 * stage.sigma_rad.mean()


def test_several_walls_average_noise_and_predict_the_next():
    left = fixed_pattern(walls(4, (1.2,) * 8)).residual
    assert left.before > 2 * left.after
    assert left.after < left.noise, "eight walls leave sqrt(7/8) of the noise"
    assert left.held_out == pytest.approx(left.noise * np.sqrt(1 + 1 / 7), rel=0.05)
    one = fixed_pattern(walls(4, (1.2,))).residual
    assert np.isnan(one.held_out)
    assert "one wall only" in one.notes[0]


def test_one_bad_frame_of_many_does_no_harm():
    captures = walls(5, (1.2,) * 6)
    values = np.array(captures[2].phasors.values)
    values[:, 4:9, 4:12] *= np.exp(0.8j)  # somebody's hand
    captures[2] = replace(captures[2], phasors=Phasors(values, captures[2].phasors.sigma))
    stage = fixed_pattern(captures)
    assert np.abs(stage.map_rad - PIXELS)[:, 4:9, 4:12].mean() < 1.5 * stage.sigma_rad.mean()


def test_misplaced_walls_are_told_in_millimetres():
    captures = walls(6, (1.0, 1.5, 2.0, 2.5))
    captures[2] = wall(2.0, phase_rad=PIXELS, seed=602, off_m=5e-3, file="moved.h5")
    (note,) = fixed_pattern(captures).residual.notes
    assert note.startswith("moved.h5 reads +5.")
    assert "its distance of 2 m is wrong" in note
    two = [captures[0], captures[2]]
    assert "wall_0.h5 and moved.h5 differ by 5." in fixed_pattern(two).residual.notes[0]
    many = [wall(z, off_m=2e-3 * (-1) ** i, seed=i) for i, z in enumerate((1, 1.5, 2, 2.5))]
    assert "walls disagree by up to" in fixed_pattern(many).residual.notes[0]
    assert not fixed_pattern(walls(6)).residual.notes


def test_known_normal_is_used():
    captures = [wall(z, phase_rad=PIXELS, tilt=12.0, seed=i) for i, z in enumerate(DISTANCES)]
    normal = (-float(np.sin(np.radians(12))), 0.0, -float(np.cos(np.radians(12))))
    told = [
        wall(z, phase_rad=PIXELS, tilt=12.0, seed=i, normal=normal) for i, z in enumerate(DISTANCES)
    ]
    blind, right = fixed_pattern(captures), fixed_pattern(told)
    assert np.std(right.map_rad - PIXELS) < 1.2 * right.sigma_rad.mean()
    assert np.std(blind.map_rad - PIXELS) > 5 * right.sigma_rad.mean()
    assert blind.sigma_rad.mean() > 3 * right.sigma_rad.mean(), "walls contradict each other"
    assert any("(try tilt=true)" in note for note in blind.residual.notes)


def test_common_tilt_is_found_from_several_distances():
    inside, angles = [], []
    for seed in range(12):
        stage = fixed_pattern(walls(seed, tilt=3.0), tilt=True)
        inside.append(np.abs(stage.map_rad - PIXELS) < 1.96 * stage.sigma_rad)
        angles.append(float(stage.residual.notes[0].split(" by ")[1].split(" and ")[0]))
    assert np.mean(inside) > 0.9
    assert np.mean(angles) == pytest.approx(-3.0, abs=0.05)
    assert np.std(angles) < 0.15
    assert "by noise" in stage.residual.notes[0]


def test_clock_tree_stays_a_pattern_where_distances_tell_it_from_a_tilt():
    slope = np.linspace(-1, 1, NOMINAL.camera.width)
    skew_m = 0.02 * slope  # a delay that grows across the sensor: the same metres at all freqs
    phase = range_to_phase(skew_m, FREQS[:, None, None]) * np.ones((2, 18, 1))
    apart = fixed_pattern(walls(1, phase_rad=phase), tilt=True)
    assert np.abs(apart.map_rad - phase).mean() < 0.01
    same = fixed_pattern(walls(1, (1.5, 1.5), phase_rad=phase), tilt=True)
    assert np.abs(same.map_rad - phase).mean() > 0.02, "taken for a tilt, as the docstring says"
    assert "walls at one distance cannot tell these apart" in same.residual.notes[0]


def test_tilt_wants_walls_of_one_normal():
    turned = wall(1.5, normal=(0.1, 0.0, -1.0), file="turned.h5")
    with pytest.raises(ValueError, match=r"turned\.h5 has another normal than wall_0\.h5"):
        fixed_pattern([*walls(0), turned], tilt=True)


def test_pixels_without_a_measurement_become_invalid():
    captures = []
    for capture in walls(7):
        valid = np.ones(NOMINAL.camera.shape, bool)
        valid[3, 5] = False
        seen = capture.phasors
        captures.append(replace(capture, phasors=Phasors(seen.values, seen.sigma, valid)))
    stage = fixed_pattern(captures)
    assert np.isnan(stage.map_rad[:, 3, 5]).all()
    assert "1 pixels were never usable" in stage.residual.notes[0]
    out = stage(walls(8)[0].phasors)
    assert not out.valid[3, 5]
    assert out.valid.sum() == out.valid.size - 1


def test_pixels_missing_from_some_walls_are_still_right():
    captures = walls(9)
    valid = np.ones(NOMINAL.camera.shape, bool)
    valid[:, :12] = False
    seen = captures[0].phasors
    captures[0] = replace(captures[0], phasors=Phasors(seen.values, seen.sigma, valid))
    stage = fixed_pattern(captures)
    off = stage.map_rad - PIXELS
    assert abs(off[:, :, :12].mean() - off[:, :, 12:].mean()) < 3e-3
    assert stage.sigma_rad[:, :, :12].mean() > 1.2 * stage.sigma_rad[:, :, 12:].mean()


@pytest.mark.parametrize("count", [1, 4])
def test_without_sigma_the_scatter_gives_it(count):
    captures = walls(10, (1.5,) * count, sigma=False)
    stage = fixed_pattern(captures)
    told = fixed_pattern(walls(10, (1.5,) * count))
    assert stage.map_rad == pytest.approx(told.map_rad, abs=0.02)
    if count > 1:
        assert stage.sigma_rad.mean() == pytest.approx(told.sigma_rad.mean(), rel=0.15)
    assert np.isnan(stage.residual.noise)
    assert any("no sigma" in note for note in stage.residual.notes)


def test_bowl_of_a_misplaced_wall_is_as_the_docstring_says():
    height = 1 / rays(NOMINAL.camera)[..., 2]
    assert np.ptp(height) == pytest.approx(0.33, abs=0.03)
    apart = expected_range_m(wall(1.501)) - expected_range_m(wall(1.5))
    assert np.ptp(1e3 * apart) == pytest.approx(np.ptp(height), rel=1e-3)


def test_applied_it_removes_the_pattern_and_keeps_sigma():
    capture = wall(1.4, phase_rad=PIXELS, seed=77)
    stage = fixed_pattern(walls(11, (1.2,) * 8))
    out = stage(capture.phasors)
    before, after = phase_error_rad(capture), phase_error_rad(replace(capture, phasors=out))
    assert after.std() < 0.4 * before.std()
    assert np.array_equal(out.sigma, capture.phasors.sigma)
    assert np.array_equal(stage.error_rad(before, before), stage.map_rad)
    with pytest.raises(ValueError, match="phasors for this fixed pattern must have shape"):
        stage(Phasors(np.ones((2, 3, 3))))


def test_refusals():
    with pytest.raises(ValueError, match="fixed_pattern needs captures of kind wall; got 1 rail"):
        fixed_pattern([wall(1.0, kind="rail")])
    assert conditions_of(wall(1.0)).kind == "wall"
    dead = wall(1.0, file="dead.h5")
    seen = dead.phasors
    dead = replace(dead, phasors=Phasors(seen.values * 0, seen.sigma))
    with pytest.raises(ValueError, match=r"dead\.h5 has 0 % usable pixels"):
        fixed_pattern([*walls(0), dead])


@pytest.mark.parametrize(
    ("map_rad", "sigma_rad"),
    [
        (np.full((1, 2, 2), np.inf), np.ones((1, 2, 2))),
        (np.full((1, 2, 2), np.nan), np.ones((1, 2, 2))),
        (np.zeros((1, 2, 2)), np.ones((1, 2, 3))),
        (np.zeros((1, 2, 2)), -np.ones((1, 2, 2))),
        (np.zeros((2, 2)), np.ones((2, 2))),
    ],
)
def test_hostile_fields_are_refused(map_rad, sigma_rad):
    with pytest.raises(ValueError, match=r"must|holds no pixel"):
        FixedPattern(map_rad, sigma_rad)


def test_it_is_registered():
    assert CALIBRATIONS["fixed_pattern"].load() is fixed_pattern
