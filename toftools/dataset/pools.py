"""Where jobs run: processes of this machine, or a Dask cluster that is there already.

A process that dies (out of memory, killed) takes no other job with it: here the jobs that were
under way are tried again one at a time, each in a process of its own, and whoever kills that has
failed; a cluster gives them to another worker. Files appear whole or not at all under names that
follow from the job, so that a job run twice does no harm.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context

from toftools._native import limit_threads
from toftools.bench.cluster import on_cluster
from toftools.dataset.make import Pool, Work
from toftools.dataset.manifest import Entry
from toftools.dataset.recipe import Job


def cores() -> int:
    """Cores that this process may use.

    Returns
    -------
    int
        One or more.
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def local(workers: int) -> Pool:
    """Processes of this machine, which share its cores.

    Parameters
    ----------
    workers : int
        How many; their threads fill the cores. One runs in this process.

    Returns
    -------
    callable
        A pool.
    """
    threads = max(1, cores() // workers)

    def pool(work: Work, jobs: Sequence[Job]) -> Iterator[Entry]:
        if workers == 1:
            yield from map(work, jobs)
            return
        left = list(jobs)
        while left:
            done = set()
            try:
                for entry in _in_parallel(work, left, workers, threads):
                    done.add(entry["id"])
                    yield entry
                return
            except BrokenProcessPool:
                left = [job for job in left if job.id not in done]
                # Jobs are begun in order, at most two for each worker ahead of their results.
                suspects, left = left[: 2 * workers], left[2 * workers :]
                yield from (_alone(work, job, threads) for job in suspects)

    return pool


def _in_parallel(work: Work, jobs: Sequence[Job], workers: int, threads: int) -> Iterator[Entry]:
    from joblib import Parallel, delayed, parallel_config

    with parallel_config("loky", n_jobs=workers, inner_max_num_threads=threads):
        many = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")
        yield from many(delayed(_limited)(work, job, threads) for job in jobs)


def _alone(work: Work, job: Job, threads: int) -> Entry:
    """One job in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as one:
        try:
            return one.submit(_limited, work, job, threads).result()
        except BrokenProcessPool:
            return {"id": job.id, "error": "its process died; does it need more memory?"}


def _limited(work: Work, job: Job, threads: int) -> Entry:
    """The work of one worker, which leaves the others their cores."""
    limit_threads(threads)
    return work(job)


def over_cluster(address: str) -> Pool:
    """Workers of a Dask cluster, which see the same folder.

    Parameters
    ----------
    address : str
        Of its scheduler, such as tcp://10.0.0.1:8786.

    Returns
    -------
    callable
        A pool. It raises ValueError if Dask is missing, or no scheduler answers.
    """

    def pool(work: Work, jobs: Sequence[Job]) -> Iterator[Entry]:
        names = [job.id for job in jobs]
        for job, got in on_cluster(address, partial(_on_worker, work), jobs, names):
            yield {"id": job.id, "error": got} if isinstance(got, str) else got

    return pool


def _on_worker(work: Work, job: Job) -> Entry:
    from distributed import get_worker

    return _limited(work, job, get_worker().state.nthreads)
