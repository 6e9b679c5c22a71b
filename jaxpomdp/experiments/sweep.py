"""Many runs: configurations times fixed chunks of seeds, each in its own directory, on several processes.

Last-bit numerics depend on how many seeds share a batch, so the chunk is part of a run's configuration and
never follows from the number of workers: a rerun with other workers gives the same results.
"""

from __future__ import annotations

import importlib
import math
import multiprocessing
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import jax

from jaxpomdp.experiments.config import RunConfig, describe, digest
from jaxpomdp.experiments.runner import Build, build, run


class Job(NamedTuple):
    """One run and its directory."""

    config: RunConfig
    path: Path


def in_chunks(config: RunConfig, chunk: int) -> list[RunConfig]:
    """Return the configuration once for every ``chunk`` of its seeds, in order (0: all seeds in one).

    >>> [c.seeds for c in in_chunks(RunConfig(seeds=(1, 2, 3, 4, 5)), 2)]
    [(1, 2), (3, 4), (5,)]

    Raises:
        ValueError: ``chunk`` is negative.
    """
    if chunk < 0:
        raise ValueError(f"chunk must be 0 (all seeds together) or a number of seeds, got {chunk}")
    size = chunk or len(config.seeds)
    return [replace(config, seeds=config.seeds[i : i + size]) for i in range(0, len(config.seeds), size)]


def plan(configs: Iterable[RunConfig], root: Path, *, chunk: int = 0, make: Build = build) -> list[list[Job]]:
    """Return for each configuration its jobs, one per chunk of seeds.

    A directory is named by environment, agent, a digest of all else that fixes the results, and the seeds;
    so two experiments that want the same run share it, and a changed setting makes a new one.
    """
    return [[_job(part, root, make) for part in in_chunks(config, chunk)] for config in configs]


def _job(config: RunConfig, root: Path, make: Build) -> Job:
    seeds = config.seeds
    description = describe(replace(config, seeds=(0,)), make(config)[1])
    env = Path(config.env).stem
    name = f"{env}-{config.agent}-{digest(description)}"
    return Job(config, root / name / f"seeds-{seeds[0]}-{seeds[-1]}-of-{len(seeds)}")


def run_jobs(
    jobs: Sequence[Job],
    *,
    workers: int = 1,
    backend: Literal["process", "ray"] = "process",
    progress: str = "auto",
    make: Build = build,
) -> None:
    """Do every job that is not done: here if ``workers`` is 1, else one job per process, or on a Ray cluster.

    Before a job JAX forgets what this process compiled if memory maps run out.

    Args:
        jobs: what to do; a directory that several jobs name is done once.
        workers: jobs at a time; each process compiles for itself.
        backend: ``"ray"`` sends jobs to a cluster whose machines all see the run directories' file system.
        progress: as of ``run``; with several workers always plain lines.
        make: gives world and agent of a configuration.

    Raises:
        ValueError: ``workers`` is below 1.
        ModuleNotFoundError: Ray is asked for and not installed.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    distinct = list({job.path: job for job in jobs}.values())
    if backend == "ray":
        _run_on_ray(distinct, make)
    elif workers == 1 or len(distinct) == 1:
        for job in distinct:
            _run(job, progress, make)
    else:
        kind = "none" if progress == "none" else "lines"
        _run_in_processes(distinct, min(workers, len(distinct)), make, kind)


def _run(job: Job, progress: str, make: Build) -> None:
    """Do a job in a process that may have done many."""
    if memory_maps_left() < FEW_MAPS:
        jax.clear_caches()
    run(job.config, job.path, progress=progress, make=make)


FEW_MAPS = 30_000
"""Each compiled function takes a few of the memory maps that a process may have, most often 65,530."""


def memory_maps_left(process: Path = Path("/proc/self"), system: Path = Path("/proc/sys/vm")) -> float:
    """Return how many memory maps this process may still open; infinite where the system does not say."""
    try:
        most = int((system / "max_map_count").read_text())
        with (process / "maps").open() as maps:
            return most - sum(1 for _ in maps)
    except (OSError, ValueError):
        return math.inf


def _run_in_processes(jobs: Sequence[Job], workers: int, make: Build, progress: str) -> None:
    """Run in fresh processes (forking one that has used JAX may hang); the first error stops the rest."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        futures = [pool.submit(_run, job, progress, make) for job in jobs]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _run_on_ray(jobs: Sequence[Job], make: Build) -> None:
    try:
        ray = importlib.import_module("ray")
    except ModuleNotFoundError:
        raise ModuleNotFoundError("backend 'ray' needs Ray: pip install 'jaxpomdp[cluster]'") from None
    if not ray.is_initialized():
        ray.init(include_dashboard=False)
    remote = ray.remote(num_cpus=1)(_run)
    ray.get([remote.remote(Job(job.config, job.path.resolve()), "lines", make) for job in jobs])
