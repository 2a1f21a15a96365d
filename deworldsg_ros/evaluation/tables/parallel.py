"""The same function over many jobs: in this process, over the cores, or over a cluster."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.tables.jobs import Job, JobResult, run_job

# Libraries that would each take all cores; read when they are first imported.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
DIED = "its process died (out of memory?)"


def run_jobs(jobs: Sequence[Job], *, workers: int = 0, scheduler: str = "") -> Iterator[JobResult]:
    """Results as they come.

    Args:
        jobs: what to run.
        workers: processes; 1 = in this one, 0 = as many as there are cores.
        scheduler: address of a dask scheduler, whose workers see the same folders; empty = none.

    Raises:
        EvaluationError: where the scheduler cannot be used.
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
    """A process that dies breaks its pool: what was left is run again, a pool of one each."""
    left = []
    pool = _pool(workers)
    try:
        futures = {pool.submit(run_job, job): job for job in jobs}
        for future in as_completed(futures):
            try:
                yield future.result()
            except BrokenProcessPool:
                left.append(futures[future])
    finally:
        pool.shutdown(cancel_futures=True)
    for job in left:
        with _pool(1) as alone:
            try:
                yield alone.submit(run_job, job).result()
            except BrokenProcessPool:
                yield JobResult(job.row, job.task.scan, None, DIED)


def _pool(workers: int) -> ProcessPoolExecutor:
    # Started anew: a copy of a process with threads may hang.
    context = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=one_thread)
        # The processes take the environment as it is when they start: now.
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
    """Keep OpenCV to one thread: the cores are taken by the other processes."""
    import cv2

    cv2.setNumThreads(1)


def _over_cluster(jobs: Sequence[Job], address: str) -> Iterator[JobResult]:
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError as error:
        raise EvaluationError(
            f"--scheduler needs dask.distributed: pip install 'deworldsg_ros[cluster]' ({error})"
        ) from error
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise EvaluationError(
            f"--scheduler {address}: {error}; wanted the address of a running dask scheduler, "
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
