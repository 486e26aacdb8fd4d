"""``servofd identify``: from bench tests to a servo."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from servofd.cli.servos import poles_text
from servofd.cli.terminal import check_targets, give_json, progress
from servofd.core.files import make_folder, write_whole
from servofd.feedback.flown import known_aircraft
from servofd.jobs.bench import identify
from servofd.outputs.identify_page import identify_figures, identify_page
from servofd.outputs.identify_recording import save_identification
from servofd.outputs.model_file import servo_file

if TYPE_CHECKING:
    from servofd.cli.options import Options
    from servofd.identification.result import Identification

_STEPS = 3
"""That `identify` tells of."""


def run(options: Options) -> int:
    """Identify, then write all outputs, then print."""
    outputs = (options.json, options.save, options.html, options.rrd)
    check_targets(outputs, {"a log": options.logs, "the aircraft file": [options.config]}, folder=options.output)
    aircraft = known_aircraft(options.config)
    with progress("identify", _STEPS) as step:
        found = identify(
            options.logs, aircraft, surface=options.surface, method=options.method, order=options.order, progress=step
        )
    _write(options, found)
    if not give_json(options.json, found.document()):
        print(_text(found), end="")
    return 0


def _write(options: Options, found: Identification) -> None:
    source = ", ".join(Path(log).name for log in options.logs)
    if options.save:
        write_whole(options.save, servo_file(found, Path(options.save).stem, source).encode())
    if options.html:
        write_whole(options.html, identify_page(found, source).encode())
    if options.rrd:
        save_identification(found, options.rrd, source)
    if options.output:
        _write_folder(Path(options.output), found)


def _write_folder(folder: Path, found: Identification) -> None:
    make_folder(folder)
    for picture in identify_figures(found):
        write_whole(folder / f"{picture.name}.png", picture.png())
    give_json(str(folder / "identify.json"), found.document())


def _text(found: Identification) -> str:
    """Everything that was found, a line each."""
    linear, servo = found.servo.linear, found.servo
    bandwidth = linear.transfer.bandwidth_rad_s
    rows = [
        ("poles [rad/s]", poles_text(found.poles_rad_s), _of_poles(found)),
        ("dc gain", f"{linear.gain:.5g}", _interval(found, "dc_gain")),
        ("delay [ms], hold apart", f"{1e3 * linear.delay_s:.3f}", _interval(found, "delay_s", 1e3)),
        ("total lag [ms]", f"{1e3 * linear.lag_s:.2f}", _interval(found, "lag_s", 1e3)),
        (
            "bandwidth [rad/s]",
            f"{bandwidth:.2f} ({bandwidth / 6.283185307:.3f} Hz)",
            _interval(found, "bandwidth_rad_s"),
        ),
    ]
    for way, rate in (("up", servo.rate_up_deg_s), ("down", servo.rate_down_deg_s)):
        if rate is not None:
            rows.append((f"rate limit {way} [deg/s]", f"{rate:.1f}", _interval(found, f"rate_{way}_deg_s")))
    if servo.dead_band_deg is not None:
        rows.append(("dead band [deg]", f"{servo.dead_band_deg:.2f}", _interval(found, "dead_band_deg")))
    rows.append(("rms error [deg]", f"{found.rms_deg:.4f}", ""))
    if found.band_rad_s is not None and found.max_normalized_error is not None:
        low, high = found.band_rad_s
        rows.append(("normalised error", f"up to {found.max_normalized_error:.3f}", f"{low:.1f} to {high:.1f} rad/s"))
    lines = [f"{found.surface}: order {linear.order}, method {found.method}   (in brackets: 95% intervals)"]
    lines += [f"  {name:<24} {value:<28} {interval}".rstrip() for name, value, interval in rows]
    return "\n".join([*lines, *(f"  - {note}" for note in found.notes)]) + "\n"


def _of_poles(found: Identification) -> str:
    names = [
        name
        for k, pole in enumerate(found.poles_rad_s)
        if pole.imag >= 0.0
        for name in (f"pole_{k}_real_rad_s", f"pole_{k}_imag_rad_s")
        if name in found.intervals
    ]
    return " ".join(_interval(found, name) for name in names)


def _interval(found: Identification, name: str, scale: float = 1.0) -> str:
    interval = found.intervals.get(name)
    return "" if interval is None else f"[{scale * interval.low:.5g}, {scale * interval.high:.5g}]"
