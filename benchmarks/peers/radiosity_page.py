"""The page on what the radiosity engine costs and how far its tolerance holds, out of JSON.

Each of the three scripts saves its own figures, ``radiosity_NAME.json``, and the page shows those
that are there.
"""

import json
from dataclasses import asdict, is_dataclass

import numpy as np

from .report import table

HEAD = "# Radiosity: error, time and tolerance"


def save(folder, name, data):
    """Write ``radiosity_NAME.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(data, indent=1, default=_value)
    (folder / f"radiosity_{name}.json").write_text(text + "\n", encoding="utf-8")


def _value(thing):
    if is_dataclass(thing):
        return asdict(thing)
    if isinstance(thing, np.generic):
        return thing.item()
    raise TypeError(f"cannot write {type(thing).__name__} as JSON")


def write(folder):
    """Write ``radiosity.md`` out of what is saved."""
    parts = [HEAD]
    for name, section in (("time", of_time), ("seeds", of_seeds), ("throughput", of_throughput)):
        file = folder / f"radiosity_{name}.json"
        if file.is_file():
            parts.append(section(json.loads(file.read_text(encoding="utf-8"))))
    (folder / "radiosity.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def about_line(about):
    names = ", ".join(f"{k} {v}" for k, v in about["versions"].items())
    machine = about["machine"]
    return (
        f"{names}; {machine['cpu']}, {machine['threads']} threads; "
        f"the run took {about['seconds']:.0f} s."
    )


def of_time(data):
    """Error against time."""
    parts = [
        "## Time to 1 mm",
        about_line(data["about"]),
        *(f"Note: {text}." for text in data["about"]["missing"]),
        "Range error at the centres of pixels away from depth edges, root mean square, free of the "
        "reference's own noise; times of one frame, warm. `radiosity` is given a tolerance, the "
        "others a number of samples per pixel. Beyond the last measured point errors are taken to "
        "fall as 1/sqrt(time), which the picture shows dashed. Such a time says less the further "
        "it is from what was measured, and is too long for `path`, whose error falls faster.",
        "![Error against time](radiosity_time.png)",
        reach_table(data["views"]),
    ]
    for view in data["views"]:
        parts.append(f"### {view['view']['name']}")
        parts.append(reference_line(view))
        parts.append(points_table(view["points"]))
    return "\n\n".join(parts)


def reach_table(views):
    engines = list(dict.fromkeys(name for view in views for name in view["reach"]))
    head = ["seconds to 1 mm rms"]
    for name in engines:
        head += [name] if name == "radiosity" else [name, "times radiosity"]
    rows = []
    for view in views:
        row = [view["view"]["name"]]
        for name in engines:
            found = view["reach"].get(name)
            row.append(f"{found['seconds']:.3g}, {found['how']}" if found else "-")
            if name != "radiosity":
                ratio = view["speedup"].get(name)
                row.append(f"{ratio:.0f}" if ratio else "-")
        rows.append(row)
    return table(head, [*rows, *rooms_row(views, engines)])


def rooms_row(views, engines):
    """Geometric mean of the ratios over the rooms."""
    rooms = [v for v in views if v["view"]["name"].startswith("Room")]
    if len(rooms) < 2:
        return []
    row = ["geometric mean of the rooms"]
    for name in engines:
        if name == "radiosity":
            row.append("")
            continue
        ratios = [v["speedup"][name] for v in rooms if name in v["speedup"]]
        mean = np.exp(np.mean(np.log(ratios))) if ratios else np.nan
        row += ["", f"{mean:.0f} ({min(ratios):.0f} to {max(ratios):.0f})" if ratios else "-"]
    return [row]


def reference_line(view):
    ref, size = view["reference"], view["view"]["size"]
    return (
        f"`{view['view']['scene'].partition(':lamps')[0]}`, {size[0]} x {size[1]}, "
        f"{view['view']['bounces']} indirect bounces"
        f"{' (`radiosity`: all)' if view['view']['solved'] else ''}, {view['pixels']} pixels; "
        f"reference: {ref['samples']} paths per pixel, {ref['seconds']:.0f} s, standard error "
        f"{ref['standard_error_mm']:.2f} mm rms."
    )


def points_table(points):
    head = ["engine", "setting", "s", "first call, s", "rms, mm", "median, mm", "peak MB"]
    rows = []
    for name, found in points.items():
        for p in found:
            square = float(np.mean(p["mean_square_m2"]))
            known = square > 4 * p["floor_m2"]
            error = f"{1e3 * square**0.5:.2f}" if known else "below the reference's noise"
            setting = f"{p['samples']:g} mm" if name == "radiosity" else str(p["samples"])
            rows.append([
                name, setting, f"{min(p['seconds']):.3f}", f"{p['first_s']:.2f}", error,
                f"{1e3 * np.mean(p['median_m']):.2f}", f"{p['peak_mb']:.0f}",
            ])  # fmt: skip
    return table(head, rows)


def of_seeds(data):
    """Whether the tolerance holds, and cost against pixels."""
    share, low, high = data["share"], *data["interval"]
    earlier = data["about"]["earlier"]
    parts = [
        "## Whether the tolerance holds",
        about_line(data["about"]),
        *(
            [f"{earlier} of the scenes were judged before, and are not in that time."]
            * (earlier > 0)
        ),
        f"{data['count']} seeded scenes at a tolerance of {data['tol_mm']:g} mm: the actual error, "
        f"root mean square over the image, is below it in **{100 * share:.1f} %** of them "
        f"(95 % interval {100 * low:.1f} to {100 * high:.1f} %).",
        "![Actual errors](radiosity_seeds.png)",
        seeds_table(data["families"]),
    ]
    if data["worst"]:
        parts += ["The worst:", worst_table(data["worst"])]
    if data["cost"]:
        parts += ["## Cost against pixels", cost_text(data), cost_table(data["cost"])]
    return "\n\n".join(parts)


def seeds_table(families):
    head = ["scenes", "held against", "number", "within", "median rms, mm", "largest, mm",
            "bias, mm", "s per scene"]  # fmt: skip
    rows = [
        [f["family"], f["against"], str(f["count"]), f"{f['within']} of {f['count']}",
         f"{f['median_mm']:.3f}", f"{f['largest_mm']:.3f}", f"{f['bias_mm']:+.3f}",
         f"{f['seconds']:.2f}"]
        for f in families
    ]  # fmt: skip
    return table(head, rows)


def worst_table(worst):
    head = ["scene", "sensor", "rms, mm", "its s.e.", "told, mm"]
    rows = [
        [f"`{w['scene']}`", f"`{w['sensor']}`", f"{w['rms_mm']:.2f}", f"{w['se_mm']:.2f}",
         "-" if w["told_mm"] is None else f"{w['told_mm']:.2f}"]
        for w in worst
    ]  # fmt: skip
    return table(head, rows)


def cost_text(data):
    found = ", ".join(f"{name}: pixels^{e:.2f}" for name, e in data["exponents"].items())
    return (
        f"At a tolerance of {data['tol_mm']:g} mm time grows as {found} (least squares over all "
        "sizes), where 1 would be in proportion."
    )


def cost_table(cost):
    head = ["scene", "size", "s", "us per pixel", "virtual lights"]
    rows = [
        [c["scene"], f"{c['size'][0]} x {c['size'][1]}", f"{c['seconds']:.2f}",
         f"{1e6 * c['seconds'] / (c['size'][0] * c['size'][1]):.2f}", str(c["lights"])]
        for c in cost
    ]  # fmt: skip
    return table(head, rows)


def of_throughput(data):
    """Captures per minute."""
    head = ["engine", "tolerance, mm", "s per capture", "captures per minute", "captures timed",
            "told error, mm", "within the tolerance"]  # fmt: skip
    rows = []
    for r in data["rows"]:
        told = "-" if r["told_mm"] is None else f"{r['told_mm']:.2f}"
        timed = str(r["count"]) if r["measured"] else "none, extrapolated"
        rate, within = f"{60 / r['seconds']:.2f}", "yes" if r["within"] else "no"
        took = f"{r['seconds']:.2f}"
        rows.append([r["engine"], f"{r['tol_mm']:g}", took, rate, timed, told, within])
    gains = ", ".join(f"{g:.0f} times at {tol} mm" for tol, g in data["gain"].items())
    parts = [
        "## Captures of a data set",
        about_line(data["about"]),
        f"{data['recipe']} After the first capture, which builds kernels, `radiosity` makes "
        f"{gains} as many captures as `path`. The tolerance of `radiosity` is that of the image, "
        "of `path` that of its worst tile; `path` stops at its limit of samples all the same.",
        table(head, rows),
    ]
    return "\n\n".join(parts)
