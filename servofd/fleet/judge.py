"""One log of many, judged where the work is done: in a process of this machine, or a worker of a cluster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from logparsers import LogError
from servofd.batch.fetch import fetched
from servofd.batch.key import content_key
from servofd.core.errors import ConfigError, ServofdError
from servofd.jobs.workflow import audit
from servofd.outputs.json_report import FailedLog, audit_document

if TYPE_CHECKING:
    from collections.abc import Iterator

    from logparsers import FlightLog
    from servofd.batch.find import LogSource
    from servofd.batch.key import Job
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
    try:
        with fetched(source.path) as local:
            results: list[LogAudit] = []
            runs = tuple(_verdicts(local, source.path, job, results))
            return JudgedLog(source, content, runs, _page(results) if job.pages and results else "")
    except ConfigError as error:
        return failed(source, str(error), content)


def failed(source: LogSource, reason: str, content: str = "") -> JudgedLog:
    """Result of a log that could not be judged at all."""
    return JudgedLog(source, content, (_not_judged(source.path, reason),))


def _not_judged(path: str, reason: str, log: FlightLog | None = None) -> RunVerdict:
    return RunVerdict(audit_document([FailedLog(path, reason, log)])["logs"][0], reason)


def _page(results: list[LogAudit]) -> str:
    from servofd.outputs.audit_page import audit_page

    return audit_page(results)


def _verdicts(local: str, path: str, job: Job, seen: list[LogAudit]) -> Iterator[RunVerdict]:
    """One for each run, kept in `seen` if the job wants pages; what stops the reading comes last."""
    options: dict[str, Any] = {
        "servo": job.servo,
        "threshold_deg": job.threshold_deg,
        "threshold": job.threshold,
        "surfaces": job.surfaces,
        "threads": 1,  # the logs run side by side already
    }
    try:
        for result in audit(local, job.aircraft, **options):
            if job.pages:
                seen.append(result)
            yield _verdict(result, local, path)
    except (LogError, ServofdError) as error:
        yield _not_judged(path, str(error).replace(local, path), getattr(error, "log", None))
    except MemoryError:
        yield _not_judged(path, f"{path}: does not fit into the memory of the process that read it")


def _verdict(result: LogAudit, local: str, path: str) -> RunVerdict:
    document = audit_document([result])["logs"][0]
    document["path"] = path
    not_judged = result.not_judged
    return RunVerdict(document, f"{result.log.label.replace(local, path)}: {not_judged}" if not_judged else "")
