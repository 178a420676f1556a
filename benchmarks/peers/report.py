"""Files of the equal-time comparison: every figure as JSON, and the tables that people read."""

import json
from dataclasses import asdict, is_dataclass


def write(folder, about, results, faults):
    """Write ``transport.json`` and ``transport.md``."""
    plain = {"about": about, "cases": [_plain(r) for r in results], "faults": faults}
    text = json.dumps(plain, indent=1, default=_value)
    (folder / "transport.json").write_text(text + "\n", encoding="utf-8")
    parts = [heading(about), *(section(r) for r in results), fault_table(faults)]
    (folder / "transport.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _value(thing):
    if is_dataclass(thing):
        return asdict(thing)
    raise TypeError(f"cannot write {type(thing).__name__} as JSON")


def _plain(result):
    case = result["case"]
    return {**result, "case": {"name": case.name, "sensor": case.sensor(), "samples": case.counts}}


def heading(about):
    machine = about["machine"]
    names = ", ".join(f"{k} {v}" for k, v in about["versions"].items())
    lines = [
        "## Light transport at equal time",
        "",
        f"{names}; {machine['cpu']}, {machine['threads']} threads; {about['max_bounces']} indirect "
        f"bounces; the whole run took {about['seconds']:.0f} s.",
    ]
    return "\n".join(lines + [f"{text}." for text in about["missing"]])


def table(head, rows):
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 1)}"]
    return "\n".join(lines + [f"| {' | '.join(row)} |" for row in rows])


def section(result):
    parts = [f"### {result['case'].name}"]
    for question, curves in result["points"].items():
        parts.append(f"**{question.capitalize()}**: {pixels(result, question)} pixels.")
        parts.append(curve_table(curves, result["slopes"][question]))
        parts.append(ratio_table(result["ratios"][question]))
    parts.append(reference_text(result))
    return "\n\n".join(parts)


def pixels(result, question):
    where = "away from edges" if question == "pixel centre" else "all pixels"
    return result["agreement"][where]["pixels"]


def note(result, question):
    """The line under a panel's title."""
    lines = [f"{r['theirs']}: {r['ratio'].value:.1f} times our mean squared error"
             for r in result["ratios"][question] if r["ratio"]]  # fmt: skip
    return "\n".join([f"{question}, {pixels(result, question)} pixels", *lines])


def curve_table(curves, slopes):
    head = [
        "engine",
        "samples",
        "ms",
        "first call, ms",
        "rms, mm",
        "median, mm",
        "peak MB",
        "slope",
    ]
    rows = []
    for name, points in curves.items():
        for p in points:
            rms = (max(sum(p.mean_square_m2) / len(p.mean_square_m2), 0)) ** 0.5
            shown = f"{1e3 * rms:.2f}" if p.known else "below the reference's noise"
            middle = sum(p.median_m) / len(p.median_m)
            rows.append([
                name, str(p.samples), f"{1e3 * min(p.seconds):.1f}", f"{1e3 * p.first_s:.0f}",
                shown, f"{1e3 * middle:.2f}", f"{p.peak_mb:.0f}",
                f"{slopes[name]:.2f}" if p is points[-1] else "",
            ])  # fmt: skip
    return table(head, rows)


def ratio_table(ratios):
    head = ["mean squared error at equal time, peer / ours", "ratio", "95 %", "at (s: ratio)"]
    rows = []
    for entry in ratios:
        name, r = f"{entry['theirs']} / {entry['ours']}", entry["ratio"]
        if r is None:
            rows.append([name, "-", "-", "their times do not overlap"])
            continue
        at = ", ".join(f"{s:.2g}: {value:.1f}" for s, value in r.at)
        rows.append([name, f"{r.value:.1f}", f"{r.low:.1f} to {r.high:.1f}", at])
    return table(head, rows)


def reference_text(result):
    lines = [
        f"Reference of {name}: {t['samples']} samples, {t['seconds']:.0f} s, standard error "
        f"{t['standard_error_mm']:.2f} mm rms."
        for name, t in result["reference"].items()
    ]
    head = ["agreement of the two references", "pixels", "chi2 per pixel", "beyond 4 s.e.",
            "mean gap, 1e-4", "its s.e."]  # fmt: skip
    rows = []
    for where, a in result["agreement"].items():
        real, imag = (1e4 * g for g in a["mean_gap"])
        rows.append([where, str(a["pixels"]), f"{a['chi2_per_pixel']:.2f}",
                     f"{100 * a['share_beyond']:.2f} %", f"{real:+.1f} {imag:+.1f}i",
                     f"{1e4 * a['mean_gap_se']:.1f}"])  # fmt: skip
    return "\n".join(lines) + "\n\n" + table(head, rows)


def fault_table(faults):
    head = ["wall at 2 m reads, m", "mitransient", "toftools"]
    rows = [[name, f"{theirs:.4f}", f"{ours:.4f}"] for name, theirs, ours in faults]
    return "### Time origin and ambient light\n\n" + table(head, rows)
