"""Proofs of the path engine as a page: docs/simulator_proofs.md, with measured figures.

python benchmarks/proofs.py [--out PAGE]

Runs the physics tests of the engine with as many seeds as a relative error of 1e-3 takes (about 3
minutes on two cores), collects the figures that they record, and writes them down. A test that
fails leaves the page as it was and gives exit code 1.
"""

import argparse
import os
import re
import sys
from itertools import groupby
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TESTS = ("test_path_physics.py", "test_path_engine.py")
HEAD = """# Proofs of the simulator

Made by `python benchmarks/proofs.py`; do not edit. Every line is an assertion of a test in
`tests/test_path_physics.py` or `tests/test_path_engine.py`; `make test` runs the same tests with
fewer seeds.

A phasor is written as modulus and angle; 1 is a white, fronto-parallel surface at 1 m lit by one
isotropic source at the camera, and angles grow with range. The standard error comes from the
spread over independent seeds, and is relative to the expected modulus like the error beside it.
A row that stands for several figures (pixels, frequencies) shows the worst of them: the one that
is most standard errors off. Rounding to single precision (2e-6) counts on top where noise is below.
"""


class Collector:
    """Pytest plug-in that keeps what tests record, and which of them failed."""

    def __init__(self):
        self.proofs, self.facts, self.failed = [], [], []

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.failed.append(report.nodeid)
        if report.when == "call":
            for name, kept in (("proof", self.proofs), ("fact", self.facts)):
                kept += [value for key, value in report.user_properties if key == name]


def polar(value):
    """Modulus and angle of a complex number; a real one alone."""
    if value.imag == 0:
        return f"{value.real:.6g}"
    import cmath

    return f"{abs(value):.6g} ∠ {cmath.phase(value) * 180 / cmath.pi:.4f}°"


def table(head, rows):
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def proof_row(proof):
    size = max(abs(proof["expected"]), 1e-300)
    limit = f"3 s.e.{' and 0.1 %' if proof['limit'] else ''}"
    if proof["allowed"] != 3:
        limit = f"{proof['allowed']:g} s.e."
    return (
        proof["what"],
        str(proof["count"]),
        polar(proof["expected"]),
        polar(proof["measured"]),
        f"{proof['relative']:.1e}",
        f"{proof['error'] / size:.1e}",
        f"{proof['sigmas']:.2f}",
        limit,
    )


def natural(text):
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", text)]


def page(proofs, facts):
    """The whole page as Markdown."""
    parts = [HEAD]
    head = ("compared", "figures", "expected", "measured", "relative error", "standard error",
            "off by s.e.", "limit")  # fmt: skip
    for scene, group in groupby(proofs, key=lambda p: p["scene"]):
        parts.append(f"## {scene[0].upper()}{scene[1:]}\n")
        parts.append(table(head, map(proof_row, group)) + "\n")
    parts.append("## Other checks\n")
    rows = [(f["scene"], f["what"], f["wanted"], f["found"]) for f in facts]
    parts.append(table(("scene", "case", "wanted", "found"), rows) + "\n")
    return "\n".join(parts)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "simulator_proofs.md")
    given = parser.parse_args(arguments)
    os.environ["TOFTOOLS_PROOFS"] = "thorough"
    collector = Collector()
    files = [str(ROOT / "tests" / name) for name in TESTS]
    code = pytest.main(["-q", "--rootdir", str(ROOT), *files], plugins=[collector])
    if code:
        sys.exit(f"not written, as {len(collector.failed)} tests failed: {collector.failed[:5]}")
    proofs = sorted(collector.proofs, key=lambda p: natural(p["scene"]))
    given.out.write_text(page(proofs, collector.facts), encoding="utf-8")
    print(f"{len(proofs)} proofs and {len(collector.facts)} other checks: {given.out}")


if __name__ == "__main__":
    main()
