"""Real captures without independent truth: only what a method must satisfy whatever the scene.

Frequencies must agree once indirect light is taken away; walls must be flat; and noise must not
grow more than the method says. Cameras are only roughly known, so no angle or length is judged.
"""

import numpy as np
from correction_frames import SU_HINTS, data_folder
from correction_methods import Answer, answer, built, decimated, methods, number, sentences, table

from toftools._native import import_open3d
from toftools.camera import points
from toftools.io.open import open_capture
from toftools.phasor import phasors_of
from toftools.registry import CORRECTIONS
from toftools.types import Phasors
from toftools.units import phase_to_range, range_to_phase

MELEXIS = "snapshot_lidar_mlx75027_60MHz/CVPRScene_phase0_avg.npy"
PLANE_M, PLANE_SHARE, MOST_PLANES = 0.03, 0.06, 4
KEPT = 0.95
REPEATS, NOISE_STRIDE, TYPICAL_E = 8, 4, 1000.0
BUDGET_S = 1.5


def captures(job):
    """Real captures by name."""
    folder = data_folder()
    if folder is None:
        return {}
    files = sorted((folder / "su2018_tintin_40_70MHz").glob("im_pair_*.mat"))
    names = ("person and bicycle", "office chair")
    found = {f"OPT8241, {n}": open_capture(f) for n, f in zip(names, files, strict=False)}
    if (folder / MELEXIS).is_file() and not job.quick:
        scene = open_capture(folder / MELEXIS, "melexis_npy:offset_m=-1.105")
        found["MLX75027, 60 MHz"] = scene
    return dict(list(found.items())[: 1 if job.quick else None])


def plain_range(capture):
    """One return, as the planes are looked for."""
    name = "crt" if capture.sensor.modulation.n_freqs > 1 else "single"
    hints = {"max_range_m": 10.0} if name == "crt" else {}
    return CORRECTIONS[name].build(capture.sensor, **hints)(phasors_of(capture)).range_m


def planes(camera, range_m):
    """Label image: 0 for none, 1.. for the large planes of a range image (RANSAC of Open3D)."""
    o3d = import_open3d()
    o3d.utility.random.seed(0)
    at = points(camera, range_m)
    labels = np.zeros(camera.shape, np.int8)
    for label in range(1, MOST_PLANES + 1):
        left = np.flatnonzero(np.isfinite(at).all(axis=-1) & (labels == 0))
        if left.size < PLANE_SHARE * labels.size:
            break
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(at.reshape(-1, 3)[left]))
        _, inside = cloud.segment_plane(PLANE_M, 3, 500)
        if len(inside) < PLANE_SHARE * labels.size:
            break
        labels.reshape(-1)[left[inside]] = label
    return labels


def flatness_m(camera, range_m, labels):
    """Root mean square distance to the refitted plane, of the best 95 % of each plane's pixels."""
    at = points(camera, range_m)
    found = []
    for label in range(1, int(labels.max()) + 1):
        cloud = at[(labels == label) & np.isfinite(at).all(axis=-1)].astype(float)
        if len(cloud) < 20:
            continue
        best = cloud
        for _ in range(4):
            centre = best.mean(axis=0)
            normal = np.linalg.eigh((best - centre).T @ (best - centre))[1][:, 0]
            off = np.abs((cloud - centre) @ normal)
            best = cloud[off <= np.quantile(off, KEPT)]
        nearest = np.sort(off)[: int(KEPT * off.size)]
        found.append(np.sqrt(np.mean(nearest**2)))
    return float(np.mean(found)) if found else np.nan


def direct_light(sensor, values, depth):
    """Phasors less what the method takes for indirect; None if it does not say."""
    info = depth.info
    if "indirect" in info and np.shape(info["indirect"]) == values.shape:
        return values - info["indirect"]
    if "ranges_m" in info and "amplitudes" in info:
        freqs = sensor.modulation.freqs_hz[:, None, None, None]
        turn = np.exp(1j * range_to_phase(np.nan_to_num(info["ranges_m"][1:]), freqs))
        return values - np.sum(info["amplitudes"][1:] * turn, axis=1)
    return None


def disagreement_m(sensor, values, range_m):
    """Median distance between the ranges of the first two frequencies, wraps those of range_m."""
    freqs = sensor.modulation.freqs_hz[:2, None, None]
    off = np.angle(values[:2] * np.exp(-1j * range_to_phase(range_m.astype(float), freqs)))
    one, other = phase_to_range(off, freqs)
    return float(np.nanmedian(np.abs(one - other)))


def noise(job, method, capture):
    """Standard deviation over simulated repeats, mm, and its ratio to the sigma that is claimed."""
    sensor, whole = capture.sensor, phasors_of(capture)
    sensor, seen = decimated(sensor, whole, NOISE_STRIDE)
    run = built(job, method, sensor)
    amplitude = np.abs(seen.values)
    values = seen.values * (TYPICAL_E / np.median(amplitude[:, seen.valid]))
    noise = sensor.noise
    offset = np.abs(values) / np.mean(noise.contrast)
    sigma = np.sqrt(2 * (offset + noise.read_e**2) / sensor.modulation.n_taps)
    answers, claimed = [], []
    for seed in range(2 if job.quick else REPEATS):
        rng = np.random.default_rng(seed)
        grain = rng.normal(size=(*values.shape, 2)) @ [1, 1j]
        noisy = (values + sigma * grain).astype(np.complex64)
        depth = run(Phasors(noisy, sigma.astype(np.float32), seen.valid))
        answers.append(depth.range_m)
        claimed.append(depth.sigma_m)
    stack = np.array(answers, float)
    whole = np.isfinite(stack).all(axis=0)
    if not whole.any():
        return np.nan, np.nan
    spread = stack[:, whole].std(axis=0, ddof=1)
    if claimed[0] is None:
        return np.median(spread), np.nan
    told = np.mean(np.array(claimed, float), axis=0)[whole]
    return np.median(spread), np.nanmedian(spread / told)


def row_of(job, method, capture, labels):
    """Figures of one method on one capture, or its sentence."""
    phasors = phasors_of(capture)
    found = answer(job, method, capture.sensor, phasors, budget_s=BUDGET_S)
    if not isinstance(found, Answer):
        return found
    sensor, seen = decimated(capture.sensor, phasors, found.stride)
    cut = (slice(None, None, found.stride),) * 2
    depth = found.depth
    row = {"ms_frame": found.ms_frame, "stride": found.stride,
           "valid": np.isfinite(depth.range_m)[seen.valid].mean(),
           "flat_m": flatness_m(sensor.camera, depth.range_m, labels[cut])}  # fmt: skip
    if sensor.modulation.n_freqs > 1:
        direct = direct_light(sensor, seen.values, depth)
        if direct is not None:
            row["after_m"] = disagreement_m(sensor, direct, depth.range_m)
    small = decimated(capture.sensor, phasors, NOISE_STRIDE)[0].camera.shape
    if found.ms_frame * small[0] * small[1] / 76_800 < 1e3:
        row["noise_m"], row["noise_ratio"] = noise(job, method, capture)
    return row


def measure(job):
    found = {}
    for name, capture in captures(job).items():
        plain = plain_range(capture)
        labels = planes(capture.sensor.camera, plain)
        before = None
        if capture.sensor.modulation.n_freqs > 1:
            before = disagreement_m(capture.sensor, phasors_of(capture).values, plain)
        sizes = [float((labels == i).mean()) for i in range(1, int(labels.max()) + 1)]
        kept, refused = {}, {}
        for method in methods(job, **SU_HINTS):
            job.log(f"{name}: {method.label}")
            row = row_of(job, method, capture, labels)
            (refused if isinstance(row, str) else kept)[method.label] = row
        found[name] = {"planes": sizes, "before_m": before, "rows": kept, "unsuited": refused}
    return {"captures": found} if found else {"missing": "Left out: TOFTOOLS_DATA is not set."}


def write(result, folder):
    if "missing" in result:
        return result["missing"]
    parts = [
        "None of these captures has independent truth, and there is one frame of each. *d40 - "
        "d70*: median distance between the ranges of the two frequencies, before and after the "
        "method takes away what it calls indirect (its `info`; a dash: it does not say). A sparse "
        "method fits both frequencies, so its figure is a residual and no proof. *Planes*: found "
        "once by "
        f"RANSAC ({1e2 * PLANE_M:g} cm) in the single-return cloud; rms distance to a plane fitted "
        f"anew to each answer, best {100 * KEPT:g} % of the pixels, mean over planes. *Noise*: "
        f"simulated, since no set holds repeats: the frame taken for the truth, scaled to a median "
        f"amplitude of {TYPICAL_E:g} e-, {REPEATS} draws of shot and read noise on every fourth "
        "pixel of both directions; median standard deviation, and its median ratio to the sigma "
        "claimed.",
    ]
    head = ["method", "d40 - d70 after, mm", "planes rms mm", "noise mm",
            "noise / sigma", "valid %", "ms per 320 x 240"]  # fmt: skip
    for name, entry in result["captures"].items():
        shares = ", ".join(f"{100 * s:.0f} %" for s in entry["planes"]) or "none found"
        text = f"### {name}\n\nPlanes, share of the pixels: {shares}."
        if entry["before_m"] is not None:
            text += f" d40 - d70 before: {number(entry['before_m'], '.1f', 1e3)} mm."
        parts.append(text)
        rows = [[f"`{label}`", number(row.get("after_m"), ".1f", 1e3),
                 number(row["flat_m"], ".2f", 1e3),
                 number(row.get("noise_m"), ".2f", 1e3), number(row.get("noise_ratio")),
                 number(row["valid"], ".1f", 100), number(row["ms_frame"], ".3g")]
                for label, row in entry["rows"].items()]  # fmt: skip
        parts.append(table(head, rows))
        parts.append(sentences(entry["unsuited"]))
    return "\n\n".join(filter(None, parts))
