"""Diffuse light between surfaces: what the methods leave of it, against bounces and albedo."""

import importlib
import time

import numpy as np
from correction_methods import (
    Answer,
    answer,
    methods,
    number,
    plain,
    sentences,
    table,
    timed,
)
from correction_scenes import (
    ALBEDOS,
    SAMPLES,
    SENSORS,
    by_bounces,
    corner_once,
    living_room,
    rendered,
    seen_by,
    sweep,
)

from toftools import registry
from toftools.phasor import phasors_of

SIZE, FULL, FULL_SAMPLES = (160, 120), (320, 240), 64
PRODUCTION, BRUTE = "fuchs2010", "fuchs2010_all_pairs"
END_M = 10.0  # every scene ends before, and methods that ask are told
BUDGET_S = 1.5


def transport_methods(job, sensor, phasors):
    """Those that say how much indirect light they took away, and what to hold them against."""
    found, refused = [], {}
    plain = "single" if sensor.modulation.n_freqs == 1 else "crt"
    for method in methods(job, max_range_m=END_M):
        if method.name in (plain, "auto"):
            found.append(method)
            continue
        probe = answer(job, method, sensor, phasors, budget_s=0.0)
        if isinstance(probe, str):
            refused[method.label] = probe
        elif "indirect" in probe.depth.info:
            found.append(method)
    return found, refused


def figures(job, method, capture):
    """Error of a method on a capture and its share of pixels that fell back, or a sentence."""
    found = answer(job, method, capture.sensor, phasors_of(capture), budget_s=BUDGET_S)
    if not isinstance(found, Answer):
        return found
    cut = (slice(None, None, found.stride),) * 2
    error = found.depth.range_m - capture.truth.range_m[cut]
    error = error[np.isfinite(error)]
    if not error.size:
        return "no answer"
    return {"mae_m": np.abs(error).mean(), "median_m": np.median(np.abs(error)),
            "bias_m": error.mean(), "fallback": fallback_share(found.depth),
            "valid": error.size / found.depth.range_m.size, "stride": found.stride}  # fmt: skip


def fallback_share(depth):
    """Share of the pixels where a method says that it fell back; None if it does not say."""
    for key in ("fallback", "diverged", "fell_back"):
        if key in depth.info:
            return float(np.mean(depth.info[key]))
    return None


def over_albedo(job, size):
    """{sensor: {scene: {method: [figures per albedo]}}}."""
    found, refused = {}, {}
    albedos = ALBEDOS[1::3] if job.quick else ALBEDOS
    for name, which in SENSORS.items():
        first = seen_by(corner_once(job, size)(0.5), which)
        chosen, why = transport_methods(job, first.sensor, phasors_of(first))
        refused |= {f"{label} ({name})": text for label, text in why.items()}
        found[name] = {}
        for title, at in sweep(job, size).items():
            job.log(f"albedo, {name}: {title}")
            captures = [seen_by(at(albedo), which) for albedo in albedos]
            rows = {m.label: [figures(job, m, c) for c in captures] for m in chosen}
            found[name][title] = {
                label: line for label, line in rows.items() if isinstance(line[0], dict)
            }
    return {"albedos": albedos, "found": found, "refused": refused}


def over_bounces(job, size):
    """{sensor: {scene: {method: {bounces: figures}}}}."""
    found = {}
    scenes = {"corner": "corner", "Cornell box": "cornell"}
    if living_room() and not job.quick:
        scenes["living room"] = "living"
    for name, which in list(SENSORS.items())[-1 if job.quick else 0 :]:
        for title, scene in list(scenes.items())[: 1 if job.quick else None]:
            job.log(f"bounces, {name}: {title}")
            captures = {label: seen_by(capture, which)
                        for label, capture in by_bounces(job, scene, size).items()}  # fmt: skip
            one = captures["all"]
            chosen, _ = transport_methods(job, one.sensor, phasors_of(one))
            found.setdefault(name, {})[title] = {
                method.label: {label: figures(job, method, c) for label, c in captures.items()}
                for method in chosen
            }
    return found


def production(job, size):
    """Every tolerance of the production version against the brute force: time and difference."""
    if PRODUCTION not in registry.CORRECTIONS or BRUTE not in registry.CORRECTIONS:
        return {"missing": f"`{PRODUCTION}` and `{BRUTE}` are not both in the registry."}
    tolerances = registry.CORRECTIONS[PRODUCTION].grid.get("tol_mm", ())
    found = {}
    scenes = {"corner": "corner", "Cornell box": "cornell"}
    if living_room() and not job.quick:
        scenes["living room"] = "living"
    for name, which in list(SENSORS.items())[-1 if job.quick else 0 :]:
        for title, scene in list(scenes.items())[: 1 if job.quick else None]:
            job.log(f"production, {name}: {title}")
            capture = seen_by(rendered(job, scene, size, samples=FULL_SAMPLES), which)
            found[f"{title}, {name}"] = compared(capture, tolerances)
    return {"size": size, "found": found, "rate": kernel_rate(job.quick)}


def compared(capture, tolerances):
    """Lines of one scene; differences are those where both answer."""
    phasors, truth = phasors_of(capture), capture.truth.range_m

    def line(label, run, **how):
        depth, ms = timed(run, phasors, **how)
        return depth, {"label": label, "ms": ms, "fallback": fallback_share(depth),
                       "mae_m": np.nanmean(np.abs(depth.range_m - truth))}  # fmt: skip

    table_of = registry.CORRECTIONS
    brute, first = line(BRUTE, table_of[BRUTE].build(capture.sensor), repeats=1)
    rows = [first]
    for tol_mm in tolerances:
        run = table_of[PRODUCTION].build(capture.sensor, tol_mm=tol_mm)
        depth, row = line(f"{PRODUCTION}:tol_mm={tol_mm:g}", run, repeats=20, spend_s=1.0)
        gap = depth.range_m - brute.range_m
        gap = gap[np.isfinite(gap)].astype(float)
        rows.append(
            {**row, "rms_m": np.sqrt(np.mean(gap**2)), "p99_m": np.quantile(np.abs(gap), 0.99)}
        )
    return rows


def kernel_rate(quick):
    """Pairs per second of the transfer kernel at one frequency."""
    kernel = importlib.import_module("toftools._transfer")
    n = 512 if quick else 76_800 // 4
    rng = np.random.default_rng(0)
    normal = np.tile(np.array([[0.0], [0.0], [1.0]], np.float32), n)
    place = rng.uniform(-1, 1, (3, n)).astype(np.float32)
    area = np.full(n, 1e-4, np.float32)
    here = kernel.Patches(place, normal, area)
    there = kernel.Patches(place + np.float32([[0], [0], [3]]), -normal, area)
    light, freq = np.ones((1, n), np.complex64), np.array([20e6])
    kernel.gather(here, there, light, freq)
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        kernel.gather(here, there, light, freq)
        times.append(time.perf_counter() - begin)
    return {"pairs": n * n, "gpairs_s": n * n / min(times) / 1e9}


def measure(job):
    size = (32, 24) if job.quick else SIZE
    return plain({
        "size": size,
        "albedo": over_albedo(job, size),
        "bounces": over_bounces(job, size),
        "production": production(job, size if job.quick else FULL),
    })  # fmt: skip


def write(result, folder):
    from correction_draw import lines_figure

    albedos, found = result["albedo"]["albedos"], result["albedo"]["found"]
    panels = [
        (f"{title}, {name}",
         {label: (albedos, [row["median_m"] and 1e3 * row["median_m"] for row in rows])
          for label, rows in lines.items()})
        for title in next(iter(found.values()))
        for name, scenes in found.items()
        for lines in [scenes[title]]
    ]  # fmt: skip
    lines_figure(panels, folder / "albedo", xlabel="albedo", ylabel="median absolute error, mm")
    width, height = result["size"]
    parts = [
        f"Light without noise at {width} x {height}, of the flash at the camera; the first surface "
        "is the truth. The closed-form corner has one bounce, the closed-form cavity (a sphere "
        "seen from its centre, of which the camera sees a part) all of them; the rest is path "
        f"traced, {SAMPLES} paths a pixel, whose noise is part of the errors below. Which methods "
        "take part is asked of the registry: those that say which light was indirect, and beside "
        f"them `single` or `crt`, and `auto`. All scenes end within {END_M:g} m, and methods that "
        "ask are told so. Slow methods ran on fewer pixels.",
        "### Albedo",
        "Median error, which wrong wraps of less than half the pixels do not move.",
        "![Error against albedo](albedo.png)",
        "Share of the pixels that fell back to the uncorrected answer, %:",
        fallback_table(result["albedo"]),
        "### Bounces: mean absolute error (median), mm",
        bounce_table(result["bounces"]),
        "### Production against brute force",
        production_text(result["production"]),
    ]
    parts.append(sentences(result["albedo"]["refused"]))
    return "\n\n".join(part for part in parts if part)


def fallback_table(result):
    rows = [[f"{title}, {name}", f"`{label}`",
             *(number(row["fallback"], ".0f", 100) for row in line)]
            for name, scenes in result["found"].items() for title, lines in scenes.items()
            for label, line in lines.items() if line[0]["fallback"] is not None]  # fmt: skip
    head = ["scene", "method", *(f"albedo {a:g}" for a in result["albedos"])]
    return table(head, rows) if rows else "(No method here says so.)"


def bounce_table(result):
    rows, bounces = [], []
    for name, scenes in result.items():
        for title, lines in scenes.items():
            for label, line in lines.items():
                bounces = list(line)
                cells = [f"{number(f['mae_m'], '.1f', 1e3)} ({number(f['median_m'], '.1f', 1e3)})"
                         if isinstance(f, dict) else "–" for f in line.values()]  # fmt: skip
                if any(cell != "–" for cell in cells):
                    rows.append([f"{title}, {name}", f"`{label}`", *cells])
    return table(["scene", "method", *bounces], rows)


def production_text(result):
    if "missing" in result:
        return result["missing"]
    rows = [[title, f"`{row['label']}`", number(row["ms"], ".1f"),
             number(row.get("rms_m"), ".2f", 1e3), number(row.get("p99_m"), ".2f", 1e3),
             number(row["mae_m"], ".1f", 1e3), number(row["fallback"], ".1f", 100)]
            for title, lines in result["found"].items() for row in lines]  # fmt: skip
    head = ["scene", "method", "ms a frame", "rms to brute force mm", "99 % mm", "MAE mm",
            "fell back %"]  # fmt: skip
    width, height = result["size"]
    rate = result["rate"]
    text = (f"{width} x {height} pixels, all bounces. The kernel alone: {rate['pairs']:.3g} pairs "
            f"at {rate['gpairs_s']:.2f} thousand million a second and frequency.")  # fmt: skip
    return f"{text}\n\n{table(head, rows)}"
