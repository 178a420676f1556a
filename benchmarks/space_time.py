"""The space-time histogram by virtual lights: the paper's setting and its studies, in one run.

python benchmarks/space_time.py --out DIR [--gpu] [--quick]     writes DIR/space_time.{json,md,png}

The paper ("Transient instant radiosity", 2019, figures 1 to 5) renders a Cornell box of 1024 x 1024
pixels, 250 frames, 128 x 128 virtual lights and one bounce in 27.98 s on a GTX 1060, with imperfect
shadow maps. Here every pair of a pixel and a virtual light gets a shadow ray. Errors are those of
range at 20 MHz out of the histogram, against a converged one of other seeds.
"""

import argparse
import json
import os
import resource
import time
from functools import partial
from pathlib import Path

import numpy as np

from toftools.bench.run import machine, versions
from toftools.sensors import sensor
from toftools.sim import _space_time
from toftools.sim.space_time import space_time
from toftools.transient import phasors
from toftools.types import Scene, Shot
from toftools.units import phase_to_range

BOX, FREQ_HZ = Scene("cornell", {}), 20e6
PAPER = {"seconds": 27.98, "machine": "GTX 1060", "pixels": 1024, "frames": 250, "lights": 128**2}
AXIS = {"bin_m": 0.04, "n_bins": 250}


def camera(side):
    return sensor(f"deeptof:width={side},height={side},hfov_deg=39.3077")


def timed(call):
    begin = time.perf_counter()
    made = call()
    return made, time.perf_counter() - begin


def error_mm(made, truth):
    """Root mean square and median error of range, mm."""
    turned = phasors(made, [FREQ_HZ])[0] * np.conj(truth)
    off = 1e3 * np.asarray(phase_to_range(np.angle(turned), FREQ_HZ))
    off = np.abs(off[np.abs(truth) > 0])
    return {"rms_mm": float(np.sqrt((off**2).mean())), "median_mm": float(np.median(off))}


def box(shot, gpu, **axis):
    return space_time(BOX, shot, **{**AXIS, **axis}, gpu=gpu)


def paper_setting(side, gpu):
    """The paper's largest case, once; the first call of a small image has built the kernels."""
    shot = Shot(camera(side), samples=PAPER["lights"], max_bounces=1)
    box(Shot(camera(64), samples=PAPER["lights"], max_bounces=1), gpu)
    made, seconds = timed(lambda: box(shot, gpu))
    pairs = side**2 * made.info["virtual_lights"]
    return {
        "pixels": side, "frames": AXIS["n_bins"], "seconds": seconds,
        "virtual_lights": made.info["virtual_lights"], "camera_paths": made.info["camera_paths"],
        "pairs_per_s": pairs / seconds,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }  # fmt: skip


def converged(side, runs, bounces, gpu, **axis):
    """Mean phasor over seeds that nothing else has, and its standard error in mm."""
    shots = [Shot(camera(side), seed=900 + k, samples=1 << 16, max_bounces=bounces)
             for k in range(runs)]  # fmt: skip
    found = [phasors(box(shot, gpu, **axis), [FREQ_HZ])[0] for shot in shots]
    mean = np.mean(found, axis=0)
    off = np.asarray(phase_to_range(np.angle(np.array(found) * np.conj(mean)), FREQ_HZ))
    return mean, 1e3 * float(np.sqrt((off**2).mean() / (runs - 1)))


def lights_study(side, truths, gpu, repeats):
    """Figure 1: number of virtual lights."""
    rows = []
    for bounces, truth in truths.items():
        for per_side in (32, 64, 128):
            shot = Shot(camera(side), samples=per_side**2, max_bounces=bounces)
            done = [timed(lambda s=shot: box(s, gpu)) for _ in range(repeats)]
            row = {"bounces": bounces or "all", "paths": per_side**2}
            row["seconds"] = min(t for _, t in done)
            rows.append(row | error_mm(done[0][0], truth))
    return rows


def range_study(side, truth, gpu, repeats):
    """Figure 4: number of bins over the same 10 m of path, and what they do to the phasor."""
    rows = []
    for bins in (64, 128, 250, 500, 1000, 2000):
        shot = Shot(camera(side), samples=64**2, max_bounces=1)
        call = partial(box, shot, gpu, n_bins=bins, bin_m=10.0 / bins)
        done = [timed(call) for _ in range(repeats)]
        rows.append({"bins": bins, "seconds": min(t for _, t in done),
                     "result_mb": done[0][0].values.nbytes / 1e6,
                     **error_mm(done[0][0], truth)})  # fmt: skip
    return rows


def visibility_study(side, truth, gpu, repeats):
    """Figure 3: shadow rays for every pixel, for every n-th along rows and columns, and for none.

    Where a pixel has no ray of its own it takes the visibility of the first pixel of its n x n
    block: what a shadow test at lower resolution would say. Outside the library, by a gather of
    its own; both have the camera's paths out of the library.
    """
    exact = _space_time.gather
    rows = []
    for every in (1, 2, 4, 8, 0):
        _space_time.gather = exact if every == 1 else partial(coarse_gather, side, every)
        try:
            shot = Shot(camera(side), samples=64**2, max_bounces=1)
            done = [timed(lambda s=shot: box(s, gpu)) for _ in range(repeats)]
        finally:
            _space_time.gather = exact
        rows.append({"ray_per": every, "seconds": min(t for _, t in done),
                     **error_mm(done[0][0], truth)})  # fmt: skip
    return rows


def coarse_gather(side, every, task, first, lights, counts, deposit):
    """`_space_time.gather` with bits of visibility out of fewer rays, made before it."""
    import drjit as dr

    from toftools.sim._second import scatters_alike, up_of

    mi, unit = task.mi, task.stage.unit_m
    order = _space_time._by_blocks((side, side))
    row, column = np.divmod(order, side)
    number = len(lights.light)
    bits = None
    if every:
        place = np.empty(side * side, np.int64)
        place[order] = np.arange(side * side)
        heads = np.flatnonzero((row % every == 0) & (column % every == 0))
        slot = np.empty(side * side, np.uint32)
        slot[heads] = np.arange(heads.size)
        mine = slot[place[row // every * every * side + column // every * every]]
        si = dr.gather(mi.SurfaceInteraction3f, first, mi.UInt32(heads.astype(np.uint32)))
        bits = dr.zeros(mi.UInt8, heads.size * number)
        lane = dr.arange(mi.UInt32, heads.size)

        def look(j):
            there = dr.gather(mi.Point3f, lights.p, j)
            blocked = task.stage.scene.ray_test(si.spawn_ray_to(there), si.is_valid())
            dr.scatter(bits, mi.UInt8(dr.select(blocked, mi.UInt32(1), 0)), lane * number + j)
            return (j + 1,)

        dr.while_loop((mi.UInt32(0),), lambda j: j < dr.opaque(mi.UInt32, number), look)
        dr.eval(bits)
        mine = mi.UInt32(mine)
    up, alike, lanes = up_of(first), scatters_alike(mi, first), dr.arange(mi.UInt32, side * side)
    albedo = first.bsdf().eval_diffuse_reflectance(first, alike)[0] * dr.inv_pi
    range_m = first.t * unit
    dr.eval(up, alike, albedo, range_m)

    def body(j, counts):
        there = dr.gather(type(lights), lights, j)
        away = there.p - first.p
        square = dr.squared_norm(away)
        leg = dr.maximum(dr.dot(up, away), 0) * dr.maximum(-dr.dot(there.n, away), 0)
        leg /= dr.square(square) * unit**2
        value = albedo * leg * there.light
        value /= 1 + _space_time.RAYS * dr.inv_pi * leg / there.density
        active = alike & (value > 0)
        if bits is not None:
            active &= dr.gather(mi.UInt8, bits, mine * number + j, active) == 0
        path_m = range_m + dr.sqrt(square) * unit + there.path_m
        return j + 1, deposit(counts, lanes, j, there.bounce, dr.select(active, value, 0), path_m)

    limit = dr.opaque(mi.UInt32, number)
    return dr.while_loop((mi.UInt32(0), counts), lambda j, _: j < limit, body)[1]


def draw(found, path):
    """Error against time of every study."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for bounces in ("all", 1):
        rows = [r for r in found["lights"] if r["bounces"] == bounces]
        axes[0].loglog([r["seconds"] for r in rows], [r["rms_mm"] for r in rows], "o-",
                       label=f"bounces: {bounces}")  # fmt: skip
        for r in rows:
            axes[0].annotate(str(r["paths"]), (r["seconds"], r["rms_mm"]))
    axes[0].set_title("virtual lights (light subpaths)")
    axes[0].legend()
    rows = found["range"]
    axes[1].loglog([r["bins"] for r in rows], [r["rms_mm"] for r in rows], "o-", label="error")
    axes[1].set(title="bins over 10 m of path", xlabel="bins")
    twin = axes[1].twinx()
    twin.plot([r["bins"] for r in rows], [r["seconds"] for r in rows], "s--", color="tab:orange")
    twin.set_ylabel("seconds (dashed)")
    for r in found["visibility"]:
        name = {0: "none", 1: "exact"}.get(r["ray_per"], f"every {r['ray_per']}")
        axes[2].loglog(r["seconds"], r["rms_mm"], "o")
        axes[2].annotate(name, (r["seconds"], r["rms_mm"]))
    axes[2].set_title("visibility tested at pixels")
    for ax in (axes[0], axes[2]):
        ax.set_xlabel("seconds")
    for ax in axes:
        ax.set_ylabel("rms error of range at 20 MHz, mm")
        ax.grid(visible=True, which="both", alpha=0.3)
    figure.savefig(path, dpi=110)


def table(rows):
    names = list(rows[0])
    lines = ["| " + " | ".join(names) + " |", "|" + "---:|" * len(names)]
    for row in rows:
        cells = (f"{v:.3f}" if isinstance(v, float) else str(v) for v in row.values())
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def text(found):
    big, load, cpu = found["paper"], found["load"], found["machine"]
    errors = ", ".join(f"{name}: {mm:.2f} mm" for name, mm in found["reference_mm"].items())
    told = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    bins = AXIS["bin_m"]
    return f"""## Space-time histogram by virtual lights

{told}; {cpu["cpu"]}, {cpu["threads"]} threads; {found["where"]}.

Load average {load[0]:.1f} before and {load[1]:.1f} after the run. Where it is above the number of
threads, other work ran beside it and the times are too long.

### The paper's setting

{big["pixels"]} x {big["pixels"]} pixels, {big["frames"]} bins, one bounce, 128 x 128 light subpaths
({big["virtual_lights"]} of them hit the box), exact visibility and {big["camera_paths"]} camera
paths per pixel for what is near: **{big["seconds"]:.1f} s**, {big["pairs_per_s"] / 1e6:.0f} M pairs
of pixel and light per second, {big["peak_mb"]:.0f} MB at most. The paper: {PAPER["seconds"]} s on a
{PAPER["machine"]}, with imperfect shadow maps of 128 x 128 out of 2000 points and clamping.

### Studies, {found["side"]} x {found["side"]} pixels

Errors of range at 20 MHz against the mean of other seeds at 65,536 light subpaths, whose own
standard error is: {errors} (it is part of every figure below). Both have bins of {bins} m, except
that the study of bins has a reference with bins of 2.5 mm.

Number of light subpaths (figures 1 and 5 of the paper):

{table(found["lights"])}

Bins over 10 m of path, 64 x 64 light subpaths (figure 4). Direct light lies in one bin, so that
wide bins cost range where the histogram is turned into a phasor:

{table(found["range"])}

Visibility, 64 x 64 light subpaths: a ray per pixel (1), one per block of 2, 4 or 8 pixels squared,
none (0). Figure 3 of the paper varies the resolution of its shadow maps instead:

{table(found["visibility"])}

![errors](space_time.png)
"""


def has_gpu():
    import mitsuba as mi

    try:
        mi.set_variant("cuda_ad_mono")
        import drjit as dr

        dr.eval(mi.Float([1.0]) + 1)
    except Exception:  # whatever CUDA says, there is none
        return False
    return True


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--gpu", action="store_true", help="trace on an NVIDIA GPU")
    parser.add_argument("--quick", action="store_true", help="smaller images")
    given = parser.parse_args()
    if given.gpu and not has_gpu():
        parser.error("Dr.Jit finds no GPU here; leave --gpu away")
    side, large, repeats = (32, 128, 1) if given.quick else (48, PAPER["pixels"], 2)
    load = [os.getloadavg()[0]]
    paper = paper_setting(large, given.gpu)
    references = {b: converged(side, 4 if given.quick else 6, b, given.gpu) for b in (1, None)}
    truths = {b: mean for b, (mean, _) in references.items()}
    fine, _ = converged(side, 2, 1, given.gpu, n_bins=4000, bin_m=0.0025)
    found = {
        "lights": lights_study(side, truths, given.gpu, repeats),
        "range": range_study(side, fine, given.gpu, repeats),
        "visibility": visibility_study(side, truths[1], given.gpu, repeats),
        "paper": paper,
        "side": side,
        "reference_mm": {f"{b or 'all'} bounce(s)": mm for b, (_, mm) in references.items()},
        "versions": versions(),
        "machine": machine(os.cpu_count() or 1),
        "where": "GPU" if given.gpu else "CPU, no GPU used",
        "load": [*load, os.getloadavg()[0]],
        "paper_said": PAPER,
    }
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "space_time.json").write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    (given.out / "space_time.md").write_text(text(found), "utf-8")
    draw(found, given.out / "space_time.png")


if __name__ == "__main__":
    main()
