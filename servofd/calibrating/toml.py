"""A calibrated aircraft as a commented TOML file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servofd.toml_text import toml_inline, toml_key, toml_value

if TYPE_CHECKING:
    from servofd.calibrating.result import CalibratedSurface, Calibration
    from servofd.servos import Servo

__all__ = ["calibration_to_toml"]

_UNITS = {"bandwidth_hz": "Hz", "damping": "", "delay_s": "s", "rate_limit_deg_s": "deg/s"}


def calibration_to_toml(calibration: Calibration) -> str:
    """Text of an aircraft file that `servofd audit -c` accepts, with intervals and provenance as comments."""
    aircraft = calibration.aircraft
    logs = {record.label: None for one in calibration.surfaces for record in one.flights}
    lines = [
        f"# Calibrated by `servofd calibrate` from {', '.join(logs)}: flights taken to be good.",
        f"# Thresholds are for {calibration.false_alarms_per_hour:g} false alarms per hour of the whole aircraft.",
        "# Numbers in square brackets behind a # are 95 % intervals.",
        "",
        f"name = {toml_value(aircraft.name)}",
    ]
    if aircraft.table is not None:
        lines += ["", "[table]", *_plain(aircraft.table.model_dump(exclude_defaults=True))]
    found = {one.surface: one for one in calibration.surfaces}
    for name in aircraft.surfaces:
        lines += ["", *_surface(calibration, name, found.get(name))]
    for name, servo in aircraft.servos.items():
        one = next((one for one in found.values() if aircraft.surfaces[one.surface].servo == name), None)
        lines += ["", *_servo(name, servo, one)]
    return "\n".join(lines) + "\n"


def _plain(table: dict[str, Any]) -> list[str]:
    return [
        f"{toml_key(key)} = {toml_inline(value) if isinstance(value, dict) else toml_value(value)}"
        for key, value in table.items()
        if value is not None
    ]


def _surface(calibration: Calibration, name: str, one: CalibratedSurface | None) -> list[str]:
    entry = calibration.aircraft.surfaces[name].model_dump(exclude_defaults=True)
    entry = {"servo": calibration.aircraft.surfaces[name].servo, **entry}
    lines = [f"[surfaces.{toml_key(name)}]"]
    if one is None:
        return [*lines, f"# not calibrated: {calibration.kept.get(name, 'not asked for')}", *_plain(entry)]
    fit, levels = one.fit, one.levels
    lines += [f"# note: {note}" for note in one.notes]
    comments = {
        "measured": f"in degrees of the command: position = {fit.gain.value:.4f} [{fit.gain.low:.4f}, "
        f"{fit.gain.high:.4f}] x command {fit.offset_deg.value:+.3f} [{fit.offset_deg.low:+.3f}, "
        f"{fit.offset_deg.high:+.3f}] deg before",
        "threshold": f"median level {levels.interval_deg:.2f} deg; the largest residual reached "
        f"{levels.peak_ratio:.0%} of its level in {_duration(levels.hours)}",
        "threshold_deg": f"for `--threshold constant`; residual {levels.residual_std_deg:.3f} deg std, "
        f"{levels.residual_peak_deg:.2f} deg at most",
        "suspicions": "off: below the threshold good flights look suspect, as the model does not reach the noise",
        "tolerance": f"from {one.stretches} stretches with motion; never below a third of a fleet's",
    }
    entry.setdefault("threshold_deg", calibration.aircraft.surfaces[name].threshold_deg)
    for line in _plain(entry):
        comment = comments.get(line.split(" = ")[0])
        lines.append(f"{line}  # {comment}" if comment else line)
    return lines


def _servo(name: str, servo: Servo, one: CalibratedSurface | None) -> list[str]:
    lines = [f"[servos.{toml_key(name)}]"]
    if one is not None:
        for number, estimate in one.fit.numbers.items():
            unit = f" {_UNITS[number]}" if _UNITS[number] else ""
            lines.append(f"# {number}: {estimate.value:.4g} [{estimate.low:.4g}, {estimate.high:.4g}]{unit}")
        lines += [f"# {number}: kept from the file before; {reason}" for number, reason in one.fit.kept.items()]
        lines.append(f"# noise of the position: {one.fit.noise_deg:.3f} deg")
    dump = servo.model_dump(exclude_defaults=True)
    return [*lines, *_plain(dump)]


def _duration(hours: float) -> str:
    """Time in words.

    >>> _duration(0.02), _duration(2.5)
    ('72 s', '2.5 h')
    """
    return f"{3600.0 * hours:.0f} s" if hours < 0.1 else f"{hours:.2g} h"
