"""Motion of any log, by its kind."""

from __future__ import annotations

from collections.abc import Mapping

from logparsers.records import FlightLog
from servofd.axes.motion import Motion, motion_of_autopilot, motion_of_table
from servofd.axes.px4 import motion_of_px4


def motion_of(log: FlightLog, rate_hz: float | None = None, parameters: Mapping[str, float] | None = None) -> Motion:
    """Commands and motion of a log on one grid of time.

    `log`: of an autopilot, or a table with the columns of `servofd.axes.motion`. `rate_hz`: of the grid; None: what the
    log has. `parameters`: SERVOn_... of an autopilot, to assume where the log has none.
    """
    if log.format == "ulog":
        return motion_of_px4(log, rate_hz)
    if log.is_of_autopilot:
        return motion_of_autopilot(log, rate_hz, parameters)
    return motion_of_table(log, rate_hz)
