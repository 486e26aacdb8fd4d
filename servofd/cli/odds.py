"""``servofd config --odds``: how often noise alone raises an alarm, and which faults are seen how soon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from servofd.aircraft.schema import UNKNOWN_SERVO, plain_aircraft
from servofd.batch.key import Job
from servofd.cli.terminal import complain, give_json, progress, show
from servofd.core.errors import ConfigError, NoMeasurement
from servofd.core.files import distinct_file_names, make_folder, write_whole
from servofd.detection.probability import Wish
from servofd.feedback.flown import known_aircraft
from servofd.jobs.odds import LeftOut, odds_from_design, odds_from_logs, parts_of
from servofd.jobs.workflow import FailedLog, judged
from servofd.outputs.figure import chart_png
from servofd.outputs.odds_report import odds_chart, odds_report
from servofd.servo.library import servo_named

if TYPE_CHECKING:
    from servofd.cli.options import Options
    from servofd.detection.probability import SurfaceOdds
    from servofd.jobs.odds import Part

_PLAIN_SURFACE = "surface"


def run(options: Options) -> int:
    """Work out the odds, write what was asked for, and print."""
    wish = Wish(options.false_alarms_per_hour, options.fault_deg)
    if options.log and (options.noise_deg or options.rate_hz):
        raise ConfigError("--noise-deg and --rate-hz describe a design; with --log both are measured: leave them out")
    if options.servo not in (None, UNKNOWN_SERVO):
        servo_named(options.servo)
    odds, left_out, failed = _from_logs(options, wish) if options.log else (_from_design(options, wish), [], {})
    report = odds_report(odds, {part.surface: part.reason for part in left_out}, failed)
    if odds and options.output:
        folder = Path(options.output)
        make_folder(folder)
        with progress("figures", len(odds)) as step:
            for surface, name in zip(odds, distinct_file_names([o.surface for o in odds]), strict=True):
                write_whole(folder / f"odds-{name}.png", chart_png(odds_chart(surface)))
                step(surface.surface)
        give_json(str(folder / "odds.json"), report.data)
    show(report, json=options.json if odds or options.json == "-" else None)
    for error in failed.values():
        complain(error)
    if not odds and not failed:
        why = "; ".join(f"{part.surface}: {part.reason}" for part in left_out) or "no surface is measured"
        complain(f"no healthy surface to learn the odds from: {why}")
    return 2 if failed or not odds else 0


def _from_design(options: Options, wish: Wish) -> list[SurfaceOdds]:
    aircraft = known_aircraft(options.config)
    if options.servo not in (None, UNKNOWN_SERVO):
        named = aircraft or plain_aircraft(options.surface or [_PLAIN_SURFACE], options.servo)
        aircraft = named.with_servo(options.servo)
    if aircraft is None:
        raise ConfigError("odds of what? give an aircraft (-c faser), a servo (--servo NAME) or flights (--log LOG)")
    aircraft.check_names(options.surface)
    if not options.surface and all(surface.measured is None for surface in aircraft.surfaces.values()):
        raise NoMeasurement(f"{options.config}: names no measured channel for any surface")
    return odds_from_design(
        aircraft,
        wish,
        noise_deg=options.noise_deg or 0.1,
        rate_hz=options.rate_hz or 100.0,
        surfaces=tuple(options.surface),
    )


def _from_logs(options: Options, wish: Wish) -> tuple[list[SurfaceOdds], list[LeftOut], dict[str, str]]:
    """Odds of the surfaces, surfaces without, and logs that could not be read."""
    job = Job(known_aircraft(options.config), options.servo, surfaces=tuple(options.surface))
    parts: list[Part | LeftOut] = []
    failed: dict[str, str] = {}
    with progress("odds", len(options.log)) as step:
        for path in options.log:
            for result in judged(path, job):
                if isinstance(result, FailedLog):
                    failed[path] = result.error
                else:
                    parts += parts_of(result)
            step(Path(path).name)
    results = odds_from_logs(parts, wish)
    left_out = [result for result in results if isinstance(result, LeftOut)]
    return [result for result in results if not isinstance(result, LeftOut)], left_out, failed
