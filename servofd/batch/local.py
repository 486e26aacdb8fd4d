"""Who works on many logs: processes of this machine, spawned one per core."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from types import ModuleType
from typing import TypeVar

from servofd.core.errors import ServofdError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS")
_AHEAD = 2
"""Items handed out per process: one at work, one waiting, so that none is idle and few are lost with a process."""


_DIED = "the process that read it died: out of memory, killed or crashed"
_SCRIPT = threading.Lock()
"""Of who hides the user's script: two at once would put the wrong one back."""


class WorkerDied(ServofdError):  # noqa: N818 - reads better without "Error"
    """A process ended while it worked on an item."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_local(
    task: Callable[[_Item], _Result], items: Sequence[_Item], workers: int | None = None
) -> Iterator[tuple[_Item, _Result | Exception]]:
    """Do a task for each item, in processes; results come as they are ready.

    A process that dies (killed, out of memory, crashed) takes no other with it: what was handed out by then is done
    again, each item in a process of its own, and only the one that dies again is given up.

    `task`: a function of a module, or a partial of one. `workers`: number of processes; one per core if None; 0: no
    process but this one, which then nothing protects.
    """
    if workers == 0:
        yield from ((item, _outcome(partial(task, item))) for item in items)
        return
    waiting = deque(items)
    count = max(1, min(workers or cores(), len(items)))
    while waiting:
        suspects: list[_Item] = []
        yield from _until_broken(task, waiting, count, suspects)
        for item in suspects:
            alone = list(_until_broken(task, deque([item]), 1, []))
            yield alone[0] if alone else (item, WorkerDied(_DIED))


def _until_broken(
    task: Callable[[_Item], _Result], waiting: deque[_Item], count: int, suspects: list[_Item]
) -> Iterator[tuple[_Item, _Result | Exception]]:
    """Work until all is done, or a process has died; what it may have died of goes to `suspects`."""
    running: dict[Future[_Result], _Item] = {}
    with processes(count) as pool:
        while waiting or running:
            try:
                while waiting and len(running) < _AHEAD * count:
                    with interrupts_wait():  # for the processes that this starts: the parent ends them
                        running[pool.submit(task, waiting[0])] = waiting[0]
                    waiting.popleft()
            except BrokenProcessPool:
                suspects.extend(running.values())
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                item, outcome = running.pop(future), _outcome(future.result)
                if isinstance(outcome, BrokenProcessPool):
                    suspects.append(item)
                else:
                    yield item, outcome
            if suspects:
                suspects.extend(running.values())
                return


def _outcome(result: Callable[[], _Result]) -> _Result | Exception:
    try:
        return result()
    except Exception as error:
        return error


@contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """Some processes with one thread each for linear algebra; left early, they are ended at once."""
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=_end_with_parent)
    known = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # before processes start: libraries read it when they are loaded
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in known.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Within the block Ctrl-C waits for its end; processes that start in it never receive it."""
    has_mask = hasattr(signal, "pthread_sigmask")
    with _SCRIPT:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if has_mask else set()
        # Processes that start here need none of the user's script, and do not run it again, guarded or not.
        script = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = script
            if has_mask:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """Processes must not outlive a parent that was killed."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
