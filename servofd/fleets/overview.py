"""What many logs say together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from logparsers.units import S_PER_HOUR
from servofd.batch.key import page_name
from servofd.outputs.json_report import worst_outline
from servofd.outputs.sentence import STATUSES, gravity_of

_RANK = ("fault", "suspect", "not_judged", "unknown", "no_data", "healthy")


@dataclass(frozen=True, slots=True)
class Overview:
    """A fleet on one page."""

    logs: int
    hours: float
    statuses: dict[str, int]
    """Worst status of a log to number of logs; ``not_judged`` where there is no verdict on the log as a whole."""
    surfaces: tuple[dict[str, Any], ...]
    """Each surface over all logs that know it: its servos, logs by status, faults by kind, and of the logs without a
    fault the largest residual over its threshold, and the smallest and largest current of motion beside that of good
    flights."""
    axes: tuple[dict[str, Any], ...]
    """What motion showed of each axis: its surfaces, logs by status, smallest and largest share of its effect."""
    faults: tuple[dict[str, Any], ...]
    """One for each fault of a surface: path, run, surface, and what servofd.audit/1 says of it."""
    not_judged: tuple[dict[str, Any], ...]
    """Path, run and reason of each log without a verdict."""
    flights: tuple[dict[str, Any], ...]
    """One for each log, the worst first: path, run, start, duration, status, sentence, page, and the outline of the
    residual of its worst surface."""
    residuals: tuple[dict[str, Any], ...]
    """Path, run, start, surface, status and largest residual over threshold, one for each log and surface."""

    @property
    def exit_code(self) -> int:
        """1 if there is any fault, else 2 if any log was not cleared, else 0."""
        if self.statuses.get("fault"):
            return 1
        return 2 if self.not_judged or not self.logs else 0

    def document(self) -> dict[str, Any]:
        """As plain dictionaries and lists, schema servofd.fleets/1."""
        return {"schema": "servofd.fleets/1", **asdict(self)}


def overview(logs: Sequence[dict[str, Any]]) -> Overview:
    """Sum up."""
    names = ("start_utc", "path", "run")
    ordered = sorted(logs, key=lambda log: [log["document"].get(name) or "" for name in names])
    every = [(log, name, entry) for log in ordered for name, entry in log["document"]["surfaces"].items()]
    moved = [(name, entry) for log in ordered for name, entry in log["document"].get("axes", {}).items()]
    surfaces, axes = dict.fromkeys(name for _, name, _ in every), dict.fromkeys(name for name, _ in moved)
    faults, residuals = [], []
    for log, name, entry in every:
        at = _where(log) | {"surface": name}
        faults += [at | fault for fault in entry["faults"]]
        residuals.append(at | {"status": entry["status"], "share": _share(entry)})

    def gravity(log: dict[str, Any]) -> tuple[int, int]:
        """Place of a log among others, by what its faults may do to the aircraft; the worst is first."""
        entries = log["document"]["surfaces"].values()
        return _RANK.index(log_status(log)), gravity_of(fault["kind"] for one in entries for fault in one["faults"])

    return Overview(
        logs=len(ordered),
        hours=sum(log["document"]["duration_s"] or 0.0 for log in ordered) / S_PER_HOUR,
        statuses=dict(Counter(log_status(log) for log in ordered)),
        surfaces=tuple(_count(name, [entry for _, known, entry in every if known == name]) for name in surfaces),
        axes=tuple(_axis_count(name, [entry for axis, entry in moved if axis == name]) for name in axes),
        faults=tuple(faults),
        not_judged=tuple(_where(log) | {"reason": log["not_judged"]} for log in ordered if log["not_judged"]),
        flights=tuple(map(_flight, sorted(ordered, key=gravity))),
        residuals=tuple(residuals),
    )


def log_status(log: dict[str, Any]) -> str:
    """Worst status of a log's surfaces and axes; ``not_judged`` where there is no verdict on it as a whole."""
    document = log["document"]
    statuses = {entry["status"] for entry in (*document["surfaces"].values(), *document.get("axes", {}).values())}
    if log["not_judged"] and "suspect" not in statuses:
        return "not_judged"
    return next((status for status in STATUSES if status in statuses), "not_judged")


def _where(log: dict[str, Any]) -> dict[str, Any]:
    return {key: log["document"].get(key) for key in ("path", "run", "start_utc")}


def _flight(log: dict[str, Any]) -> dict[str, Any]:
    document = log["document"]
    name, outline = worst_outline(document)
    # Why it was not judged, without its name, which stands beside it.
    why = str(document["error"] or "").removeprefix(document["path"])
    why = why.removeprefix(f" (run {document.get('run')})").removeprefix(": ")
    return _where(log) | {
        "duration_s": document["duration_s"],
        "status": log_status(log),
        "sentence": document.get("sentence") or why,
        "page": page_name(document["path"], log.get("content") or ""),
        "surface": name,
        "outline": outline,
    }


def _count(name: str, entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    well = [entry for entry in entries if entry["status"] != "fault"]
    shares = [share for entry in well if (share := _share(entry)) is not None]
    drawn = [ratio for entry in well if (ratio := entry.get("current", {}).get("ratio_to_good")) is not None]
    return {
        "surface": name,
        "servos": list(dict.fromkeys(entry["servo"] for entry in entries)),
        "logs": dict(Counter(entry["status"] for entry in entries)),
        "kinds": dict(Counter(fault["kind"] for entry in entries for fault in entry["faults"])),
        "largest_share": max(shares, default=None),
        "current_ratio": [min(drawn), max(drawn)] if drawn else None,
    }


def _axis_count(name: str, entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    lost = [entry["lost_share"] for entry in entries if entry["status"] == "healthy"]
    left = [1.0 - share for share in lost if share is not None]
    return {
        "axis": name,
        "members": list(dict.fromkeys(member for entry in entries for member in entry["members"])),
        "logs": dict(Counter(entry["status"] for entry in entries)),
        "effect_left": [min(left), max(left)] if left else None,
    }


def _share(entry: dict[str, Any]) -> float | None:
    if entry["residual"] is None or not entry["threshold"]["deg"]:
        return None
    return float(entry["residual"]["max_abs_deg"] / entry["threshold"]["deg"])
