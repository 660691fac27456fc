"""Work of an experiment, shared by the processes of an executor."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Generic, TypeVar

from kineverse_studies.experiments.registry import Progress


@contextmanager
def worker_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Provide a pool of processes with one thread each."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        with ProcessPoolExecutor(
            count, multiprocessing.get_context("spawn"), initializer=_end_with_parent
        ) as pool:
            try:
                yield pool
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _end_with_parent() -> None:
    """End this worker process when its parent ends, because it receives no signal."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this runs in a worker process

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


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
