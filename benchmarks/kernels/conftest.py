"""Kernels beside their readable twins: one fixture to time both, one table when all have run.

make kernels                      prints the table below that of pytest-benchmark
pytest ... --table FILE.md        also writes it
"""

import sys
import time
from pathlib import Path

import pytest

from toftools.bench.machine import machine, versions
from toftools.bench.render import number

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "benchmarks")]  # twins; parts of other scripts
HEAD = ("kernel", "ms", "of", "ns each", "readable twin", "ns each", "twin / kernel")
TWIN_CALLS = 3
LINES = pytest.StashKey()


def pytest_addoption(parser):
    parser.addoption("--table", type=Path, help="Markdown file for kernels and their twins")


def pytest_configure(config):
    config.stash[LINES] = []


def least_ms(run, calls):
    times = []
    for _ in range(calls):
        start = time.perf_counter()
        run()
        times.append(1e3 * (time.perf_counter() - start))
    return min(times)


@pytest.fixture
def beside(benchmark, request):
    """Function that times a kernel, and its twin on a part of the same work, and keeps a line.

    `many` is what the kernel works through in a call and `few` what the twin does, in `unit`;
    `twin` is a function and its name.
    """

    def measure(name, kernel, *, many, twin=None, few=1, unit="pixels"):
        kernel()  # compiles
        benchmark(kernel)
        ms = 1e3 * benchmark.stats["min"] if benchmark.enabled else least_ms(kernel, 1)
        own = 1e6 * ms / many
        slow = None if twin is None else 1e6 * least_ms(twin[1], TWIN_CALLS) / few
        ratio = None if slow is None else slow / own
        benchmark.extra_info.update(ns_each=own, twin_ns_each=slow, twin_over_kernel=ratio)
        told = "–" if twin is None else twin[0]
        line = (name, number(ms, 1, ".3g"), f"{many:,} {unit}", number(own, 1, ".3g"), told,
                number(slow, 1, ".3g"), number(ratio, 1, ",.0f"))  # fmt: skip
        request.config.stash[LINES].append(line)

    return measure


def pytest_terminal_summary(terminalreporter, config):
    lines = [HEAD, *config.stash[LINES]]
    if len(lines) == 1:
        return
    widths = [max(len(line[i]) for line in lines) for i in range(len(HEAD))]
    terminalreporter.section("kernels beside their readable twins")
    for line in lines:
        cells = [cell.ljust(w) for cell, w in zip(line, widths, strict=True)]
        terminalreporter.write_line("  ".join(cells).rstrip())
    path = config.getoption("--table")
    if path is not None:
        path.write_text(page(lines), encoding="utf-8")


def page(lines):
    names = ", ".join(f"{k} {v}" for k, v in versions().items())
    cpu = machine(1)
    rule = "|---|---:|---:|---:|---|---:|---:|"
    table = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join(
        [
            "# Kernels beside their readable twins\n",
            "Made by `make kernels TABLE=docs/peers/kernels.md`; do not edit. The least time of "
            "many calls of a kernel, in all threads; its twin is the slow, readable form of the "
            "same computation that tests compare it with (in `tests/`, one thread, the least of "
            f"{TWIN_CALLS} calls), on a part of the work; *ns each* is per pixel or whatever the "
            "third column counts.\n",
            f"{names}; {cpu['cpu']}, {cpu['cores']} cores, which had other work too.\n",
            table[0],
            rule,
            *table[1:],
            "",
        ]
    )
