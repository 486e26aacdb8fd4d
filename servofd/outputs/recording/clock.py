"""Time in recordings: whole microseconds since boot, and of the day where the log knows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from datetime import datetime

    from servofd.core.types import FloatArray, IntArray

TIME_BOOT, TIME_UTC = "time_boot", "time_utc"


def microseconds(time_s: FloatArray) -> IntArray:
    """Seconds to the nearest microsecond.

    Examples
    --------
    >>> microseconds(np.array([0.1, 2.000001]))
    array([ 100000, 2000001])
    """
    return np.rint(np.asarray(time_s) * 1e6).astype(np.int64)


def seconds(time_us: IntArray) -> FloatArray:
    """Microseconds to seconds: the same number that a log's own microseconds give.

    Examples
    --------
    >>> seconds(np.array([100_000]))
    array([0.1])
    """
    converted: FloatArray = np.asarray(time_us) / 1e6
    return converted


@dataclass(frozen=True, slots=True)
class Clock:
    """What the time lines of a recording are.

    Parameters
    ----------
    start_utc : datetime or None
        When ``time_s`` was 0; None if the log does not say, and there is no time of the day then.
    """

    start_utc: datetime | None = None

    def columns(self, time_s: FloatArray) -> list[Any]:
        """Time columns for Rerun, from times of shape (n,) [s].

        Floats of seconds would be off by a nanosecond here and there; whole microseconds are exact.
        """
        import rerun as rr

        time_us = microseconds(time_s)
        columns = [rr.TimeColumn(TIME_BOOT, duration=time_us.astype("timedelta64[us]"))]
        if self.start_utc is not None:
            utc_us = time_us + self.start_us
            columns.append(rr.TimeColumn(TIME_UTC, timestamp=utc_us.astype("datetime64[us]")))
        return columns

    @property
    def start_us(self) -> int:
        """Microseconds from 1970 to the start; 0 if it is not known."""
        if self.start_utc is None:
            return 0
        return int(np.datetime64(self.start_utc.replace(tzinfo=None), "us").astype(np.int64))
