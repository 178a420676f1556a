"""The published files yield their known figures; they are found through TOFTOOLS_DATA."""

import os
from pathlib import Path

import numpy as np
import pytest

from toftools.camera import range_to_z
from toftools.io.open import open_capture
from toftools.phasor import wrapped_range_m
from toftools.units import ambiguity_m


def real(*parts):
    folder = os.environ.get("TOFTOOLS_DATA")
    if not folder:
        pytest.skip("TOFTOOLS_DATA is not set")
    path = Path(folder, *parts)
    if not path.exists():
        pytest.skip(f"TOFTOOLS_DATA has no {'/'.join(parts)}")
    return path


SU_SYNTH = {  # mean absolute error in cm: 40 MHz and 70 MHz with the right wraps, ToFNet
    "000001": (8.81, 4.71, 4.49),
    "000002": (4.85, 2.61, 1.67),
    "000003": (16.77, 5.81, 3.11),
}


@pytest.mark.parametrize("frame", SU_SYNTH)
def test_real_su2018_multipath_error_alone(frame):
    capture = open_capture(real("su2018_synth_40_70MHz", f"im_pair_{frame}.mat"))
    freqs, truth = capture.sensor.modulation.freqs_hz, capture.truth.range_m.astype(np.float64)
    use = (truth > 0.1) & (truth < 9.9) & capture.phasors.valid
    turns = ambiguity_m(freqs)[:, None]
    error = (wrapped_range_m(capture.phasors.values, freqs) - truth)[:, use]
    error -= turns * np.round(error / turns)
    tofnet = (capture.reported["tofnet"] - truth)[use]
    got = 100 * np.array([*np.abs(error).mean(axis=1), np.abs(tofnet).mean()])
    np.testing.assert_allclose(got, SU_SYNTH[frame], atol=0.005)  # the figures have two decimals


@pytest.mark.parametrize(
    ("name", "invalid", "low_high_cm"),
    [
        ("im_pair_0122_pix2pix_test_real_4.mat", 23, (-5.6, 1.6)),
        ("im_pair_0714_pix2pix_test_real_0.mat", 0, (-7.0, 2.1)),
    ],
)
def test_real_su2018_camera_distance(name, invalid, low_high_cm):
    capture = open_capture(real("su2018_tintin_40_70MHz", name))
    assert capture.truth is None
    assert (~capture.phasors.valid).sum() == invalid
    freqs, camera_m = capture.sensor.modulation.freqs_hz, capture.depth.range_m.astype(np.float64)
    use = (camera_m > 0.1) & (camera_m < 9.9) & capture.phasors.valid
    turns = ambiguity_m(freqs)[:, None]
    error = (wrapped_range_m(capture.phasors.values, freqs) - camera_m)[:, use]
    error -= turns * np.round(error / turns)
    np.testing.assert_allclose(100 * error.mean(axis=1), low_high_cm, atol=0.05)


def test_real_melexis_agrees_with_its_vendor_up_to_an_offset():
    capture = open_capture(real("snapshot_lidar_mlx75027_60MHz"))
    use = capture.phasors.valid & np.isfinite(capture.depth.range_m)
    assert use.mean() == pytest.approx(0.994, abs=0.001)
    z = capture.phasors.values[0][use]
    error = wrapped_range_m(z[None], [60e6])[0] - capture.depth.range_m[use]
    mean = np.exp(2j * np.pi * error / ambiguity_m(60e6)).mean()
    assert abs(mean) == pytest.approx(0.9996, abs=5e-5)
    assert np.angle(mean) / (2 * np.pi) * ambiguity_m(60e6) == pytest.approx(-1.105, abs=5e-4)
    ratio = np.median(2 * np.abs(z) / capture.depth.amplitude[use])
    assert ratio == pytest.approx(1.007, abs=5e-4)


def test_real_azure_frame():
    capture = open_capture(real("azure_kinect_pyk4a", "recording.mkv"))
    z_mm = 1000 * range_to_z(capture.sensor.camera, capture.depth.range_m).astype(np.float64)
    assert np.isnan(z_mm).mean() == pytest.approx(0.235, abs=5e-4)
    assert np.nanmedian(z_mm) == pytest.approx(1491, abs=0.5)
    assert np.nanmax(z_mm) == pytest.approx(3690, abs=0.5)
    assert np.abs(z_mm - np.round(z_mm))[np.isfinite(z_mm)].max() < 1e-3


def test_real_adi_frame():
    path = real("adi_adtf3175", "apps_http-server_out_depth_.bin")
    depth = open_capture(path, "adi_bin:kind=range").depth
    assert np.nanmax(depth.range_m) == pytest.approx(3.629)
    percentiles = np.nanpercentile(depth.range_m, [1, 99])
    np.testing.assert_allclose(percentiles, [0.273, 0.446], atol=5e-4)
    assert (depth.amplitude.min(), depth.amplitude.max()) == (11, 2706)
    assert np.isnan(depth.range_m).mean() < 1e-4


def test_real_ifm_frame():
    depth = open_capture(real("ifm_o3r", "O3RBuffer.data")).depth
    known = np.isfinite(depth.range_m)
    assert known.mean() == pytest.approx(0.259, abs=5e-4)
    percentiles = np.percentile(depth.range_m[known], [1, 50, 99])
    np.testing.assert_allclose(percentiles, [0.24, 0.51, 1.89], atol=0.005)


def test_real_espros_saturation():
    path = real("espros_epc635_20MHz", "amplitude_w544c005_250527_134627.h5")
    frames = [open_capture(path, f"espros_h5:frame={n}").provenance for n in range(85)]
    clipped, zero = (np.mean([f[key] for f in frames]) for key in ("clipped_share", "zero_share"))
    assert clipped == pytest.approx(0.31, abs=0.005)
    assert zero == pytest.approx(0.018, abs=5e-4)


def test_real_files_of_other_kinds_are_not_taken_for_recordings():
    for parts in [
        ("azure_calib_registration", "ir-0.png"),
        ("kinect2_tables", "p0tables_3x424x512_u16.dat"),
        ("tanaka_kinect2_distortion", "wood_3mm.npy"),
        ("adi_adtf3175", "examples_tof-viewer_external_FSF_src_ccb_example_1_CCB_1909-0240034.mat"),
    ]:
        with pytest.raises(ValueError, match="no reader recognises it"):
            open_capture(real(*parts))


def test_real_adi_lens_is_that_of_the_preset():
    from scipy.io import loadmat

    from toftools.sensors import sensor

    name = "examples_tof-viewer_external_FSF_src_ccb_example_1_CCB_1909-0240034.mat"
    path = real("adi_adtf3175", name)
    block = loadmat(path, squeeze_me=True, struct_as_record=False)["cal"].GeometricCalibration
    camera = sensor("adtf3175:width=1024,height=1024").camera
    expected = [[block.fx, 0, block.px], [0, block.fy, block.py], [0, 0, 1]]
    np.testing.assert_allclose(camera.K, expected, atol=1e-5)
    np.testing.assert_allclose(np.delete(camera.dist, [2, 3]), block.k, atol=1e-8)
