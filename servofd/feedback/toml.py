"""A drafted aircraft as a commented TOML file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servofd.core.toml_text import toml_key, toml_lines, toml_value
from servofd.feedback.draft import servo_entry, surface_entry

if TYPE_CHECKING:
    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft
    from servofd.feedback.draft import Draft, DraftedSurface

_ENTRIES = ("servo", "output", "threshold", "threshold_deg", "tolerance", "persistence", "suspicions", "model")


def draft_to_toml(draft: Draft) -> str:
    """Text of an aircraft file that `servofd audit -c` accepts as it is."""
    log = draft.log
    lines = [
        f"# Drafted from {log.source.name} ({', '.join(filter(None, (log.firmware, log.vehicle)))}).",
        "# The servos below were fitted roughly to this one log: a starting point, no calibration. Check the names and",
        "# signs, replace the servos by identified ones (`servofd servos` lists known types), and set thresholds from",
        "# flights that you know to be good. If this flight had a faulty servo, its numbers are wrong.",
        "#",
        *_on_board(log.format),
        "# Tolerances are so wide that this log raises no alarm, but where it contradicts any servo.",
        "",
        f"name = {toml_value(log.vehicle or log.format)}",
    ]
    for surface in draft.surfaces:
        lines += ["", *_surface_lines(surface)]
    return "\n".join(lines) + "\n"


def fitted_to_toml(log: FlightLog, aircraft: Aircraft) -> str:
    """Text of an aircraft file with the servos that were fitted to a table.

    Examples
    --------
    >>> from servofd.feedback.flown import flown_aircraft, one_log
    >>> log = one_log("sample_logs/table_three_faults.csv")
    >>> fitted_to_toml(log, flown_aircraft(log, None)).splitlines()[6]
    '[surfaces.aileron]'
    """
    lines = [
        f"# Drafted from {log.source.name}: each servo is fitted to this one log, a starting point and no calibration.",
        "# If a servo was faulty in it, its numbers are wrong: calibrate on flights that you know to be good.",
        "# Tolerances are so wide that this log raises no alarm, but where it contradicts any servo.",
        "",
        f"name = {toml_value(aircraft.name or log.source.stem)}",
    ]
    for name, surface in aircraft.surfaces.items():
        servo = aircraft.servos[surface.servo].model_copy(update={"source": f"fitted to {log.source.name}"})
        entry = _short(surface.model_dump(exclude_defaults=True, exclude_none=True, mode="json"))
        order = {key: entry[key] for key in _ENTRIES if key in entry} | entry
        lines += ["", f"[surfaces.{toml_key(name)}]", *toml_lines(order)]
        servo_table = servo.model_dump(exclude_defaults=True, exclude_none=True, mode="json")
        lines += ["", f"[servos.{toml_key(surface.servo)}]", *toml_lines(servo_table)]
    return "\n".join(lines) + "\n"


def _short(value: Any) -> Any:  # noqa: ANN401 - whatever a TOML file holds
    """Numbers with six digits."""
    if isinstance(value, dict):
        return {key: _short(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_short(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _peak(surface: DraftedSurface) -> str:
    return f"largest residual in this log: {surface.drafted.peak_deg:.1f} deg" if surface.drafted else ""


def _predicts(surface: DraftedSurface) -> str:
    return "" if surface.drafted else "no servo predicts what this surface did"


def _on_board(format_name: str) -> list[str]:
    """How an ArduPilot watches these servos itself."""
    if format_name not in ("dataflash", "tlog"):
        return []
    return [
        "# Once calibrated, `servofd onboard THIS_FILE.toml -o servofd.lua` makes the autopilot watch these servos",
        "# itself: copy the script to APM/scripts on its SD card and set SCR_ENABLE = 1.",
        "#",
    ]


def _surface_lines(surface: DraftedSurface) -> list[str]:
    pair, output, key = surface.pair, surface.pair.output, toml_key(surface.pair.surface)
    function = "function unknown" if output.function is None else f"SERVO{output.number}_FUNCTION = {output.function}"
    scale = (
        ""
        if pair.command == pair.position.command
        else f"output {output.number}: pulses of {output.min_us:g} to {output.max_us:g} us; scale fitted"
    )
    entry = surface_entry(surface)
    table = {name: entry[name] for name in _ENTRIES if name in entry}
    if pair.position.alive:
        table["alive"] = list(pair.position.alive)
    table |= {"command": surface.command, "measured": surface.measured}
    notes = {
        "threshold_deg": _peak(surface),
        "model": _predicts(surface),
        "alive": "all still, and the position too: dead telemetry",
        "command": scale,
    }
    return [
        f"[surfaces.{key}]  # output {output.number}, {function}",
        *toml_lines(table, notes),
        "",
        f"[servos.{toml_key(f'{pair.surface}-draft')}]",
        *toml_lines(servo_entry(surface)),
    ]
