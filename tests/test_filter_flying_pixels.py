"""Flying pixels: against a slow twin, found on mixed pixels, and nothing lost of steep walls."""

import numpy as np
import pytest

from toftools.camera import rays, z_to_range
from toftools.correct import INVALID, OK, REJECTED
from toftools.correct.crt import crt
from toftools.filter.flying_pixels import flying_pixels
from toftools.sensors import sensor as preset
from toftools.types import DepthMap, Phasors
from toftools.units import range_to_phase

DEVICE = preset("opt8241:width=80,height=60")
CAMERA = DEVICE.camera
FREQS = DEVICE.modulation.freqs_hz[:, None, None]
V, U = np.mgrid[0:60, 0:80]
NONE = Phasors(np.ones((2, 60, 80)))


def twin(depth, forward, wanted, gap_m, noise_sigmas):
    """The header's two rules, pixel by pixel."""
    with np.errstate(invalid="ignore"):
        w = 1 / (depth.range_m * forward)
    bend = [abs(w[y, x - 1] - 2 * w[y, x] + w[y, x + 1]) / w[y, x] ** 2
            for y in range(w.shape[0]) for x in range(1, w.shape[1] - 1)]  # fmt: skip
    sigma_z_m = np.nanmedian(bend) / (np.sqrt(6) * 0.6745)
    noise = sigma_z_m * w**2 if depth.sigma_m is None else depth.sigma_m * forward * w**2
    found = np.zeros(w.shape, bool)
    steps = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]

    def known(y, x):
        return 0 <= y < w.shape[0] and 0 <= x < w.shape[1] and np.isfinite(w[y, x])

    for y, x in np.argwhere(np.isfinite(w)):
        level, plane = [], []
        for dy, dx in steps:
            one, two = (y + dy, x + dx), (y + 2 * dy, x + 2 * dx)
            if known(*one):
                allowed = gap_m * w[y, x] ** 2
                spread = np.hypot(noise[y, x], noise[one])
                level.append(abs(w[y, x] - w[one]) <= allowed + noise_sigmas * spread)
                if known(*two):
                    spread = np.sqrt(noise[y, x] ** 2 + 4 * noise[one] ** 2 + noise[two] ** 2)
                    miss = abs(w[y, x] - 2 * w[one] + w[two])
                    plane.append(miss <= allowed + noise_sigmas * spread)
        enough = sum(level) >= wanted / 8 * len(level)
        found[y, x] = not (enough or sum(plane) >= (wanted + 2) / 8 * len(plane))
    return found


def mixed_edge(gap_m=1.0, *, slant=0.37, snr=200.0, seed=0):
    """A near and a far wall, an oblique edge between them averaged over each pixel's area."""
    share = np.clip(40 + slant * V - U + 0.5, 0, 1)  # of the near wall in the pixel
    near, far = (z_to_range(CAMERA, np.full(U.shape, z)) for z in (2.0, 2.0 + gap_m))
    light = [1000.0 * np.exp(1j * range_to_phase(r, FREQS)) for r in (near, far)]
    clean = share * light[0] + (1 - share) * light[1]
    rng = np.random.default_rng(seed)
    sigma = 1000.0 / snr
    noise = sigma * (rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape))
    frame = Phasors((clean + noise).astype(np.complex64), np.full(clean.shape, sigma, np.float32))
    depth = crt(DEVICE, max_range_m=10.0)(frame)
    beside = np.minimum(np.abs(depth.range_m - near), np.abs(depth.range_m - far))
    return frame, depth, beside, (share > 0) & (share < 1)


@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
@pytest.mark.parametrize("wanted", [1, 3, 6])
def test_the_kernel_is_the_slow_twin(wanted, known):
    _, depth, _, _ = mixed_edge(snr=50.0)
    range_m = np.array(depth.range_m)
    range_m[np.random.default_rng(1).random(range_m.shape) < 0.05] = np.nan
    depth = DepthMap(range_m, depth.sigma_m if known else None)
    have = flying_pixels(DEVICE, least_neighbours=wanted)(depth, NONE).info["flying"]
    forward = rays(CAMERA)[..., 2].astype(np.float32)
    want = twin(depth, forward, wanted, 0.01, 2.0)
    assert want.any()
    assert (have != want).mean() < 1e-3  # comparisons at the rounding of float32


@pytest.mark.parametrize("gap_m", [0.3, 1.0, 3.0])
def test_mixed_pixels_of_an_oblique_edge_are_found(gap_m):
    frame, depth, beside, mixed = mixed_edge(gap_m)
    out = flying_pixels(DEVICE)(depth, frame)
    gone = out.info["flying"]
    flying = mixed & (beside > 0.05)
    assert flying.sum() > 30
    assert gone[flying].mean() > 0.8
    assert gone[~mixed].mean() < 0.003
    left = np.isfinite(out.range_m)
    assert (beside[left] > 0.05).sum() < 0.2 * (beside > 0.05).sum()


@pytest.mark.parametrize("known", [True, False], ids=["sigma", "no_sigma"])
@pytest.mark.parametrize("tilt_deg", [0, 40, 70, 80, 85])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_nothing_of_a_plane_is_lost_at_any_tilt(tilt_deg, axis, known):
    tilt = np.radians(tilt_deg)
    towards = ([1, 0], [0, 1], [np.sqrt(0.5), np.sqrt(0.5)])[axis]
    normal = np.array([*(np.sin(tilt) * np.array(towards)), np.cos(tilt)])
    across = rays(CAMERA) @ normal
    seen = across > 0.02
    range_m = np.where(seen, 2 * normal[2] / np.where(seen, across, 1.0), np.nan)
    seen &= range_m < 20
    rng = np.random.default_rng(2)
    noise = 0.005 * known
    range_m = np.where(seen, range_m + noise * rng.standard_normal(range_m.shape), np.nan)
    sigma_m = np.full(range_m.shape, noise) if known else None
    out = flying_pixels(DEVICE)(DepthMap(range_m, sigma_m), NONE)
    lost = out.info["flying"].sum() / max(seen.sum(), 1)
    assert lost == 0 if not known else lost < 2e-3


def test_an_edge_without_mixed_pixels_and_a_crease_lose_nothing():
    step = DepthMap(z_to_range(CAMERA, np.where(U < 40, 2.0, 3.0)))
    crease = DepthMap(z_to_range(CAMERA, 3.0 - 0.01 * np.abs(U - 40)))
    for depth in (step, crease):
        assert not flying_pixels(DEVICE)(depth, NONE).info["flying"].any()


def test_noise_alone_rejects_almost_nothing():
    rng = np.random.default_rng(3)
    for sigma in (0.002, 0.02, 0.1):
        range_m = z_to_range(CAMERA, np.full(U.shape, 3.0)) + sigma * rng.standard_normal(U.shape)
        out = flying_pixels(DEVICE)(DepthMap(range_m, np.full(U.shape, sigma)), NONE)
        assert out.info["flying"].mean() < 0.003


def test_unknown_noise_is_found_on_the_image():
    rng = np.random.default_rng(4)
    for sigma in (0.002, 0.02, 0.1):
        z = np.full(U.shape, 3.0) + sigma * rng.standard_normal(U.shape)
        z[30, 40] = 4.5
        out = flying_pixels(DEVICE)(DepthMap(z_to_range(CAMERA, z)), NONE)
        assert out.info["flying"][30, 40]
        assert out.info["flying"].mean() < 0.003


def test_what_is_rejected_is_said_and_the_rest_is_untouched():
    range_m = z_to_range(CAMERA, np.full(U.shape, 2.0))
    range_m[30, 40], range_m[10, 10] = 2.7, np.nan
    status = np.where(np.isnan(range_m), np.uint8(REJECTED), np.uint8(OK))
    given = DepthMap(range_m, np.full(U.shape, 0.01), np.ones(U.shape), 5 * np.ones(U.shape),
                     {"status": status, "residual": range_m})  # fmt: skip
    out = flying_pixels(DEVICE)(given, NONE)
    assert np.argwhere(out.info["flying"]).tolist() == [[30, 40]]
    assert (out.info["status"][30, 40], out.info["status"][10, 10]) == (REJECTED, REJECTED)
    assert np.isnan(out.sigma_m[30, 40])
    assert out.confidence[30, 40] == 0
    assert np.array_equal(out.amplitude, given.amplitude)
    assert out.info["residual"] is given.info["residual"]
    kept = ~out.info["flying"]
    assert np.array_equal(out.range_m[kept], given.range_m[kept], equal_nan=True)
    plain = flying_pixels(DEVICE)(DepthMap(range_m), NONE).info["status"]
    assert (plain[30, 40], plain[10, 10]) == (REJECTED, INVALID)


def test_a_wire_of_three_pixels_stays_and_a_bent_hair_goes():
    z = np.full(U.shape, 3.0)
    z[:, 38:41] = 1.5
    assert not flying_pixels(DEVICE)(DepthMap(z_to_range(CAMERA, z)), NONE).info["flying"].any()
    hair = np.full(U.shape, 3.0)
    hair[V[:, 0], 40] = 1.5 + 0.03 * (V[:, 0] % 7)  # one pixel wide, and not straight
    gone = flying_pixels(DEVICE)(DepthMap(z_to_range(CAMERA, hair)), NONE).info["flying"]
    assert gone[:, 40].mean() > 0.5  # as the header says


@pytest.mark.parametrize("params", [{"least_neighbours": 0}, {"least_neighbours": 7},
                                    {"gap_m": -0.1}, {"noise_sigmas": -1.0}])  # fmt: skip
def test_parameters_out_of_range_are_refused(params):
    with pytest.raises(ValueError, match="flying_pixels wants least_neighbours of"):
        flying_pixels(DEVICE, **params)
