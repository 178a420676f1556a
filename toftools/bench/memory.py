"""Memory of processes as the kernel counts it, and how much of it one worker may take.

The limit is on resident memory and is watched from outside. RLIMIT_AS would be simpler, but it
counts address space, of which LLVM, numba and onnxruntime reserve more than they touch (loaded
together on two cores: 735 MB for 262 resident), and more with every thread: a limit would end
honest methods on one machine and not on the next. LLVM also aborts where it should raise.
"""

import contextlib
import os
from pathlib import Path

SHARE = 0.9
"""Part of the machine's memory that a worker may take if nobody says otherwise."""
CGROUP_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def resident_mb(field: str, pid: int | None = None) -> float:
    """Resident memory of a process as the kernel counts it.

    Parameters
    ----------
    field : {"VmRSS", "VmHWM"}
        Now, or the highest since `forget_peak`.
    pid : int, optional
        Process; this one by default.

    Returns
    -------
    float
        MB; NaN where the kernel does not tell. (ru_maxrss would also count the parent's memory
        at the moment of the fork.)
    """
    status = Path(f"/proc/{pid or 'self'}/status")
    with contextlib.suppress(OSError):
        for line in status.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(f"{field}:"):
                return float(line.split()[1]) / 1024
    return float("nan")


def forget_peak() -> float:
    """Start to count the peak anew.

    Returns
    -------
    float
        Memory in use now, MB: what is not the method's.
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return resident_mb("VmRSS")


def usual_limit_mb() -> float:
    """Memory beyond which a worker is ended if nobody says otherwise.

    Nine tenths of the machine or container: what takes more is about to swap or to be killed, and
    its times would mean nothing. It does not depend on what else runs, so that the same method
    passes or fails every time.

    Returns
    -------
    float
        MB; infinite where the machine does not tell.
    """
    limits = []
    with contextlib.suppress(AttributeError, OSError, ValueError):  # no sysconf on Windows
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for path in CGROUP_LIMITS:
        with contextlib.suppress(OSError, ValueError):  # "max" is no number
            limits.append(int(Path(path).read_text(encoding="ascii")))
    return SHARE * min(limits) / 2**20 if limits else float("inf")


def go_first() -> None:
    """Where memory ends all the same, let the kernel end this process, not those that wait."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
