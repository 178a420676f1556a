"""How points are run, and the fingerprint that follows from it."""

from dataclasses import dataclass
from typing import Any

from toftools.bench.fingerprint import point_fingerprint
from toftools.bench.methods import method_of, specs_of
from toftools.bench.plan import Point


@dataclass(frozen=True)
class Settings:
    """How points are run.

    Parameters
    ----------
    repeats : int
        Timed calls per point.
    threads : int
        Threads each method may use.
    timeout_s : float
        Limit per point, s.
    jobs : int
        Points at once. More than one, and times are those of a busy machine.
    batch : bool
        Points of one method share a process, one after another.
    memory_mb : float or None
        Memory a worker may hold, MB; None for `usual_limit_mb` of the machine it is on.
    cluster : str
        Address of the Dask scheduler whose workers run the points; empty for this machine.
    sensitivity : bool
        After the timed calls, each method is run on perturbed input too.
    """

    repeats: int
    threads: int
    timeout_s: float
    jobs: int = 1
    batch: bool = False
    memory_mb: float | None = None
    cluster: str = ""
    sensitivity: bool = False

    def company(self) -> dict[str, Any]:
        """What else a point's times depend on, beside code and threads."""
        return {"jobs": "cluster" if self.cluster else self.jobs, "batch": self.batch}

    def fingerprint(self, point: Point) -> str:
        """Fingerprint of a point under these settings."""
        targets = [spec.target for spec in specs_of(method_of(point.method))]
        company = {**self.company(), "sensitivity": self.sensitivity}
        return point_fingerprint(
            *targets, repeats=self.repeats, threads=self.threads, company=company
        )
