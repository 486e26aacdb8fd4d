"""One log of many, judged where the work is done: in a process of this machine, or a worker of a cluster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from servofd.batch.fetch import fetched
from servofd.batch.key import content_key
from servofd.core.errors import ConfigError
from servofd.jobs.workflow import FailedLog, judged
from servofd.outputs.audit_page import audit_page
from servofd.outputs.json_report import audit_document

if TYPE_CHECKING:
    from servofd.batch.find import LogSource
    from servofd.batch.key import Job


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
    audits, runs = [], []
    try:
        with fetched(source.path) as local:
            for result in judged(local, job, threads=1):  # the logs run side by side already
                if isinstance(result, FailedLog):
                    failure = FailedLog(source.path, result.error.replace(local, source.path), result.log)
                    runs.append(_not_judged(failure))
                    continue
                if job.pages:
                    audits.append(result)
                (document,) = audit_document([result])["logs"]
                why = result.not_judged and f"{result.log.label.replace(local, source.path)}: {result.not_judged}"
                runs.append(RunVerdict(document | {"path": source.path}, why))
            return JudgedLog(source, content, tuple(runs), audit_page(audits) if audits else "")
    except ConfigError as error:
        return failed(source, str(error), content)


def failed(source: LogSource, reason: str, content: str = "") -> JudgedLog:
    """Result of a log that could not be judged at all."""
    return JudgedLog(source, content, (_not_judged(FailedLog(source.path, reason)),))


def _not_judged(failure: FailedLog) -> RunVerdict:
    return RunVerdict(audit_document([failure])["logs"][0], failure.error)
