"""`auto`: changes nothing where there is no multipath, and is never clearly worse elsewhere."""

import numpy as np
from correction_frames import HINTS, SU_HINTS, first_set, scored, su_frames
from correction_methods import Answer, Method, answer, built, number, table
from correction_scenes import SENSORS, corner_once, living_room, rendered, seen_by

from toftools import registry
from toftools.phasor import phasors_of
from toftools.sensors import sensor as preset
from toftools.sim.analytic import analytic
from toftools.sim.path import path
from toftools.types import Scene, Shot

AUTO = "auto"
CLEAN = {
    "wall, 2 m": ("wall", {"range": 2.0}),
    "wall, 6 m, albedo 0.2": ("wall", {"range": 6.0, "albedo": 0.2}),
    "plane tilted by 50 degrees": ("tilted", {"range": 3.0, "tilt": 50.0}),
    "plates, direct light alone": ("plates", {}),
}
CAMERAS = ("opt8241", "kinect2_nominal", "deeptof:freqs=20e6+40e6+60e6+80e6+100e6")
WORSE, OPEN_SHARE = 1.15, 0.9
SIZE = (160, 120)


def without_multipath(job):
    """Mean absolute change against crt, with and without noise."""
    rows = []
    method, plain = Method(AUTO), Method("crt")
    size = (32, 24) if job.quick else SIZE
    for text in CAMERAS[: 1 if job.quick else None]:
        comma = "," if ":" in text else ":"
        sensor = preset(f"{text}{comma}width={size[0]},height={size[1]}")
        for title, (scene, params) in list(CLEAN.items())[: 2 if job.quick else None]:
            make = path if scene == "plates" else analytic
            run = make(Scene(scene, params))
            for noisy in (False, True):
                bounces = 0 if scene == "plates" else None
                shot = run(Shot(sensor, seed=1, noisy=noisy, max_bounces=bounces))
                rows.append({"sensor": text, "scene": title, "noisy": noisy,
                             **change(job, method, plain, shot)})  # fmt: skip
    return rows


def change(job, method, plain, capture):
    """How far two methods are apart on a capture."""
    phasors = phasors_of(capture)
    run, other = (built(job, m, capture.sensor) for m in (method, plain))
    if isinstance(run, str):
        return {"unsuited": run}
    one, two = run(phasors), other(phasors)
    gap = np.abs(one.range_m.astype(float) - two.range_m)
    both = np.isfinite(gap)
    lost = np.isfinite(two.range_m) & ~np.isfinite(one.range_m)
    return {"change_m": gap[both].mean(), "share_above_1cm": (gap[both] > 0.01).mean(),
            "lost": lost.mean()}  # fmt: skip


def diffuse(job):
    """The captures of the section on diffuse light that `auto` is held against."""
    size = (32, 24) if job.quick else SIZE
    found = {"corner, one bounce": corner_once(job, size)(0.8)}
    if not job.quick:
        found["Cornell box"] = rendered(job, "cornell", size)
        if living_room():
            found["living room"] = rendered(job, "living", size)
    which = SENSORS["40 + 70 MHz"]
    two = {f"{name}, 40 + 70 MHz": seen_by(capture, which) for name, capture in found.items()}
    return {**two, **{f"{name}, 20 + 40 + 70 MHz": c for name, c in found.items()}}


def rivals(rows):
    """{capture: {method: row}} of those that answered."""
    found = {}
    for row in rows:
        if "mae_m" in row:
            found.setdefault(row["capture"], {})[row["name"]] = row
    return found


def verdicts(rows):
    """Per capture: error of `auto`, of the best other method with as many pixels, and of crt."""
    found = []
    for capture, answers in rivals(rows).items():
        if AUTO not in answers:
            continue
        auto, plain = answers[AUTO], answers.get("crt")
        least = OPEN_SHARE * (plain or auto)["valid"]
        others = [r for name, r in answers.items()
                  if name != AUTO and r["valid"] >= least and r["mae_m"] is not None]  # fmt: skip
        best = min(others, key=lambda r: r["mae_m"], default=None)
        found.append({
            "capture": capture, "auto_m": auto["mae_m"], "best": best and best["method"],
            "best_m": best and best["mae_m"], "crt_m": plain and plain["mae_m"],
        })  # fmt: skip
    return found


def maps(job, captures):
    """Picture of the models chosen; names of the captures shown."""
    from correction_draw import model_maps

    shown, names = [], []
    for name, capture in captures.items():
        found = answer(job, Method(AUTO, {}), capture.sensor, phasors_of(capture), budget_s=5.0)
        if isinstance(found, Answer) and "model" in found.depth.info:
            info = found.depth.info
            names = [str(n) for n in info.get("models", ())] or names
            shown.append((name, np.asarray(info["model"])))
    if shown:
        most = 1 + max(int(codes.max()) for _, codes in shown)
        names = [*names, *(f"model {i}" for i in range(len(names), most))]
        model_maps(shown, names, job.folder / "auto_models")
    return [name for name, _ in shown]


def measure(job):
    if AUTO not in registry.CORRECTIONS:
        return {"missing": "There is no `auto` in the registry yet."}
    own, others, mixed = first_set(job), su_frames(job), diffuse(job)
    rows = scored(job, own, **HINTS)
    rows = rows + scored(job, others, **SU_HINTS) + scored(job, mixed, **HINTS)
    room = {name: capture for name, capture in own.items() if name.startswith("room")}
    pictures = {**mixed, **dict(list(room.items())[:1]), **dict(list(others.items())[:1])}
    return {"clean": without_multipath(job), "verdicts": verdicts(rows),
            "maps": maps(job, pictures)}  # fmt: skip


def write(result, folder):
    if "missing" in result:
        return result["missing"]
    clean = [[f"{row['scene']}, {row['sensor']}", "yes" if row["noisy"] else "no",
              number(row.get("change_m"), ".3f", 1e3),
              number(row.get("share_above_1cm"), ".2f", 100), number(row.get("lost"), ".2f", 100)]
             for row in result["clean"]]  # fmt: skip
    reasons = dict.fromkeys(row["unsuited"] for row in result["clean"] if "unsuited" in row)
    parts = [
        "\n".join(f"- `{AUTO}` does not suit a sensor: {why}" for why in reasons),
        "### No multipath: change against `crt`",
        table(["capture", "noise", "mean change mm", "above 1 cm %", "not answered %"], clean),
        "### Against every other method",
        "The best other method is that with the least mean absolute error among those that answer "
        f"at least {100 * OPEN_SHARE:g} % as many pixels as `crt`, at default parameters, chosen "
        "per capture with the truth in hand.",
        verdict_table(result["verdicts"]),
    ]
    if result["maps"]:
        parts.append("### The model that every pixel got")
        parts.append("![Models chosen](auto_models.png)")
    return "\n\n".join(filter(None, parts))


def verdict_table(verdicts):
    body, worse, below = [], 0, 0
    for row in verdicts:
        to_best = ratio(row["auto_m"], row["best_m"])
        to_plain = ratio(row["auto_m"], row["crt_m"])
        worse += to_best is not None and to_best > WORSE
        below += to_plain is not None and to_plain > 1
        body.append([row["capture"], number(row["auto_m"], ".2f", 100),
                     f"`{row['best']}` {number(row['best_m'], '.2f', 100)}", number(to_best),
                     number(row["crt_m"], ".2f", 100), number(to_plain)])  # fmt: skip
    head = ["capture", "auto: MAE cm", "best other: MAE cm", "auto / best", "crt: MAE cm",
            "auto / crt"]  # fmt: skip
    note = (f"More than {100 * (WORSE - 1):.0f} % above the best: {worse} of {len(verdicts)}; "
            f"above `crt`: {below} of {len(verdicts)}.")  # fmt: skip
    return f"{table(head, body)}\n\n{note}"


def ratio(one, other):
    return None if one is None or not other else one / other
