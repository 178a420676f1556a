"""The adapter against mitransient's own tensors: a wall at 2 m and its Cornell box.

In an environment with ``mitransient==1.3.1`` and an LLVM (not the one of toftools):
    python benchmarks/adapt_mitransient.py render tensors.npz
and in that of toftools:
    python benchmarks/adapt_mitransient.py check tensors.npz
The figures it prints are quoted in tests/test_adapt.py.
"""

import sys

import numpy as np

C_M_S = 299_792_458.0  # for the other environment, which has no toftools
FREQS = np.array([20e6, 50e6, 70e6])
NEARS = (1e-4, 0.01, 0.1)
BINS = (300, 1000, 4096)
INTENSITY, BOX_NEAR, BOX_PATH_M = 10.0, 0.05, 30.0


def film(kind, width, height, bins, bin_m):
    made = {"type": kind, "width": width, "height": height, "temporal_bins": bins,
            "bin_width_opl": bin_m, "start_opl": 0.0, "rfilter": {"type": "box"}}  # fmt: skip
    return made if kind == "transient_hdr_film" else {**made, "wl_mean": 15.0, "wl_sigma": 1e30}


def render(path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    import mitransient as mitr

    kinds = {"phasors": "phasor_hdr_film", "bins": "transient_hdr_film"}
    light = {"type": "point", "intensity": {"type": "rgb", "value": INTENSITY}}
    turn = mi.ScalarTransform4f
    out = {}

    def shoot(name, kind, scene, samples):
        loaded = mi.load_dict(scene)
        if kind == "phasors":
            per_m = [mi.Float(f / C_M_S) for f in FREQS]
            loaded.sensors()[0].film().frequencies = mitr.utils.ArrayXf(per_m)
        steady, out[name] = (np.array(part) for part in mi.render(loaded, spp=samples, seed=0))
        out[f"{name}_steady"] = steady

    for near in NEARS:
        for kind, plugin in kinds.items():
            eye = {"type": "perspective", "fov": 40.0, "near_clip": near, "far_clip": 100.0,
                   "to_world": turn().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0]),
                   "film": film(plugin, 32, 24, 1000, 0.009)}  # fmt: skip
            grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
            pose = turn().translate([0, 0, 2]).rotate([0, 1, 0], 180).scale(10)
            wall = {"type": "rectangle", "to_world": pose, "bsdf": grey}
            scene = {"type": "scene", "integrator": {"type": "transient_path", "max_depth": 2},
                     "sensor": eye, "wall": wall, "light": light}  # fmt: skip
            shoot(f"wall_{near:g}_{kind}", kind, scene, 64)
    for kind, bins, depth in (
        ("phasors", 64, 8),
        *(("bins", n, 8) for n in BINS),
        ("bins", 4096, 2),
    ):
        scene = mitr.cornell_box()
        scene["sensor"].update(near_clip=BOX_NEAR,
                               film=film(kinds[kind], 32, 32, bins, BOX_PATH_M / bins))  # fmt: skip
        scene["integrator"] = {"type": "transient_path", "max_depth": depth, "rr_depth": 1000}
        scene["light"] = {**light, "position": [0, 0, 3.9]}
        shoot(f"box_{kind}_{bins}_{depth}", kind, scene, 512)
    np.savez_compressed(path, **out)


def check(path):
    from toftools.camera import pinhole, rays
    from toftools.phasor import wrapped_range_m
    from toftools.sim.adapt import (
        mitransient_histogram,
        mitransient_phasors,
        phasor_capture,
        transient_capture,
    )
    from toftools.transient import first_return_m
    from toftools.types import Modulation, Noise, Sensor
    from toftools.units import phase_to_range

    tensors = np.load(path)

    def captures(name, bins, bin_m, camera, near):
        device = Sensor(camera, Modulation(FREQS), Noise())
        known = {"start_opl": 0.0, "near_clip": near, "camera": camera, "intensity": INTENSITY}
        turned = mitransient_phasors(tensors[name], tensors[f"{name}_steady"],
                                     freqs_per_unit=FREQS / C_M_S, **known)  # fmt: skip
        binned = mitransient_histogram(tensors[bins], bin_width_opl=bin_m, **known)
        return (phasor_capture(*turned, device, seed=None),
                transient_capture(binned, device, seed=None), binned)  # fmt: skip

    camera = pinhole(32, 24, hfov_deg=40.0)
    cosine = rays(camera)[..., 2]
    print("wall at 2 m, mean z in m at 20 MHz: as it comes, corrected; of bins of 9 mm, corrected")
    for near in NEARS:
        name = f"wall_{near:g}"
        found = [captures(f"{name}_phasors", f"{name}_bins", 0.009, camera, n) for n in (0, near)]
        reads = [(wrapped_range_m(c.phasors.values, FREQS)[0] * cosine).mean()
                 for c in (found[0][0], found[1][0], found[1][1])]  # fmt: skip
        charge = found[1][1].taps.values.mean(axis=1)[0] / (Noise().signal_e * cosine**3 / 8)
        print(f"near_clip {near:g}:", *(f"{z:.5f}" for z in reads), f"charge {charge.mean():.5f}")
    camera = pinhole(32, 32, hfov_deg=39.3077)
    print("Cornell box: rms range of bins against its own phasors, mm, at 20, 50, 70 MHz")
    for bins in BINS:
        bin_m = BOX_PATH_M / bins
        exact, made, light = captures("box_phasors_64_8", f"box_bins_{bins}_8", bin_m, camera,
                                      BOX_NEAR)  # fmt: skip
        angle = np.angle(made.phasors.values * exact.phasors.values.conj())
        off = phase_to_range(angle, FREQS[:, None, None])
        rms = 1e3 * np.sqrt((off**2).mean(axis=(1, 2)))
        print(f"{bins} bins of {1e3 * bin_m:.1f} mm:", *(f"{value:.3f}" for value in rms))
    alone = captures("box_phasors_64_8", "box_bins_4096_2", bin_m, camera, BOX_NEAR)[2]
    truth, seen = first_return_m(alone), first_return_m(light)
    both = np.isfinite(truth) & np.isfinite(seen)
    off = 1e3 * (seen - truth)[both]
    print(f"first return among {bins} bins in {np.isfinite(seen).mean():.0%} of the pixels")
    print(f"against its direct light: mean {off.mean():.2f}, worst {np.abs(off).max():.2f} mm "
          f"(a quarter of a bin is {1e3 * bin_m / 4:.2f})")  # fmt: skip


if __name__ == "__main__":
    {"render": render, "check": check}[sys.argv[1]](sys.argv[2])
