"""Execution of jobs: in this process, in parallel on the cores, or on a cluster."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.tables.jobs import Job, JobResult, run_job

# Thread limits of libraries that otherwise use all cores each; read at their first import.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
DIED = "its process died (out of memory?)"


def run_jobs(jobs: Sequence[Job], *, workers: int = 0, scheduler: str = "") -> Iterator[JobResult]:
    """Run jobs; yields results in the order in which they finish.

    Args:
        jobs: jobs to run.
        workers: number of processes; 1 = this process, 0 = one per core.
        scheduler: address of a dask scheduler whose workers share the file system; empty = none.

    Raises:
        EvaluationError: the scheduler cannot be used.
    """
    if scheduler:
        yield from _over_cluster(jobs, scheduler)
        return
    workers = min(workers or len(os.sched_getaffinity(0)), len(jobs))
    if workers <= 1:
        for job in jobs:
            yield run_job(job)
        return
    yield from _over_cores(jobs, workers)


def _over_cores(jobs: Sequence[Job], workers: int) -> Iterator[JobResult]:
    """A process that dies breaks its pool. Unfinished jobs then run again, each in its own pool."""
    unfinished = []
    pool = _pool(workers)
    try:
        futures = {pool.submit(run_job, job): job for job in jobs}
        for future in as_completed(futures):
            try:
                yield future.result()
            except BrokenProcessPool:
                unfinished.append(futures[future])
    finally:
        pool.shutdown(cancel_futures=True)
    for job in unfinished:
        with _pool(1) as alone:
            try:
                yield alone.submit(run_job, job).result()
            except BrokenProcessPool:
                yield JobResult(job.row, job.task.scan, None, DIED)


def _pool(workers: int) -> ProcessPoolExecutor:
    # Spawn: a forked copy of a process with threads may hang.
    context = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=one_thread)
        # Start all processes now, while the environment has the thread limits.
        for future in [pool.submit(os.getpid) for _ in range(workers)]:
            future.result()
        return pool
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def one_thread() -> None:
    """Limit OpenCV to one thread: the other processes use the other cores."""
    import cv2

    cv2.setNumThreads(1)


def _over_cluster(jobs: Sequence[Job], address: str) -> Iterator[JobResult]:
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError as error:
        raise EvaluationError(
            f"--scheduler needs dask.distributed: pip install distributed ({error})"
        ) from error
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise EvaluationError(
            f"--scheduler {address}: {error}; expected the address of a running dask scheduler, "
            "e.g. tcp://host:8786"
        ) from error
    with client:
        futures = {client.submit(run_job, job, pure=False): job for job in jobs}
        for future in completed(futures):
            job = futures[future]
            raised = future.exception()
            if raised is None:
                yield future.result()
            else:
                failure = f"{type(raised).__name__}: {raised}"
                yield JobResult(job.row, job.task.scan, None, failure)
