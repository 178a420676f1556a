"""jimenez2014: gradient against the twin, corners with all bounces, noise, what it refuses."""

import numpy as np
import pytest
from reference_jimenez import corner_frame, objective, slope_of

from toftools.correct._jimenez_fit import minimise, misfit, problem
from toftools.correct._jimenez_nodes import place
from toftools.correct._scene import optics, surface
from toftools.correct.crt import crt
from toftools.correct.jimenez2014 import jimenez2014
from toftools.registry import SIMULATORS
from toftools.sensors import sensor
from toftools.types import Phasors, Scene, Shot

TWO, ONE = "opt8241:width=24,height=18", "deeptof:width=24,height=18"


def frame_of(text, albedos=(0.3, 0.8)):
    """Sensor, true range, phasors of a corner with all its bounces."""
    camera = sensor(text)
    range_m, _, light = corner_frame(camera, albedos)
    return camera, range_m, light.astype(np.complex64)


def task_of(text, count):
    """The problem of the first round on the plain ranges of a corner."""
    camera, _, light = frame_of(text)
    view, plain = optics(camera), crt(camera)(Phasors(light))
    seen = surface(view, plain.range_m)
    here = place(view, seen, light, None, plain.range_m > 0, count=count)
    return problem(here, view.freqs_hz, slope=0.02, albedo_gain=1.0)


@pytest.mark.parametrize("text", [TWO, ONE], ids=["two", "one"])
def test_objective_and_gradient_are_those_of_the_twin(text):
    task = task_of(text, 40)
    x_m = 0.01 * np.random.default_rng(0).standard_normal(task.nodes.range_m.size)
    have, want = misfit(task, x_m), slope_of(task, x_m)
    assert have.value == pytest.approx(objective(task, x_m), rel=1e-5)
    assert np.abs(have.gradient - want).max() < 1e-5 * np.abs(want).max()


def test_the_optimiser_finds_the_bias_of_the_nodes():
    camera, range_m, light = frame_of(TWO)
    view = optics(camera)
    plain = crt(camera)(Phasors(light)).range_m
    # Normals and places of the truth: what is left is the range alone.
    seen = surface(view, range_m)
    here = place(view, seen, light, None, plain > 0, count=plain.size)
    task = problem(here, view.freqs_hz, slope=1.0, albedo_gain=1.0)
    start = 0.02 * np.sin(np.arange(here.range_m.size))
    assert misfit(task, start).value > 1e3
    assert misfit(task, np.zeros_like(start)).value < 1e-3  # the truth explains the phasors
    moved = minimise(task, iterations=30)
    assert np.abs(moved).max() < 1e-4


@pytest.mark.parametrize("nodes", [100, 1200])
@pytest.mark.parametrize("text", [TWO, ONE], ids=["two", "one"])
def test_a_corner_is_straightened(text, nodes):
    camera, range_m, light = frame_of(text)
    plain = np.abs(crt(camera)(Phasors(light)).range_m - range_m).mean()
    depth = jimenez2014(camera, nodes=nodes)(Phasors(light))
    error = np.abs(depth.range_m - range_m).mean()
    assert plain > 0.02
    assert error < (1e-3 if nodes == 1200 else 4e-3)
    assert not depth.info["fallback"].any()
    assert (np.abs(depth.info["indirect"]) > 0).any()


def test_the_first_round_is_more_than_a_step():
    """One round of optimisation moves the nodes nearer to the truth than they were."""
    camera, range_m, light = frame_of(TWO)
    view, plain = optics(camera), crt(camera)(Phasors(light))
    seen = surface(view, plain.range_m)
    here = place(view, seen, light, None, plain.range_m > 0, count=plain.range_m.size)
    assert here.range_m.size == plain.range_m.size
    task = problem(here, view.freqs_hz, slope=0.02, albedo_gain=1.0)
    moved = minimise(task, iterations=20)
    before, after = misfit(task, np.zeros_like(moved)), misfit(task, moved)
    assert after.value < 0.2 * before.value
    left = np.abs(here.range_m + moved - range_m.ravel())
    assert left.mean() < 0.25 * np.abs(here.range_m - range_m.ravel()).mean()


def test_no_light_is_lost_at_creases_and_in_noise():
    camera, range_m, light = frame_of(TWO)
    view = optics(camera)
    noisy = range_m * (1 + 0.03 * np.random.default_rng(2).standard_normal(range_m.shape))
    for range_now, count in ((range_m, 30), (noisy, 100)):
        seen = surface(view, range_now)
        here = place(view, seen, light, None, range_m > 0, count=count)
        assert here.range_m.size > count / 2
        assert here.patches.area_m2.sum() > 0.995 * seen.area_m2[seen.flat].sum()


def test_sigma_is_honest():
    camera, range_m, light = frame_of(ONE, (0.2, 0.2))
    run, errors = jimenez2014(camera, nodes=200), []
    rng = np.random.default_rng(1)
    for _ in range(4):
        noise = rng.standard_normal((2, *light.shape)) * 60
        noisy = (light + noise[0] + 1j * noise[1]).astype(np.complex64)
        depth = run(Phasors(noisy, np.full(light.shape, 60, np.float32)))
        errors.append((depth.range_m - range_m) / depth.sigma_m)
    assert 0.9 < np.std(errors) < 1.1


def test_the_scale_of_the_amplitudes_can_be_fitted():
    camera, range_m, light = frame_of(TWO)
    depth = jimenez2014(camera, albedo_gain=0.0)(Phasors(light * np.float32(1e-4)))
    assert depth.info["albedo_gain"] == pytest.approx(1e4, rel=0.03)
    assert np.abs(depth.range_m - range_m).mean() < 1e-3


def test_too_bright_to_be_true_gives_the_plain_answer_with_a_larger_sigma():
    camera, _, light = frame_of(TWO)
    bright = Phasors(light * np.float32(20), np.full(light.shape, 20, np.float32))
    depth, plain = jimenez2014(camera)(bright), crt(camera)(bright)
    back = depth.info["fallback"]
    assert back.mean() > 0.5
    assert np.array_equal(depth.range_m[back], plain.range_m[back])
    assert (depth.sigma_m[back] >= plain.sigma_m[back]).all()


def test_a_wall_stays_where_it_is():
    camera = sensor(TWO)
    wall = SIMULATORS["analytic"].build(Scene("tilted", {"tilt": 20.0, "albedo": 0.8}))
    capture = wall(Shot(camera, noisy=False))
    depth = jimenez2014(camera)(capture.phasors)
    assert np.abs(depth.range_m - capture.truth.range_m).max() < 1e-4


@pytest.mark.parametrize("shape", [(1, 1), (1, 4096), (2, 3)])
def test_odd_frames(shape):
    values = np.ones((2, *shape), np.complex64)
    assert np.isfinite(jimenez2014(sensor(TWO))(Phasors(values)).range_m).all()


@pytest.mark.parametrize("wrong", [{"nodes": 0}, {"iterations": 0}, {"slope": 0.0}])
def test_wrong_parameters_are_refused_in_one_sentence(wrong):
    with pytest.raises(ValueError, match=r"got nodes=.*wanted") as caught:
        jimenez2014(sensor(TWO), **wrong)
    assert "\n" not in str(caught.value)
