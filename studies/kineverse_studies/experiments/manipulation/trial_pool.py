"""Trials in several processes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed
from typing import Generic, TypeVar

from kineverse_studies.experiments.registry import Progress
from kineverse_studies.experiments.worker_pool import worker_pool

Job = TypeVar("Job")
Result = TypeVar("Result")
Item = TypeVar("Item")


def run_jobs(
    run: Callable[[Job], Sequence[Result]],
    jobs: Sequence[Job],
    progress: Progress,
    what: str,
    unit: str,
    processes: int | None = None,
) -> list[Result]:
    """Return the results of all jobs, such as trials, in the order of the jobs."""
    count = min(processes or os.cpu_count() or 1, len(jobs))
    if count <= 1:
        return [trial for job in progress(jobs, what, unit) for trial in run(job)]
    found: dict[int, Sequence[Result]] = {}
    with worker_pool(count) as pool:
        waiting = {pool.submit(run, job): k for k, job in enumerate(jobs)}
        for done in progress(_Sized(as_completed(waiting), len(jobs)), what, unit):
            found[waiting[done]] = done.result()
    return [trial for k in range(len(jobs)) for trial in found[k]]


class _Sized(Generic[Item]):
    """Iterable with a length, of which progress bars show a share."""

    def __init__(self, items: Iterable[Item], count: int) -> None:
        self._items, self._count = items, count

    def __iter__(self) -> Iterator[Item]:
        return iter(self._items)

    def __len__(self) -> int:
        return self._count
