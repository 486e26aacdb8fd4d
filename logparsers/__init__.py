"""Flight logs and bench records: bytes in, plain arrays out; knows nothing of servos, models or faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from logparsers.detect import detect
from logparsers.errors import (
    ClockError,
    EmptyLog,
    LogError,
    MissingChannel,
    MissingLog,
    SeveralRuns,
    TruncatedLog,
    UnknownFormat,
    UnreadableLog,
)
from logparsers.only import Only
from logparsers.records import Channel, Damage, FlightLog, Setting, Text
from logparsers.source import LogFile, sources
from logparsers.table import TableLayout, read_table

__all__ = [
    "Channel",
    "ClockError",
    "Damage",
    "EmptyLog",
    "FlightLog",
    "LogError",
    "LogFile",
    "MissingChannel",
    "MissingLog",
    "Setting",
    "SeveralRuns",
    "TableLayout",
    "Text",
    "TruncatedLog",
    "UnknownFormat",
    "UnreadableLog",
    "read",
    "read_all",
]

_NO_LOG = (UnknownFormat, EmptyLog, MissingChannel)
"""Errors of a note or a picture beside the logs of an archive."""


def read(path: LogFile, layout: TableLayout | None = None, *, only: Sequence[str] | None = None) -> FlightLog:
    r"""Read one log.

    Parameters
    ----------
    path : str, PathLike or BinaryIO
        The file, or a binary file object that can seek; it is read from its beginning and left open.
    layout : TableLayout, optional
        How to read a text table with names of its own; other formats describe themselves.
    only : sequence of str, optional
        Channels that are wanted, all if None: names (``"CSRV[0].Pos"``), what they begin with (``"RCOU"``,
        ``"actuator_servos"``), or patterns with ``*`` and ``?``. Those that fit nothing are passed over unless all
        do. Large logs are read faster for it.

    Returns
    -------
    FlightLog
        Its channels, and what is wrong with it. Those of an autopilot's log are decoded when they are looked up.

    Raises
    ------
    LogError
        If the file is of no use as a whole: one line that says what, where, and what would have worked.

    See Also
    --------
    read_all : For files that hold several experiments.

    Examples
    --------
    >>> import io
    >>> log = read(io.BytesIO(b"time_s,elevator_cmd_deg\n0.00,1.5\n0.02,\n0.04,1.7\n"))
    >>> log["elevator_cmd_deg"].values
    array([1.5, nan, 1.7])
    >>> [damage.note for damage in log.damage]
    ['elevator_cmd_deg: 1 of 3 values are missing']
    """
    logs = read_all(path, layout, only=only)
    if len(logs) > 1:
        runs = ", ".join(log.run for log in logs[:12]) + (" ..." if len(logs) > 12 else "")
        column = layout.run if layout else "run"
        raise SeveralRuns(
            f"{logs[0].source}: holds {len(logs)} runs ({runs}); pick one with where = {{{column!r}: {logs[0].run!r}}}"
        )
    return logs[0]


def read_all(
    path: LogFile, layout: TableLayout | None = None, *, only: Sequence[str] | None = None
) -> tuple[FlightLog, ...]:
    r"""Read every run of a file, in the order of the file; all but tables with a run column hold one.

    The parameters are those of `read`.

    Raises
    ------
    LogError
        If the file is of no use as a whole.

    Examples
    --------
    >>> import io
    >>> bench = io.BytesIO(b"run,t_s,cmd,meas\na,0,1,0\na,1,1,1\nb,0,2,0\n")
    >>> [(log.run, log["meas"].values.size) for log in read_all(bench, TableLayout(time="t_s", run="run"))]
    [('a', 2), ('b', 1)]
    """
    wanted = Only.of(only)
    logs: list[FlightLog] = []
    problems: list[LogError] = []
    strange: list[Damage] = []
    with np.errstate(all="ignore"):  # what overflows is counted as damage
        for source in sources(path):
            reader = None
            try:
                reader = detect(source.head, str(source.path))
                found = reader(source, layout, wanted)
                logs += [source.packed(log if log.is_of_autopilot else log.only(wanted)) for log in found]
            except LogError as error:
                problems.append(error)
                if not isinstance(error, _NO_LOG) or reader not in (None, read_table):
                    strange.append(Damage("corrupt", f"not read: {error}"))
    if not logs:
        raise problems[0]
    return (replace(logs[0], damage=(*strange, *logs[0].damage)), *logs[1:]) if strange else tuple(logs)
