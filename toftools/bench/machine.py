"""What a figure was measured on: the machine and the versions."""

import os
import platform
from pathlib import Path
from typing import Any


def versions() -> dict[str, str]:
    """Versions that matter for a figure.

    Returns
    -------
    dict
        Package to version.
    """
    from importlib.metadata import version

    return {
        "toftools": version("toftools"),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
    }


def machine(threads: int) -> dict[str, Any]:
    """What the figures were measured on.

    Parameters
    ----------
    threads : int
        Threads given to each method.

    Returns
    -------
    dict
        CPU name, core count, threads, operating system.
    """
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [s for s in info.read_text(errors="replace").splitlines() if "model name" in s]
        cpu = names[0].partition(":")[2].strip() if names else cpu
    return {
        "cpu": cpu,
        "cores": os.cpu_count() or 1,
        "threads": threads,
        "system": f"{platform.system()} {platform.machine()}",
    }
