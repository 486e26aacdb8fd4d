"""The audit of many logs: who does it, what is done already, what comes back of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from servofd.batch.find import LogSource, fetched
from servofd.batch.key import Job, content_key
from servofd.batch.local import run_local
from servofd.core.errors import ConfigError
from servofd.detection.verdict import LogAudit
from servofd.jobs.workflow import FailedLog, judged
from servofd.outputs.audit_report import audit_report
from servofd.outputs.json_report import audit_document
from servofd.outputs.page import FLEET_PAGE, html_page


@dataclass(frozen=True, slots=True)
class JudgedLog:
    """What became of one log."""

    source: LogSource
    content: str
    """Digest of its bytes; empty if they could not be read."""
    rows: tuple[dict[str, Any], ...]
    """Its runs as `servofd.fleets.overview.overview` takes them: `document` (an entry of ``logs`` in servofd.audit/1),
    `content`, and why there is no verdict on it as a whole (`not_judged`)."""
    page: str = ""
    """HTML, where the job asked for it and there is something to show."""


def judge_log(source: LogSource, job: Job) -> JudgedLog:
    """Judge one log; what is wrong with it is part of the result."""
    try:
        content = content_key(source.path)
    except OSError:
        content = ""  # reading it tells what is wrong, in its own words
    shown: list[LogAudit | FailedLog] = []
    rows = []
    try:
        with fetched(source.path) as local:
            for found in judged(local, job, threads=1):  # the logs run side by side already
                if isinstance(found, FailedLog):
                    why, is_shown = found.error.replace(local, source.path), found.flight is not None
                    found = replace(found, path=source.path, error=why)  # noqa: PLW2901 - under its own name
                else:
                    label, is_shown = found.log.label.replace(local, source.path), True
                    why = found.not_judged and f"{label}: {found.not_judged}"
                shown += [found] * (job.pages and is_shown)
                rows.append(_row(source, content, found, why))
            # Its page leads back to that of all.
            page = html_page(replace(audit_report(shown), links=[("All flights", FLEET_PAGE)])) if shown else ""
            return JudgedLog(source, content, tuple(rows), page)
    except ConfigError as error:
        return _failed(source, str(error), content)


def _failed(source: LogSource, reason: str, content: str = "") -> JudgedLog:
    return JudgedLog(source, content, (_row(source, content, FailedLog(source.path, reason), reason),))


def _row(source: LogSource, content: str, result: LogAudit | FailedLog, not_judged: str) -> dict[str, Any]:
    (document,) = audit_document([result])["logs"]
    return {"document": document | {"path": source.path}, "not_judged": not_judged, "content": content}


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
            yield _failed(source, f"{source.path}: {why}")
        else:
            yield outcome
