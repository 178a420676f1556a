"""fuchs2013: materials found and given, corners with all bounces, noise, where it breaks."""

import numpy as np
import pytest
from reference_jimenez import corner_frame

from toftools.correct._segments import MOST_COST, classes, labelled
from toftools.correct.crt import crt
from toftools.correct.fuchs2010_all_pairs import fuchs2010_all_pairs
from toftools.correct.fuchs2013 import fuchs2013
from toftools.registry import SIMULATORS
from toftools.sensors import sensor
from toftools.types import Phasors, Scene, Shot

TWO, ONE = "opt8241:width=32,height=24", "deeptof:width=32,height=24"
PAIR = (0.3, 0.8)


def frame_of(text, albedos=PAIR):
    """Sensor, true range, true albedo, phasors of a corner with all its bounces."""
    camera = sensor(text)
    range_m, albedo, light = corner_frame(camera, albedos)
    return camera, range_m, albedo, light.astype(np.complex64)


def mae_m(depth, range_m):
    return float(np.abs(depth.range_m - range_m).mean())


# Materials.


@pytest.mark.parametrize("truth", [(0.5,), (0.3, 0.8), (0.1, 0.3, 0.9)], ids=len)
def test_classes_are_found_and_no_more(truth):
    rng = np.random.default_rng(0)
    which = rng.integers(0, len(truth), (40, 50))
    albedo = (np.array(truth)[which] * np.exp(0.08 * rng.standard_normal(which.shape))).astype("f4")
    found = classes(albedo, np.ones(which.shape, bool), 5)
    assert found == pytest.approx(truth, rel=0.02)


def test_a_noisy_material_is_one():
    noise = 0.15 * np.random.default_rng(6).standard_normal((50, 60))
    albedo = (0.5 * np.exp(noise)).astype(np.float32)
    assert classes(albedo, np.ones(albedo.shape, bool), 5) == pytest.approx([0.5], rel=0.02)


def test_the_split_is_that_of_an_exhaustive_search():
    from itertools import combinations

    rng = np.random.default_rng(1)
    values = np.exp(
        np.r_[rng.normal(-2, 0.1, 300), rng.normal(-1, 0.1, 200), rng.normal(0, 0.1, 90)]
    )
    have = classes(values[None].astype(np.float32), np.ones((1, values.size), bool), 3)
    logs = np.sort(np.log(values))
    cuts = range(10, logs.size, 10)

    def cost(pair):
        return sum(((part - part.mean()) ** 2).sum() for part in np.split(logs, pair))

    best = np.split(logs, min(combinations(cuts, 2), key=cost))
    assert have == pytest.approx([np.exp(np.median(part)) for part in best], rel=0.02)


def test_labels_follow_their_neighbours_through_noise():
    rng = np.random.default_rng(2)
    truth = np.zeros((30, 40), np.int8)
    truth[:, 17:] = 1
    levels = np.array([0.4, 0.6])
    albedo = (levels[truth] * np.exp(0.25 * rng.standard_normal(truth.shape))).astype(np.float32)
    usable = rng.random(truth.shape) > 0.1
    alone = np.abs(np.log(albedo[..., None] / levels)).argmin(axis=-1)
    together = labelled(albedo, usable, levels)
    assert (alone != truth).mean() > 0.15
    assert (together != truth).mean() < 0.03
    for axis in (0, 1):
        mirrored = labelled(np.flip(albedo, axis), np.flip(usable, axis), levels)
        assert np.array_equal(np.flip(mirrored, axis), together)
    assert MOST_COST > 8 * 0.5  # a lone outlier among eight of another class gives in


# Corners.


@pytest.mark.parametrize("text", [TWO, ONE], ids=["two", "one"])
@pytest.mark.parametrize("albedos", [(0.5, 0.5), PAIR], ids=["one_material", "two"])
def test_a_corner_is_straightened(text, albedos):
    camera, range_m, albedo, light = frame_of(text, albedos)
    depth = fuchs2013(camera, tol_mm=0.1)(Phasors(light))
    assert mae_m(crt(camera)(Phasors(light)), range_m) > 0.02
    assert mae_m(depth, range_m) < 1e-3
    assert depth.info["albedos"] == pytest.approx(sorted(set(albedos)), rel=0.01)
    assert np.allclose(depth.info["albedos"][depth.info["labels"]], albedo, rtol=0.01)
    assert not depth.info["fallback"].any()


def test_iterated_it_ends_at_the_truth():
    camera, range_m, _, light = frame_of(TWO, (0.6, 0.6))
    run = fuchs2013(camera, tol_mm=0.01, iterations=12, albedos=(0.6,))
    assert np.median(np.abs(run(Phasors(light)).range_m - range_m)) < 2e-5


def test_given_albedos_need_no_scale_of_the_amplitudes():
    camera, range_m, _, light = frame_of(TWO)
    run = fuchs2013(camera, albedos=PAIR, albedo_gain=0.0, tol_mm=0.1)
    want = run(Phasors(light))
    assert mae_m(want, range_m) < 1e-3
    for scale in (1e-3, 0.5, 30.0):
        have = run(Phasors(light * np.float32(scale)))
        # Rounding may refine another tile of the sparse transport: single pixels, within 1 mm.
        assert np.abs(have.range_m - want.range_m).mean() < 2e-5
        assert have.info["albedo_gain"] * scale == pytest.approx(want.info["albedo_gain"], rel=1e-3)


def test_the_scale_is_fitted_from_the_agreement_of_frequencies():
    camera, range_m, _, light = frame_of(TWO)
    depth = fuchs2013(camera, albedo_gain=0.0)(Phasors(light * np.float32(1e-4)))
    assert mae_m(depth, range_m) < 2e-3
    assert depth.info["albedo_gain"] == pytest.approx(1e4, rel=0.1)


def test_one_albedo_for_two_materials_is_wrong_and_so_are_textures():
    """Where it breaks, and `fuchs2010` does not: albedo cancels there."""
    camera, range_m, _, light = frame_of(TWO)
    assert mae_m(fuchs2013(camera, segments=1)(Phasors(light)), range_m) > 8e-3
    texture = np.random.default_rng(3).uniform(0.2, 0.9, range_m.shape)
    _, _, _, light = frame_of(TWO, texture)
    assert mae_m(fuchs2013(camera)(Phasors(light)), range_m) > 2e-3
    assert mae_m(fuchs2010_all_pairs(camera)(Phasors(light)), range_m) < 1e-3


def test_noise_moves_the_correction_less_than_that_of_albedo_per_pixel():
    camera, _, _, light = frame_of("opt8241:width=48,height=36")
    rng = np.random.default_rng(4)
    runs = {"few": fuchs2013(camera), "pixel": fuchs2010_all_pairs(camera), "plain": crt(camera)}
    moved = {"few": [], "pixel": []}
    for _ in range(4):
        noise = rng.standard_normal((2, *light.shape)) * 100
        noisy = (light + noise[0] + 1j * noise[1]).astype(np.complex64)
        frame = Phasors(noisy, np.full(light.shape, 100, np.float32))
        plain = runs["plain"](frame).range_m
        for name, kept in moved.items():
            kept.append(runs[name](frame).range_m - plain)
    few, pixel = (np.std(moved[name], axis=0).mean() for name in ("few", "pixel"))
    assert few < 0.97 * pixel  # the rest is the noise of normals


def test_sigma_is_honest():
    camera, range_m, _, light = frame_of(ONE, (0.2, 0.2))
    run, errors = fuchs2013(camera), []
    rng = np.random.default_rng(5)
    for _ in range(6):
        noise = rng.standard_normal((2, *light.shape)) * 50
        noisy = (light + noise[0] + 1j * noise[1]).astype(np.complex64)
        depth = run(Phasors(noisy, np.full(light.shape, 50, np.float32)))
        errors.append((depth.range_m - range_m) / depth.sigma_m)
    assert 0.9 < np.std(errors) < 1.1


def test_too_bright_to_be_true_gives_the_plain_answer_with_a_larger_sigma():
    camera, _, _, light = frame_of(TWO)
    bright = Phasors(light * np.float32(20), np.full(light.shape, 20, np.float32))
    depth, plain = fuchs2013(camera)(bright), crt(camera)(bright)
    back = depth.info["fallback"]
    assert back.mean() > 0.5
    assert np.array_equal(depth.range_m[back], plain.range_m[back])
    assert (depth.sigma_m[back] >= plain.sigma_m[back]).all()


def test_a_wall_stays_where_it_is():
    camera = sensor(TWO)
    wall = SIMULATORS["analytic"].build(Scene("tilted", {"tilt": 20.0, "albedo": 0.8}))
    capture = wall(Shot(camera, noisy=False))
    depth = fuchs2013(camera)(capture.phasors)
    assert np.abs(depth.range_m - capture.truth.range_m).max() < 1e-4


@pytest.mark.parametrize("shape", [(1, 1), (1, 4096), (2, 3)])
def test_odd_frames(shape):
    values = np.ones((2, *shape), np.complex64)
    for gain in (0.0, 1.0):
        run = fuchs2013(sensor(TWO), albedo_gain=gain)
        assert np.isfinite(run(Phasors(values)).range_m).all()


# Labels of a user.


def drawn(tmp_path, kind, image):
    path = tmp_path / f"labels.{kind}"
    if kind == "npy":
        np.save(path, image)
    else:
        import cv2

        cv2.imwrite(str(path), image)
    return str(path)


@pytest.mark.parametrize("kind", ["npy", "png"])
@pytest.mark.parametrize("albedos", [(), PAIR], ids=["looked_for", "given"])
def test_labels_from_a_file(tmp_path, kind, albedos):
    camera, range_m, albedo, light = frame_of(TWO)
    path = drawn(tmp_path, kind, (albedo > 0.5).astype(np.uint8))
    depth = fuchs2013(camera, labels=path, albedos=albedos, tol_mm=0.1)(Phasors(light))
    assert mae_m(depth, range_m) < 1e-3
    assert np.array_equal(depth.info["labels"], albedo > 0.5)
    assert depth.info["albedos"] == pytest.approx(PAIR, rel=0.01)


def test_bad_labels_are_refused_in_one_sentence(tmp_path):
    camera = sensor(TWO)
    small = drawn(tmp_path, "npy", np.zeros((3, 3), np.uint8))
    with pytest.raises(ValueError, match=r"got labels=.*wanted .*32 x 24"):
        fuchs2013(camera, labels=small)
    for content, name in ((b"", "a.npy"), (b"no", "a.png"), (b"\x93NUMPY", "b.npy")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"got labels=.*wanted") as caught:
            fuchs2013(camera, labels=str(tmp_path / name))
        assert "\n" not in str(caught.value)
    objects = drawn(tmp_path, "npy", np.full((24, 32), None))
    with pytest.raises(ValueError, match=r"got labels=.*wanted"):
        fuchs2013(camera, labels=objects)
    with pytest.raises(ValueError, match=r"got labels=.*wanted"):
        fuchs2013(camera, labels=str(tmp_path / "none.png"))
    three = drawn(tmp_path, "npy", np.full((24, 32), 2, np.uint8))
    with pytest.raises(ValueError, match=r"got 2 albedos for labels up to 2"):
        fuchs2013(camera, labels=three, albedos=PAIR)


@pytest.mark.parametrize(
    "wrong",
    [{"segments": 0}, {"segments": 9}, {"albedos": (1.2,)}, {"albedos": (0.0,)}, {"tol_mm": 0.0}],
)
def test_wrong_parameters_are_refused_in_one_sentence(wrong):
    with pytest.raises(ValueError, match=r"must .*got") as caught:
        fuchs2013(sensor(TWO), **wrong)
    assert "\n" not in str(caught.value)
