"""The audit of many logs: who does it, what is done already, what comes back."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from servofd.fleet.cluster import run_on_cluster
from servofd.fleet.judge import failed, judge_log
from servofd.fleet.local import run_local

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from servofd.fleet.find import LogSource
    from servofd.fleet.judge import JudgedLog
    from servofd.fleet.key import Job

__all__ = ["audit_fleet"]


def audit_fleet(
    logs: Sequence[LogSource], job: Job, *, cluster: str | None = None, workers: int | None = None
) -> Iterator[JudgedLog]:
    """Judge many logs side by side; results come as they are ready.

    Parameters
    ----------
    logs : sequence of LogSource
        What to judge (`servofd.fleet.find.find_logs`).
    job : Job
        What to judge it with.
    cluster : str, optional
        Scheduler of a Dask cluster, such as ``"tcp://scheduler:8786"``; the processes of this machine if None.
    workers : int, optional
        Number of processes on this machine; one per core if None.

    Yields
    ------
    JudgedLog
        One per log: a log that cannot be read, or that its process dies of, says so in its result.

    Examples
    --------
    >>> from servofd.fleet.find import find_logs
    >>> from servofd.fleet.key import Job
    >>> logs = find_logs(["sample_logs/faser_stuck_flight.mat"]).logs
    >>> [judged.runs[0].has_fault for judged in audit_fleet(logs, Job(), workers=1)]
    [True]
    """
    task = partial(judge_log, job=job)
    outcomes = run_on_cluster(cluster, task, logs) if cluster else run_local(task, logs, workers)
    for source, outcome in outcomes:
        if isinstance(outcome, Exception):
            yield failed(source, f"{source.path}: {_reason(outcome)}")
        else:
            yield outcome


def _reason(error: Exception) -> str:
    """What stopped a log that nothing in it should have stopped."""
    name, text = type(error).__name__, " ".join(str(error).split())
    return text if name == "WorkerDied" else f"could not be judged: {name}: {text}"
