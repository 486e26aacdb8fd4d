"""``servofd config --odds``: how often noise alone raises an alarm, and which offsets are seen in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from servofd.aircraft.schema import UNKNOWN_SERVO, plain_aircraft
from servofd.batch.key import Job
from servofd.cli.options import Options
from servofd.cli.terminal import complain, progress, show
from servofd.core.errors import ConfigError, NoMeasurement
from servofd.detection.probability import smallest_offset_deg
from servofd.detection.verdict import LogAudit
from servofd.feedback.flown import known_aircraft
from servofd.jobs.odds import SurfaceOdds, odds_from_design, odds_from_logs
from servofd.jobs.workflow import FailedLog, judged
from servofd.outputs.document import Bullets, Document, Table
from servofd.servo.library import servo_named

_PLAIN_SURFACE = "surface"
_WITHIN_S = 0.2
"""Time within which an offset is to be seen [s]."""
_RAREST = 1e-100
"""Rates below this are shown as that [1/h]."""


def run(options: Options) -> int:
    """Work out the odds, write what was asked for, and print."""
    if options.log and (options.noise_deg or options.rate_hz):
        raise ConfigError("--noise-deg and --rate-hz describe a design; with --log both are measured: leave them out")
    if options.servo not in (None, UNKNOWN_SERVO):
        servo_named(options.servo)
    failed: dict[str, str] = {}
    if options.log:
        odds, missing = odds_from_logs(_audits(options, failed))
    else:
        odds, missing = _from_design(options), {}
    report = _report(odds, options.false_alarms_per_hour, missing, failed)
    show(report, json=options.json if odds or options.json == "-" else None)
    for error in failed.values():
        complain(error)
    if not odds and not failed:
        why = "; ".join(f"{name}: {reason}" for name, reason in missing.items()) or "no surface is measured"
        complain(f"no healthy surface to learn the odds from: {why}")
    return 2 if failed or not odds else 0


def _from_design(options: Options) -> list[SurfaceOdds]:
    aircraft = known_aircraft(options.config)
    if options.servo not in (None, UNKNOWN_SERVO):
        named = aircraft or plain_aircraft(options.surface or [_PLAIN_SURFACE], options.servo)
        aircraft = named.with_servo(options.servo)
    if aircraft is None:
        raise ConfigError("odds of what? give an aircraft (-c faser), a servo (--servo NAME) or flights (--log LOG)")
    aircraft.check_names(options.surface)
    if not options.surface and all(surface.measured is None for surface in aircraft.surfaces.values()):
        raise NoMeasurement(f"{options.config}: names no measured channel for any surface")
    noise_deg, rate_hz = options.noise_deg or 0.1, options.rate_hz or 100.0
    return odds_from_design(aircraft, noise_deg=noise_deg, rate_hz=rate_hz, surfaces=tuple(options.surface))


def _audits(options: Options, failed: dict[str, str]) -> list[LogAudit]:
    """Audits of the logs; what could not be read goes to `failed`."""
    job = Job(known_aircraft(options.config), options.servo, surfaces=tuple(options.surface))
    audits: list[LogAudit] = []
    with progress("odds", len(options.log)) as step:
        for path in options.log:
            for result in judged(path, job):
                if isinstance(result, FailedLog):
                    failed[path] = result.error
                else:
                    audits.append(result)
            step(Path(path).name)
    return audits


def _report(
    odds: Sequence[SurfaceOdds], wished_per_hour: float, missing: Mapping[str, str], failed: Mapping[str, str]
) -> Document:
    """One column per surface (schema servofd.odds/1)."""
    data = {one.surface: _numbers(one, wished_per_hour) for one in odds}
    columns = [_column(numbers) for numbers in data.values()]
    rows = [[name, *(column[name] for column in columns)] for name in columns[0]] if columns else []
    notes = [f"{one.surface}: {note}" for one in odds for note in one.notes]
    notes += [f"{name}: nothing healthy to learn from: {reason}" for name, reason in missing.items()]
    result = {"schema": "servofd.odds/1", "surfaces": data, "missing": {**failed, **missing}}
    return Document("Odds", "no_data", "", parts=[Table("", ["", *data], rows), Bullets(notes)], data=result)


def _numbers(odds: SurfaceOdds, wished_per_hour: float) -> dict[str, Any]:
    noise = odds.noise
    wished_deg = noise.threshold_deg(wished_per_hour)
    return {
        "servo": odds.servo,
        "sample_rate_hz": 1.0 / noise.sample_time_s,
        "filter_pole_rad_s": odds.design.pole_rad_s,
        "healthy_hours": odds.hours,
        "alarms_counted": odds.alarms,
        "notes": list(odds.notes),
        "residual": {"mean_deg": noise.mean_deg, "std_deg": noise.sigma_deg, "correlation": noise.correlation},
        "wished": {"false_alarms_per_hour": wished_per_hour, "threshold_deg": {"gaussian": wished_deg}},
        "at_threshold_in_force": _at(odds, odds.threshold_deg),
        "at_wished_threshold": _at(odds, wished_deg),
    }


def _at(odds: SurfaceOdds, threshold_deg: float) -> dict[str, Any]:
    bias_deg = smallest_offset_deg(odds.design, threshold_deg, odds.noise, _WITHIN_S)
    return {
        "threshold_deg": threshold_deg,
        "false_alarms_per_hour": {"gaussian": odds.noise.false_alarms_per_hour(threshold_deg)},
        "smallest_bias_deg": {f"within_{_WITHIN_S:g}_s": bias_deg},
    }


def _column(numbers: Mapping[str, Any]) -> dict[str, str]:
    residual, now, then = numbers["residual"], numbers["at_threshold_in_force"], numbers["at_wished_threshold"]
    rate_per_hour, hours = now["false_alarms_per_hour"]["gaussian"], numbers["healthy_hours"]
    seen = f"  offset seen within {_WITHIN_S:g} s, 99% [deg]"
    (seen_deg,), (then_deg,) = (at["smallest_bias_deg"].values() for at in (now, then))
    return {
        "servo": numbers["servo"],
        "sample rate [Hz], filter pole [rad/s]": f"{numbers['sample_rate_hz']:.4g}, {numbers['filter_pole_rad_s']:g}",
        "residual sigma [deg], rho1": f"{residual['std_deg']:.4f}, {residual['correlation']:.3f}",
        "threshold in force [deg]": f"{now['threshold_deg']:g}",
        "  false alarms/h, Gaussian": f"{rate_per_hour:.1e}" if rate_per_hour > _RAREST else f"below {_RAREST:g}",
        "  alarms in healthy flights": f"{numbers['alarms_counted']} in {hours:.3g} h" if hours else "none (design)",
        seen: f"{seen_deg:.2f}",
        f"threshold for {numbers['wished']['false_alarms_per_hour']:g}/h [deg]": f"{then['threshold_deg']:.3f}",
        f"{seen}, then": f"{then_deg:.2f}",
    }
