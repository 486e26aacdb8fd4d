"""Tables of pandas and arrays as logs: whatever their index, their clock and their columns are called."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any

from logparsers.units import SECONDS
from servofd.aircraft.columns import check_columns
from servofd.core.errors import ConfigError, needs

if TYPE_CHECKING:
    import pandas as pd

    from logparsers import LogFile

_CLOCK = re.compile(r"(?:time|t)(?:[ _]?[\[(]?(s|ms|us|ns)[\])]?)?", re.IGNORECASE)
"""Names of a column that is a clock, and its unit; seconds if it has none."""
_MOTION = re.compile("_(?:cmd|pos)_")
"""Within the name of a command or a position, which is no clock."""
_LOG = "a log is a path, a folder, an open file, a DataFrame or a dict of arrays"


def log_file(log: Any) -> LogFile:  # noqa: ANN401 - whatever a user has
    """A log as a file: paths and open files as they are, a table as the text file that holds it.

    Raises
    ------
    TypeError
        If it is no log.
    ConfigError
        If it is a table without names or a clock.

    Examples
    --------
    >>> log_file({"t": [0.0, 0.1], "rudder_cmd_deg": [0.0, 1.0], "rudder_pos_deg": [0.0, 0.9]}).read().split()[0]
    b'time_s,rudder_cmd_deg,rudder_pos_deg'
    """
    if isinstance(log, str | PathLike):
        return log
    if isinstance(log, io.TextIOBase):
        return _named(log.read().encode(), str(getattr(log, "name", "text")))
    if hasattr(log, "read") and not is_table(log):  # a table may have a column of that name
        file: LogFile = log
        return file
    table = frame_of(log)
    return _named(with_clock(table).to_csv(index=False).encode(), "dict" if isinstance(log, Mapping) else "DataFrame")


def is_table(log: object) -> bool:
    """Whether it is a table in memory, and no file."""
    return isinstance(log, Mapping) or hasattr(log, "columns") or hasattr(log, "to_pandas")


def frame_of(log: Any) -> pd.DataFrame:  # noqa: ANN401 - whatever a user has
    """A table in memory as a DataFrame; of what is not from pandas by its ``to_pandas``."""
    if not is_table(log):
        raise TypeError(f"{_LOG}, and not of type {type(log).__name__}")
    needs("pandas")
    import pandas as pd

    if isinstance(log, Mapping):
        try:
            return pd.DataFrame(dict(log))
        except ValueError as error:
            raise ConfigError(f"dict: {error}; a log is one array for each column, all of one length") from None
    table = log.to_pandas() if hasattr(log, "to_pandas") else log
    if not isinstance(table, pd.DataFrame):
        raise TypeError(f"{_LOG}, and not of type {type(log).__name__}")
    return table


def as_described(table: pd.DataFrame, columns: Mapping[str, str]) -> tuple[pd.DataFrame, dict[str, str]]:
    """A table with its clock as ``time_s``, and what its columns are (`servofd.aircraft.columns`), that one included.

    Raises
    ------
    ConfigError
        If it has no such column.

    Examples
    --------
    >>> import pandas as pd
    >>> table, columns = as_described(pd.DataFrame({"ticks": [0, 20]}), {"ticks": "time_ms"})
    >>> table.time_s.tolist(), columns
    ([0.0, 0.02], {'time_s': 'time_s'})
    """
    table = table.rename(columns=str)
    meant = {str(name): meaning for name, meaning in columns.items()}
    check_columns(meant, list(table.columns))
    clock = next((name for name, meaning in meant.items() if meaning.startswith("time_")), None)
    table = with_clock(table) if clock is None else _first(table.drop(columns=clock), table[clock], meant.pop(clock))
    runs = {"run": "run"} if "run" in table.columns and "run" not in meant.values() else {}
    return table, meant | runs | {"time_s": "time_s"}


def with_clock(table: pd.DataFrame) -> pd.DataFrame:
    """The same table with its clock as column ``time_s``, first.

    The clock is a column ``time_s``; or else the index, if it holds times or is called so; or the only column that
    holds times; or one that is called time or t, with or without its unit.

    Raises
    ------
    ConfigError
        If the columns have no names, or none is a clock.

    Examples
    --------
    >>> import pandas as pd
    >>> index = pd.to_datetime(["2026-05-01 10:00:00.00", "2026-05-01 10:00:00.25"])
    >>> with_clock(pd.DataFrame({"rudder_cmd_deg": [0.0, 1.0]}, index=index)).time_s.tolist()
    [0.0, 0.25]
    """
    if table.columns.nlevels > 1:
        raise ConfigError(f"DataFrame: its columns have {table.columns.nlevels} levels of names; give each one name")
    names = list(table.columns)
    unnamed = [name for name in names if not isinstance(name, str)]
    if unnamed:
        raise ConfigError(f"DataFrame: column {unnamed[0]!r} has a number for a name; name the columns")
    if names and "t_s" in names and "time_s" not in names:
        return table
    if "time_s" in names:
        clock = table["time_s"]
        if clock.ndim > 1 or _seconds(clock) is None:
            return table  # the reader says what is wrong with it
        return table.assign(time_s=_seconds(clock))
    index = table.index.to_series()
    if _is_time(index.dtype) or _CLOCK.fullmatch(str(table.index.name)):
        return _first(table, index, str(table.index.name))
    times = [name for name in names if _is_time(table[name].dtype)] if table.columns.is_unique else []
    times = times or [name for name in names if _CLOCK.fullmatch(name)]
    if len(times) != 1:
        raise _without_clock(names, times)
    return _first(table.drop(columns=times[0]), table[times[0]], times[0])


def _without_clock(names: list[str], times: list[str]) -> ConfigError:
    found = f"{' and '.join(times)} may be" if times else f"none of its columns ({_some(names)}) is"
    likely = times or [name for name in names if not _MOTION.search(name)] or ["t"]
    return ConfigError(
        f"DataFrame: {found} the time; say which: columns={{{likely[0]!r}: 'time_s'}}, or make it the index"
    )


def _first(table: pd.DataFrame, clock: pd.Series[Any], name: str) -> pd.DataFrame:
    from pandas.api.types import is_numeric_dtype

    seconds = _seconds(clock)
    if seconds is None:
        found = _CLOCK.fullmatch(name)
        unit_s = SECONDS[((found and found[1]) or "s").lower()]
        seconds = clock * unit_s if is_numeric_dtype(clock) else clock  # the reader says what is no number
    rest = table.reset_index(drop=True)
    rest.insert(0, "time_s", seconds.to_numpy())
    return rest


def _seconds(clock: pd.Series[Any]) -> pd.Series[Any] | None:
    """Dates, durations, or dates as text as seconds from the first; None if it is neither."""
    import pandas as pd

    if not _is_time(clock.dtype):
        if not isinstance(clock.dtype, pd.StringDtype):
            return None
        if pd.to_numeric(clock, errors="coerce").notna().any():
            return None  # numbers as text, which the reader reads
        try:
            clock = pd.to_datetime(clock, format="mixed")
        except (ValueError, TypeError):
            return None
    elapsed: Any = clock - clock.iloc[0] if clock.dtype.kind == "M" and clock.size else clock
    return elapsed / pd.Timedelta(1, "s") if clock.size else clock.astype(float)


def _is_time(dtype: object) -> bool:
    return getattr(dtype, "kind", "") in ("M", "m")


def _named(content: bytes, name: str) -> io.BytesIO:
    file = io.BytesIO(content)
    file.name = name
    return file


def _some(names: list[str]) -> str:
    return ", ".join(names[:12]) or "it has none"
