"""What every verb begins with: the aircraft that is known, its logs, and the surfaces that a log holds."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import logparsers
from servofd.aircraft.schema import UNKNOWN_SERVO, Aircraft, load_aircraft, plain_aircraft, plain_channels
from servofd.core.errors import CalibrationError, ConfigError, NoMeasurement
from servofd.feedback.tables import log_file

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    import pandas as pd

    from logparsers import FlightLog, LogFile

    Log = LogFile | TextIO | pd.DataFrame | Mapping[str, Any]


_BENCH = ("cmd", "meas")
"""Columns of a bench record of one servo: what was asked, and what was measured [deg]."""


def known_aircraft(aircraft: Aircraft | str | Path | None) -> Aircraft | None:
    """What is known of an aircraft: itself, its file, or the name of one that comes with servofd."""
    if isinstance(aircraft, str | Path):
        return load_aircraft(aircraft) if aircraft else None
    return aircraft


def log_files(logs: Log | Sequence[Log]) -> list[LogFile]:
    """One log or several; a table becomes the file that holds it.

    Raises
    ------
    NoMeasurement
        If there is none.
    """
    each: list[Any] = list(logs) if isinstance(logs, list | tuple) else [logs]
    if not each:
        raise NoMeasurement("no log was named; give at least one")
    return [log_file(log) for log in each]


def logs_of(logs: Log | Sequence[Log], aircraft: Aircraft | None = None) -> Iterator[FlightLog]:
    """Every run of every log of an aircraft, in order; what follows a reboot is another flight.

    Parameters
    ----------
    logs : str, Path, open file, DataFrame, dict of arrays, or sequence of them
        A table has a clock (`servofd.feedback.tables.with_clock`) and the columns of a plain table.
    aircraft : Aircraft, optional
        Tells how its tables are to be read.
    """
    for file in log_files(logs):
        for log in logparsers.read_all(file, layout_of(aircraft)):
            yield from log.by_boots()


def each_once(logs: Iterable[FlightLog]) -> Iterator[FlightLog]:
    """The same logs; a flight that comes again, packed or under another name, would count twice.

    Raises
    ------
    CalibrationError
        If one does.
    """
    seen: dict[tuple[object, ...], str] = {}
    for log in logs:
        sizes = {name: channel.time_s.size for name, channel in log.channels.items()}
        content = hashlib.blake2b()
        for name in sorted(log.channels):  # all of them: cycles of a bench share their commands
            content.update(log.channels[name].time_s.tobytes() + log.channels[name].values.tobytes())
        key = (log.start_utc, frozenset(sizes.items()), content.digest())
        if key in seen:
            raise CalibrationError(
                f"{log.label}: the same flight as {seen[key]}, which would count twice; give each flight once"
            )
        seen[key] = log.label
        yield log


def one_log(path: str | Path, aircraft: Aircraft | None = None) -> FlightLog:
    """The only run of a log."""
    return logparsers.read(path, layout_of(aircraft))


def flown_aircraft(
    log: FlightLog, known: Aircraft | None = None, servo: str | None = None, only: Collection[str] = ()
) -> Aircraft:
    """The aircraft that flew a log: as it is known, or as the log shows it, with the servo that was asked for.

    Surfaces whose channels a log lacks are looked for by the outputs of the autopilot that turn them. Servos that the
    aircraft's file does not name are fitted to the log.

    Parameters
    ----------
    known : Aircraft, optional
        What is known of the aircraft; without surfaces, their motion alone.
    servo : str, optional
        Servo of all surfaces: a name of the library, or a servo file; ``unknown`` fits each servo to the log.
    only : collection of str
        Surfaces whose servos are wanted; all if empty.
    """
    own = known is not None and bool(known.surfaces)
    try:
        flown = surfaces_of(log, known, fitted=only)
    except NoMeasurement:
        if known is None or own:
            raise
        return known  # its motion may tell
    if known is not None and not own:
        flown = flown.model_copy(update={"motion": known.motion})
    if servo not in (None, UNKNOWN_SERVO):
        flown = flown.with_servo(servo)  # a saved file may name those of some surfaces alone
    unnamed = [name for name, surface in flown.surfaces.items() if servo == UNKNOWN_SERVO or not surface.names_servo]
    unnamed = [name for name in unnamed if not only or name in only]
    if not unnamed or (log.is_of_autopilot and not own):  # whose surfaces come with servos that were fitted to it
        return flown
    from servofd.feedback.fitted import fitted_aircraft

    return fitted_aircraft(log, flown, unnamed)


def surfaces_of(log: FlightLog, known: Aircraft | None = None, *, fitted: Collection[str] | None = None) -> Aircraft:
    """Surfaces of a known aircraft, or as the channels name them, in the channels of this log.

    Nothing is said of the servos of a plain table. Those of an autopilot's log, and the scales of its pulses, are
    fitted to it for the surfaces in `fitted`, for all if that is empty; if it is left out, nothing is said of them.

    Examples
    --------
    >>> list(surfaces_of(one_log("sample_logs/table_three_faults.csv")).surfaces)
    ['aileron', 'elevator', 'rudder']
    """
    if known is not None and known.surfaces:
        from servofd.aircraft.outputs import resolved

        return resolved(log, known)
    if log.format == "faser":
        faser = load_aircraft("faser")
        logged = {name: s for name, s in faser.surfaces.items() if s.command.channel in log.channels}
        if logged:
            return faser.model_copy(update={"surfaces": logged})
        raise NoMeasurement(
            f"{log.label}: no measured deflection: this log holds {', '.join(list(log.channels)[:8])}; a position "
            "per surface is needed (de_pos, dr_pos, da_l_pos, ...), or an aircraft file (-c) that names other channels"
        )
    if log.is_of_autopilot:
        from servofd.feedback.draft import described_aircraft, draft_aircraft

        return described_aircraft(log) if fitted is None else draft_aircraft(log, fitted)
    if set(_BENCH) <= set(log.channels):
        return load_aircraft("bench")
    names = dict.fromkeys(
        name.removesuffix(suffix) for name in log.channels for suffix in plain_channels("") if name.endswith(suffix)
    )
    if not names:
        raise NoMeasurement(
            f"{log.label}: no surface found: a plain table needs columns <surface>_cmd_deg and <surface>_pos_deg, or "
            "cmd and meas; "
            f"for other names write an aircraft file (-c). Its columns: {', '.join(list(log.channels)[:12])}"
        )
    return plain_aircraft(names)


def layout_of(aircraft: Aircraft | None) -> logparsers.TableLayout | None:
    """How to read a text table that belongs to this aircraft; None if it does not say."""
    if aircraft is None or aircraft.table is None:
        return None
    try:
        return logparsers.TableLayout(**aircraft.table.model_dump())
    except ValueError as error:
        raise ConfigError(f"table: {error}") from None
