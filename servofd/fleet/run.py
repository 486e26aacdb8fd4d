"""The audit of many logs: who does it, what is done already, what comes back."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.batch.cluster import run_on_cluster
from servofd.batch.find import find_logs
from servofd.batch.key import Job
from servofd.batch.local import run_local
from servofd.feedback.flown import known_aircraft, layout_of
from servofd.fleet.judge import failed, judge_log

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from servofd.aircraft.schema import Aircraft
    from servofd.batch.find import LogSource
    from servofd.fleet.judge import JudgedLog


def audit_fleet(
    logs: Sequence[LogSource], job: Job, *, cluster: str | None = None, workers: int | None = None
) -> Iterator[JudgedLog]:
    """Judge many logs side by side; results come as they are ready.

    Parameters
    ----------
    logs : sequence of LogSource
        What to judge (`servofd.batch.find.find_logs`).
    cluster : str, optional
        Scheduler of a Dask cluster, such as ``"tcp://scheduler:8786"``; the processes of this machine if None.
    workers : int, optional
        Number of processes on this machine; one per core if None, 0: this one.

    Yields
    ------
    JudgedLog
        One per log: a log that cannot be read, or that its process dies of, says so in its result.

    Examples
    --------
    >>> from servofd.batch.find import find_logs
    >>> from servofd.batch.key import Job
    >>> logs = find_logs(["sample_logs/faser_stuck_flight.mat"]).logs
    >>> [judged.runs[0].has_fault for judged in audit_fleet(logs, Job(), workers=0)]
    [True]
    """
    task = partial(judge_log, job=job)
    outcomes = run_on_cluster(cluster, task, logs) if cluster else run_local(task, logs, workers)
    for source, outcome in outcomes:
        if isinstance(outcome, Exception):
            yield failed(source, f"{source.path}: {_reason(outcome)}")
        else:
            yield outcome


def audit_logs(
    inputs: Sequence[str | Path],
    aircraft: Aircraft | str | Path | None = None,
    *,
    cluster: str | None = None,
    workers: int | None = None,
) -> Iterator[JudgedLog]:
    """Judge all logs of some folders, patterns, addresses and files, as `audit_fleet` does.

    Parameters
    ----------
    inputs : sequence of str or Path
        Where to look for logs.
    aircraft : Aircraft, str or Path, optional
        The aircraft or its file; each log's own, as far as the log shows it, if None.
    cluster, workers
        As for `audit_fleet`.

    Raises
    ------
    ConfigError
        If there is no log, or the aircraft is not what it should be.

    Examples
    --------
    >>> [judged.runs[0].has_fault for judged in audit_logs(["sample_logs/faser_stuck_flight.ma?"], "faser", workers=0)]
    [True]
    """
    known = known_aircraft(aircraft)
    found = find_logs([str(one) for one in inputs], layout_of(known))
    return audit_fleet(found.logs, Job(known), cluster=cluster, workers=workers)


def _reason(error: Exception) -> str:
    """What stopped a log that nothing in it should have stopped."""
    name, text = type(error).__name__, " ".join(str(error).split())
    return text if name == "WorkerDied" else f"could not be judged: {name}: {text}"
