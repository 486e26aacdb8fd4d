"""What a file is that no reader knows, and the columns of a table of text: its names, a few rows, which are numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from logparsers import LogError
from logparsers.source import heads
from logparsers.text import read_grid

_HEAD_BYTES = 64 * 1024
"""Beginning of a file that is read for the preview."""
_MOSTLY = 0.9
"""Share of the cells of a column that have to be numbers for a column of numbers; the others are missing or damaged."""
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")
_TIME = re.compile(r"(?:time|t|timestamp|seconds?|elapsed)(?:[ _]?[\[(]?(s|sec|ms|us|ns)[\])]?)?", re.IGNORECASE)
_ASKED = re.compile(r"cmd|command|ref\b|reference|setpoint|target|demand|desired|asked|input|soll", re.IGNORECASE)
_DONE = re.compile(r"pos|meas|actual|feedback|angle|encoder|response|output|ist\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Preview:
    """The beginning of a table."""

    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: frozenset[str]
    """Columns of numbers."""

    @property
    def is_table(self) -> bool:
        """Whether two columns of it are numbers: a clock, and something that was recorded."""
        return len(self.numeric) > 1

    def guessed(self) -> dict[str, str]:
        """What the columns may be, by their names; see `servofd.aircraft.columns`.

        Examples
        --------
        >>> Preview(("t [ms]", "de_cmd", "de_pos", "note"), (), frozenset({"t [ms]", "de_cmd", "de_pos"})).guessed()
        {'t [ms]': 'time_ms', 'de_cmd': 'de_cmd_deg', 'de_pos': 'de_pos_deg'}
        """
        known = [name for name in self.names if name in self.numeric]
        clock = next((name for name in known if _TIME.fullmatch(name)), None)
        unit = (_TIME.fullmatch(clock or "t") or [None, None])[1] or "s"
        found = {} if clock is None else {clock: f"time_{unit.replace('sec', 's').lower()}"}
        if "run" in self.names:
            found["run"] = "run"
        done = {_DONE.sub("", name): name for name in known if _DONE.search(name) and name not in found}
        for name in known:
            stem = _ASKED.sub("", name)
            if name in found or not _ASKED.search(name) or stem not in done:
                continue
            surface = re.sub(r"_(?:deg|rad|us)\b", "", re.sub(r"\W+|__+", "_", stem)).strip("_") or "servo"
            found |= {name: f"{surface}_cmd_{_unit(name)}", done[stem]: f"{surface}_pos_{_unit(done[stem])}"}
        return found


def _unit(name: str) -> str:
    return next((unit for unit in ("rad", "us") if re.search(rf"(?:_|\b){unit}\b", name)), "deg")


def text_of(path: Path) -> bytes:
    """The beginning of a file if it is text, packed or not, without its last line; empty if it is something else."""
    try:
        head = heads(path, _HEAD_BYTES)[0]
    except (LogError, IndexError):
        return b""
    return b"" if _CONTROL.search(head) else head.rpartition(b"\n")[0] or head


def preview(path: Path) -> Preview | None:
    """The beginning of a table of text; None if it has no columns."""
    try:
        grid = read_grid(path, text_of(path))
    except LogError:
        return None
    if len(grid.names) < 2:
        return None
    few = (1.0 - _MOSTLY) * grid.row.size
    numeric = {name for name, cells in grid.cells.items() if cells.has_number and cells.strange <= few}
    return Preview(grid.names, grid.first, frozenset(numeric))


def what_it_is(path: Path) -> str:
    """What a file is that is no log, as far as it is text; empty if it is not."""
    lines = text_of(path).decode(errors="replace").lstrip("\ufeff").splitlines()
    first = next((line.strip() for line in lines if line.strip()), "")
    if not first:
        return ""
    return f"text that begins with “{first[:40]}”, and not a table of numbers"
