"""Work of an experiment, shared by the processes of this computer or by any executor."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Generic, TypeVar

from .registry import Options, Progress

Job = TypeVar("Job")
Result = TypeVar("Result")
Item = TypeVar("Item")


def run_jobs(
    run: Callable[[Job], Sequence[Result]],
    jobs: Sequence[Job],
    progress: Progress,
    what: str,
    unit: str,
    options: Options | None = None,
) -> list[Result]:
    options = options or Options()
    count = min(options.processes or os.cpu_count() or 1, len(jobs))
    if options.executor is None and count <= 1:
        return [result for job in progress(jobs, what, unit) for result in run(job)]
    pool: AbstractContextManager[Executor]
    pool = worker_pool(count) if options.executor is None else nullcontext(options.executor)
    found: dict[int, Sequence[Result]] = {}
    with pool as executor:
        waiting = {executor.submit(run, job): k for k, job in enumerate(jobs)}
        try:
            for done in progress(_Sized(as_completed(waiting), len(jobs)), what, unit):
                found[waiting[done]] = done.result()
        except BaseException:
            for future in waiting:
                future.cancel()
            raise
    return [result for k in range(len(jobs)) for result in found[k]]


@contextmanager
def worker_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Provide processes of one thread; spawned, as a fork during a background compilation may hang."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    spawn = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(count, spawn, initializer=_end_with_parent) as pool:
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
    parent = multiprocessing.parent_process()
    assert parent is not None  # a worker of the pool above

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


class _Sized(Generic[Item]):
    def __init__(self, items: Iterable[Item], count: int) -> None:
        self._items, self._count = items, count

    def __iter__(self) -> Iterator[Item]:
        return iter(self._items)

    def __len__(self) -> int:
        return self._count
