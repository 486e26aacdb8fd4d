"""The audit of many logs: who does it, what is done already, what comes back of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from servofd.batch.find import fetched
from servofd.batch.key import Job, content_key
from servofd.batch.local import run_local
from servofd.core.errors import ConfigError
from servofd.jobs.workflow import FailedLog, judged
from servofd.outputs.audit_report import audit_report
from servofd.outputs.json_report import audit_document
from servofd.outputs.page import FLEET_PAGE, html_page

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from servofd.batch.find import LogSource
    from servofd.detection.verdict import LogAudit


@dataclass(frozen=True, slots=True)
class RunVerdict:
    """One run of a log, as JSON shows it (an entry of ``logs`` in servofd.audit/1)."""

    document: dict[str, Any]
    not_judged: str
    """Why there is no verdict on it as a whole; empty if there is one."""

    @property
    def has_fault(self) -> bool:
        """True if any surface or axis is at fault."""
        every = (*self.document["surfaces"].values(), *self.document.get("axes", {}).values())
        return any(one["status"] == "fault" for one in every)

    @property
    def row(self) -> dict[str, Any]:
        """As a row of the table of logs."""
        return {"document": self.document, "not_judged": self.not_judged}


@dataclass(frozen=True, slots=True)
class JudgedLog:
    """What became of one log."""

    source: LogSource
    content: str
    """Digest of its bytes; empty if they could not be read."""
    runs: tuple[RunVerdict, ...]
    page: str = ""
    """HTML, where the job asked for it and there is something to show."""


def judge_log(source: LogSource, job: Job) -> JudgedLog:
    """Judge one log; what is wrong with it is part of the result.

    Examples
    --------
    >>> from servofd.batch.find import LogSource
    >>> from servofd.batch.key import Job
    >>> judge_log(LogSource("no_such.csv", 0), Job()).runs[0].not_judged[:24]
    'no_such.csv: no such fil'
    """
    try:
        content = content_key(source.path)
    except OSError:
        content = ""  # reading it tells what is wrong, in its own words
    audits: list[LogAudit | FailedLog] = []
    runs = []
    try:
        with fetched(source.path) as local:
            for result in judged(local, job, threads=1):  # the logs run side by side already
                if isinstance(result, FailedLog):
                    failure = replace(result, path=source.path, error=result.error.replace(local, source.path))
                    runs.append(_not_judged(failure))
                    if job.pages and failure.flight is not None:
                        audits.append(failure)
                    continue
                if job.pages:
                    audits.append(result)
                (document,) = audit_document([result])["logs"]
                why = result.not_judged and f"{result.log.label.replace(local, source.path)}: {result.not_judged}"
                runs.append(RunVerdict(document | {"path": source.path}, why))
            return JudgedLog(source, content, tuple(runs), _page(audits) if audits else "")
    except ConfigError as error:
        return failed(source, str(error), content)


def _page(audits: Sequence[LogAudit | FailedLog]) -> str:
    """Page of a log, which leads back to that of all."""
    return html_page(replace(audit_report(audits), links=[("All flights", FLEET_PAGE)]))


def failed(source: LogSource, reason: str, content: str = "") -> JudgedLog:
    """Result of a log that could not be judged at all."""
    return JudgedLog(source, content, (_not_judged(FailedLog(source.path, reason)),))


def _not_judged(failure: FailedLog) -> RunVerdict:
    return RunVerdict(audit_document([failure])["logs"][0], failure.error)


def audit_fleet(logs: Sequence[LogSource], job: Job, *, workers: int | None = None) -> Iterator[JudgedLog]:
    """Judge many logs side by side; results come as they are ready.

    Parameters
    ----------
    logs : sequence of LogSource
        What to judge (`servofd.batch.find.find_logs`).
    workers : int, optional
        Number of processes; one per core if None, 0: this one.

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
    for source, outcome in run_local(task, logs, workers):
        if isinstance(outcome, Exception):
            yield failed(source, f"{source.path}: {_reason(outcome)}")
        else:
            yield outcome


def _reason(error: Exception) -> str:
    """What stopped a log that nothing in it should have stopped."""
    name, text = type(error).__name__, " ".join(str(error).split())
    return text if name == "WorkerDied" else f"could not be judged: {name}: {text}"
