"""Motion of any log that has it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servofd.axes.autopilot import motion_of_autopilot
from servofd.axes.table import motion_of_table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from logparsers.records import FlightLog
    from servofd.axes.motion import Motion


def motion_of(log: FlightLog, rate_hz: float | None = None, parameters: Mapping[str, float] | None = None) -> Motion:
    """Commands and motion of a log on one grid of time.

    Parameters
    ----------
    log : FlightLog
        Of an autopilot, or a table with the columns of `servofd.axes.table`.
    rate_hz : float, optional
        Of the grid; None: what the log has.
    parameters : mapping of str to float, optional
        SERVOn_... of an autopilot, to assume where the log has none.
    """
    if log.is_of_autopilot:
        return motion_of_autopilot(log, rate_hz, parameters)
    return motion_of_table(log, rate_hz)
