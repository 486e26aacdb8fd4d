"""Verdicts as flat tables: one row per log, one per log and surface or axis, one per fault."""

from __future__ import annotations

import json
from datetime import datetime
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pyarrow as pa

    from servofd.fleet.judge import JudgedLog

_LOG = {"content": "string", "path": "string", "run": "string", "start_utc": "time"}
TABLES: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "faults": {
            **_LOG,
            "surface": "string",
            "kind": "string",
            "level": "string",
            "start_s": "double",
            "alarm_s": "double",
            "end_s": "double",
            "probability": "double",
            "parameters": "string",
            "alternatives": "string",
        },
        "surfaces": {
            **_LOG,
            "duration_s": "double",
            "surface": "string",
            "status": "string",
            "reason": "string",
            "servo": "string",
            "threshold_kind": "string",
            "threshold_deg": "double",
            "residual_mean_deg": "double",
            "residual_std_deg": "double",
            "residual_max_abs_deg": "double",
            "simulation_error_rms_deg": "double",
            "false_alarms_per_hour": "double",
            "faults": "int64",
            "suspicions": "int64",
        },
        "axes": {
            **_LOG,
            "duration_s": "double",
            "axis": "string",
            "status": "string",
            "reason": "string",
            "members": "string",
            "lost_share": "double",
            "offset_us": "double",
            "since_s": "double",
            "judged_share": "double",
        },
        "logs": {
            **_LOG,
            "size_bytes": "int64",
            "format": "string",
            "duration_s": "double",
            "not_judged": "string",
            "damage": "int64",
            "document": "string",
        },
    }
)
"""Columns and their kinds. A log is done when it stands in ``logs``, which is therefore written last."""


def rows(judged: JudgedLog) -> dict[str, list[dict[str, Any]]]:
    """Rows of one log for each table.

    Examples
    --------
    >>> from servofd.batch.find import LogSource
    >>> from servofd.fleet.judge import failed
    >>> rows(failed(LogSource("a.csv", 0), "a.csv: no such file"))["logs"][0]["not_judged"]
    'a.csv: no such file'
    """
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
    for run in judged.runs:
        document = run.document
        start = document.get("start_utc")
        log = {
            "content": judged.content,
            "path": document["path"],
            "run": document.get("run"),
            "start_utc": datetime.fromisoformat(start) if start else None,
        }
        tables["logs"].append(
            {
                **log,
                "size_bytes": judged.source.size_bytes,
                "format": document["format"],
                "duration_s": document["duration_s"],
                "not_judged": run.not_judged or None,
                "damage": len(document["damage"]),
                "document": json.dumps(document),
            }
        )
        for name, axis in document.get("axes", {}).items():
            own = {key: axis[key] for key in ("status", "reason", "lost_share", "offset_us", "since_s", "judged_share")}
            members = ", ".join(axis["members"])
            tables["axes"].append(
                {**log, "duration_s": document["duration_s"], "axis": name, **own, "members": members}
            )
        for name, surface in document["surfaces"].items():
            tables["surfaces"].append({**log, "duration_s": document["duration_s"], **_surface(name, surface)})
            for level in ("faults", "suspicions"):
                tables["faults"] += [{**log, "surface": name, **_fault(fault, level)} for fault in surface[level]]
    return tables


def to_arrow(name: str, content: list[dict[str, Any]]) -> pa.Table:
    """Rows as an Arrow table with the columns of `TABLES`, whatever they hold."""
    import pyarrow as pa

    kinds = {
        "string": pa.string(),
        "double": pa.float64(),
        "int64": pa.int64(),
        "time": pa.timestamp("us", tz="UTC"),
    }
    schema = pa.schema([(column, kinds[kind]) for column, kind in TABLES[name].items()])
    return pa.Table.from_pylist([{key: _text(value) for key, value in row.items()} for row in content], schema=schema)


def _text(value: Any) -> Any:  # noqa: ANN401 - any cell
    """Names of files that are no UTF-8 as Python writes them; anything else as it is."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _surface(name: str, surface: dict[str, Any]) -> dict[str, Any]:
    residual = surface["residual"] or {}
    return {
        "surface": name,
        "status": surface["status"],
        "reason": surface["reason"],
        "servo": surface["servo"],
        "threshold_kind": surface["threshold"]["kind"],
        "threshold_deg": surface["threshold"]["deg"],
        "residual_mean_deg": residual.get("mean_deg"),
        "residual_std_deg": residual.get("std_deg"),
        "residual_max_abs_deg": residual.get("max_abs_deg"),
        "simulation_error_rms_deg": surface["simulation_error_rms_deg"],
        "false_alarms_per_hour": surface["false_alarms_per_hour"],
        "faults": len(surface["faults"]),
        "suspicions": len(surface["suspicions"]),
    }


def _fault(fault: dict[str, Any], level: str) -> dict[str, Any]:
    return {
        "kind": fault["kind"],
        "level": level.removesuffix("s"),
        "start_s": fault["start_s"],
        "alarm_s": fault["alarm_s"],
        "end_s": fault["end_s"],
        "probability": fault["probability"],
        "parameters": json.dumps(fault["parameters"]),
        "alternatives": ", ".join(fault["alternatives"]),
    }
