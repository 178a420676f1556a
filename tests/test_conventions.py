"""The signs, axes and units of docs/conventions.md, each pinned by a test of its own."""

import numpy as np
import pytest

from toftools.camera import pinhole, points, range_to_z, rays, z_to_range
from toftools.phasor import SCHEMES, demodulate, modulate, phasors_of_depth, wrapped_range_m
from toftools.sensors import PRESETS, SOURCES, resized, sensor
from toftools.sim.analytic import analytic
from toftools.types import Camera, DepthMap, Modulation, Scene, Sensor, Shot, Taps
from toftools.units import C_M_S, ambiguity_m, joint_ambiguity_m, range_to_phase, wrap_phase

SMALL = "opt8241:width=16,height=12"


def shoot(scene, text=SMALL, **params):
    return analytic(Scene(scene, params))(Shot(sensor(text), noisy=False))


def test_phase_grows_with_range_and_lies_in_zero_to_two_pi():
    near, far = (shoot("wall", range=r).phasors.values for r in (1.0, 1.1))
    turned = np.angle(far / near)
    assert (turned > 0).all()
    assert np.allclose(turned[:, 6, 8], range_to_phase(0.1, [40e6, 70e6]), rtol=2e-3)
    assert (
        (wrap_phase([-1e-20, -0.1, 7.0]) >= 0) & (wrap_phase([-1e-20, -0.1, 7.0]) < 2 * np.pi)
    ).all()


def test_tap_is_offset_plus_cosine_of_phase_minus_step():
    taps = shoot("wall").taps.values  # (2, 4, H, W)
    z = shoot("wall").phasors.values
    steps = SCHEMES["four_step"]
    offset = taps.mean(axis=1, keepdims=True)
    model = offset + np.abs(z)[:, None] * np.cos(np.angle(z)[:, None] - steps[:, None, None])
    assert np.allclose(taps, model, rtol=1e-5)


def test_doubling_the_frequency_doubles_the_phase():
    one, two = (shoot("wall", f"deeptof:width=8,height=8,freqs={f}") for f in ("10e6", "20e6"))
    assert np.allclose(wrap_phase(2 * np.angle(one.phasors.values)),
                       wrap_phase(np.angle(two.phasors.values)), atol=1e-5)  # fmt: skip


def test_range_is_radial_and_z_is_axial():
    capture = shoot("wall", range=2.0)
    camera, truth = capture.sensor.camera, capture.truth.range_m
    assert np.allclose(range_to_z(camera, truth), 2.0, atol=1e-6)
    assert truth[0, 0] > truth[6, 8] > 2.0
    assert np.allclose(z_to_range(camera, range_to_z(camera, truth)), truth, rtol=1e-6)


def test_camera_frame_is_x_right_y_down_z_forward():
    camera = pinhole(64, 48, hfov_deg=60)
    cloud = points(camera, np.ones(camera.shape, np.float32))
    assert cloud[24, 60, 0] > 0 > cloud[24, 3, 0]
    assert cloud[44, 32, 1] > 0 > cloud[3, 32, 1]
    assert (cloud[..., 2] > 0).all()
    assert np.allclose(np.linalg.norm(cloud, axis=-1), 1, atol=1e-6)


def test_pixel_centres_are_integers():
    camera = Camera(5, 3, np.array([[10.0, 0, 2], [0, 10, 1], [0, 0, 1]]))
    assert np.allclose(rays(camera)[1, 2], [0, 0, 1])
    assert np.allclose(rays(camera)[1, 3] / rays(camera)[1, 3, 2], [0.1, 0, 1])


def test_distorted_rays_project_back_onto_their_pixels():
    import cv2

    K = np.array([[200.0, 0, 79.5], [0, 210.0, 59.5], [0, 0, 1]])
    camera = Camera(160, 120, K, np.array([-0.2, 0.05, 0.001, -0.002, 0.01]))
    pixels, _ = cv2.projectPoints(
        rays(camera).reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, camera.dist
    )
    v, u = np.mgrid[0:120, 0:160]
    assert np.abs(pixels.reshape(120, 160, 2) - np.stack([u, v], -1)).max() < 1e-6


def test_pixels_without_a_ray_are_nan():
    # k1 = -0.35, k2 = 0.15, k3 = -0.03 folds back in the corners of a wide image.
    K = np.array([[100.0, 0, 159.5], [0, 100.0, 119.5], [0, 0, 1]])
    folding = Camera(320, 240, K, np.array([-0.35, 0.15, 0.0, 0.0, -0.03]))
    directions = rays(folding)
    assert np.isnan(directions[0, 0]).all()
    assert np.isfinite(directions[60:180, 100:220]).all()  # radius 0.85; it folds at 0.945


def test_resizing_keeps_the_field_of_view():
    camera = pinhole(320, 240, hfov_deg=70)
    small = resized(camera, 80, 60)
    again = pinhole(80, 60, hfov_deg=70)
    assert np.allclose(small.K, again.K)


def test_origin_of_path_is_the_camera_centre():
    for range_m in (0.5, 1.0, 3.7):
        capture = shoot("wall", range=range_m)
        measured = wrapped_range_m(capture.phasors.values, [40e6, 70e6])
        wraps = np.round(
            (capture.truth.range_m - measured) / ambiguity_m([40e6, 70e6])[:, None, None]
        )
        error = measured + wraps * ambiguity_m([40e6, 70e6])[:, None, None] - capture.truth.range_m
        assert np.abs(error).max() < 2e-6


def test_ambient_light_moves_no_phase():
    dark, lit = (shoot("two_returns", ambient_e=a) for a in (0.0, 5000.0))
    assert np.allclose(dark.phasors.values, lit.phasors.values, atol=2e-2)  # float32 of 1e4 e-
    assert np.allclose(lit.taps.values - dark.taps.values, 5000, atol=1e-2)
    assert (lit.phasors.sigma > dark.phasors.sigma).all()


def test_c_and_ambiguity():
    assert C_M_S == 299_792_458
    assert ambiguity_m(60e6) == pytest.approx(2.498, abs=5e-4)  # MANIFEST 1.1
    assert joint_ambiguity_m([40e6, 70e6]) == pytest.approx(C_M_S / 2 / 10e6)
    assert joint_ambiguity_m([45.18e6, 37.65e6]) == pytest.approx(19.9, abs=0.02)
    assert joint_ambiguity_m([80e6, 16e6, 120e6]) == pytest.approx(18.75, abs=0.02)
    for tol_cycles in (0.0, 1e-7, 0.02):
        with pytest.raises(ValueError, match="never meet"):
            joint_ambiguity_m([40e6, 40e6 * np.sqrt(2)], tol_cycles=tol_cycles)
    with pytest.raises(ValueError, match="give Hz, not MHz"):
        Modulation(np.array([40.0, 70.0]))


@pytest.mark.parametrize(
    ("freqs_mhz", "turns"),  # turns of the highest frequency
    [
        ((100, 101), 101), ((60, 61), 61), ((300, 301), 301), ((1, 120), 120),
        ((198, 189, 54), 22), ((50.5, 100), 200), ((20, 20, 50), 5), ((100 / 3, 100), 3),
        # Slightly off: the near repetition of the nominal frequencies.
        ((100.0003, 101.0007), 101), ((40.01, 69.97), 7), ((80.1675385, 120.44403642), 3),
        ((80.1675385, 16.05444453, 120.44403642), 15),
    ],
)  # fmt: skip
def test_joint_ambiguity_is_the_common_divisor_and_no_near_miss_before_it(freqs_mhz, turns):
    freqs = 1e6 * np.array(freqs_mhz)
    expected = turns * float(ambiguity_m(freqs.max()))
    assert joint_ambiguity_m(freqs) == pytest.approx(expected, rel=1e-12)
    assert joint_ambiguity_m(freqs[::-1]) == pytest.approx(expected, rel=1e-12)


def test_an_exact_repetition_can_be_asked_for():
    assert joint_ambiguity_m([100e6, 101e6], tol_cycles=0) == pytest.approx(C_M_S / 2e6)
    assert joint_ambiguity_m([40.01e6, 69.97e6], tol_cycles=0) == pytest.approx(C_M_S / 2e4)
    with pytest.raises(ValueError, match="never meet"):
        joint_ambiguity_m([80.1675385e6, 16.05444453e6, 120.44403642e6], tol_cycles=0)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_modulate_then_demodulate_is_identity_for_every_scheme(scheme):
    rng = np.random.default_rng(1)
    z = rng.normal(size=(2, 5, 7)) + 1j * rng.normal(size=(2, 5, 7))
    steps = np.stack([SCHEMES[scheme], SCHEMES[scheme] + 0.3])  # per-frequency steps
    taps = modulate(z, 10.0, steps)
    device = Sensor(pinhole(7, 5, hfov_deg=60), Modulation(np.array([40e6, 70e6]), steps))
    assert np.allclose(demodulate(Taps(taps), device).values, z, atol=3e-6)


def test_arbitrary_steps_demodulate_by_least_squares():
    steps = np.array([0.0, 1.0, 2.5, 4.0, 5.5])
    device = Sensor(pinhole(4, 3, hfov_deg=60), Modulation(np.array([20e6]), steps))
    z = np.full((1, 3, 4), 3 * np.exp(2j))
    assert np.allclose(
        demodulate(Taps(modulate(z, 100.0, steps[None])), device).values, z, atol=1e-4
    )
    with pytest.raises(ValueError, match="do not separate"):
        bad = Sensor(device.camera, Modulation(np.array([20e6]), np.array([0.0, np.pi, 2 * np.pi])))
        demodulate(Taps(np.ones((1, 3, 3, 4))), bad)


def test_depth_only_camera_enters_as_phasors_without_loss():
    rng = np.random.default_rng(2)
    range_m = rng.uniform(0.2, 7.0, (6, 8)).astype(np.float32)
    range_m[2, 3] = np.nan
    amplitude = rng.uniform(10, 100, (6, 8)).astype(np.float32)
    z = phasors_of_depth(DepthMap(range_m, amplitude=amplitude), 20e6)
    assert not z.valid[2, 3]
    assert z.valid.sum() == 47
    keep = z.valid
    assert np.allclose(wrapped_range_m(z.values, [20e6])[0][keep], range_m[keep], atol=1e-5)
    assert np.allclose(np.abs(z.values[0])[keep], amplitude[keep], rtol=1e-5)


def test_a_range_without_amplitude_is_still_a_range():
    range_m = np.array([[1.0, 2.0, 3.0, 4.0, 5.0, np.nan]])
    amplitude = np.array([[50.0, 0.0, np.nan, np.inf, -1.0, 7.0]])
    z = phasors_of_depth(DepthMap(range_m, amplitude=amplitude), 20e6)
    assert z.valid.tolist() == [[True] * 5 + [False]]
    assert np.allclose(np.abs(z.values[0, 0]), [50, 1, 1, 1, 1, 0], rtol=1e-6)
    assert np.allclose(wrapped_range_m(z.values, [20e6])[0, 0, :5], range_m[0, :5], atol=1e-5)


def test_every_preset_has_a_source_and_survives_overrides():
    assert set(PRESETS) == set(SOURCES)
    for name in PRESETS:
        made = sensor(f"{name}:width=32,height=24,read_e=5")
        assert made.camera.shape == (24, 32)
        assert made.noise.read_e == 5
        assert made.name == name
        joint_ambiguity_m(made.modulation.freqs_hz)
    kinect = sensor("kinect2").modulation
    assert kinect.freqs_hz.tolist() == [80.1675385e6, 16.05444453e6, 120.44403642e6]
    assert np.allclose(np.diff(kinect.steps_rad[0]) % (2 * np.pi), 2 * np.pi / 3)
    with pytest.raises(ValueError, match="unknown sensor key 'frequencies'"):
        sensor("deeptof:frequencies=20e6")
