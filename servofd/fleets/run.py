"""The audit of many logs: who does it, what is done already, what comes back of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

from servofd.batch.find import LogSource, fetched
from servofd.batch.key import Job, content_key
from servofd.batch.local import run_local
from servofd.core.errors import ConfigError
from servofd.detection.verdict import LogAudit
from servofd.jobs.workflow import FailedLog, judged
from servofd.outputs.audit_report import audit_report
from servofd.outputs.json_report import audit_document
from servofd.outputs.page import FLEET_PAGE, html_page


class RunVerdict(NamedTuple):
    """One run of a log, as JSON shows it (an entry of ``logs`` in servofd.audit/1)."""

    document: dict[str, Any]
    not_judged: str
    """Why there is no verdict on it as a whole; empty if there is one."""


@dataclass(frozen=True, slots=True)
class JudgedLog:
    """What became of one log."""

    source: LogSource
    content: str
    """Digest of its bytes; empty if they could not be read."""
    runs: tuple[RunVerdict, ...]
    page: str = ""
    """HTML, where the job asked for it and there is something to show."""

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Its runs as `servofd.fleets.overview.overview` takes them."""
        return [run._asdict() | {"content": self.content} for run in self.runs]


def judge_log(source: LogSource, job: Job) -> JudgedLog:
    """Judge one log; what is wrong with it is part of the result.

    Examples
    --------
    >>> from servofd.batch.find import LogSource
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
            # Its page leads back to that of all.
            page = html_page(replace(audit_report(audits), links=[("All flights", FLEET_PAGE)])) if audits else ""
            return JudgedLog(source, content, tuple(runs), page)
    except ConfigError as error:
        return failed(source, str(error), content)


def failed(source: LogSource, reason: str, content: str = "") -> JudgedLog:
    """Result of a log that could not be judged at all."""
    return JudgedLog(source, content, (_not_judged(FailedLog(source.path, reason)),))


def _not_judged(failure: FailedLog) -> RunVerdict:
    return RunVerdict(audit_document([failure])["logs"][0], failure.error)


def audit_fleet(logs: Sequence[LogSource], job: Job, *, workers: int | None = None) -> Iterator[JudgedLog]:
    """Judge many logs side by side; results come as they are ready.

    `logs`: what to judge (`servofd.batch.find.find_logs`). `workers`: number of processes; one per core if None, 0:
    this one. Result: one per log: a log that cannot be read, or that its process dies of, says so in its result.
    """
    task = partial(judge_log, job=job)
    for source, outcome in run_local(task, logs, workers):
        if isinstance(outcome, Exception):  # what stopped a log that nothing in it should have stopped
            name, text = type(outcome).__name__, " ".join(str(outcome).split())
            why = text if name == "WorkerDied" else f"could not be judged: {name}: {text}"
            yield failed(source, f"{source.path}: {why}")
        else:
            yield outcome
