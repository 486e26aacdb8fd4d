"""``servofd config --servos``: the library."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

from logparsers.units import MS_PER_S
from servofd.cli.terminal import print_table, say
from servofd.servo.library import library

if TYPE_CHECKING:
    from servofd.cli.options import Options
    from servofd.core.types import ComplexArray
    from servofd.servo.library import Servo


def run(options: Options) -> int:
    """Print the table."""
    servos = library()
    if options.json:
        say(json.dumps({name: _record(servo) for name, servo in servos.items()}, indent=2))
        return 0
    rows = [[name, *_row(servo)] for name, servo in servos.items()]
    print_table(
        [
            "servo",
            "poles [rad/s]",
            "dc gain",
            "bandwidth [rad/s] [Hz]",
            "rate [deg/s]",
            "delay [ms]",
            "source",
        ],
        rows,
    )
    say(
        "Bandwidth: 3.00 dB below dc. Delay: transport delay used in simulation, without the hold of the sampled\n"
        "command; in brackets the printed one where it contains that hold. dc gain: as printed; servofd scales it to 1."
    )
    if options.notes:
        for name, servo in servos.items():
            say(f"\n{name}: {servo.title}")
            for note in servo.notes:
                say(f"  - {note}")
    return 0


def _row(servo: Servo) -> list[str]:
    bandwidth_rad_s = servo.printed.bandwidth_rad_s
    delay = f"{MS_PER_S * servo.transport_delay_s:g}"
    return [
        poles_text(servo.printed.poles_rad_s),
        f"{servo.printed.dc_gain:.5f}",
        f"{bandwidth_rad_s:.2f}  {bandwidth_rad_s / (2 * math.pi):.2f}",
        f"{servo.rate_limit_deg_s:g}" if servo.rate_limit_deg_s else "-",
        delay if servo.hold == "zoh" else f"{delay} ({MS_PER_S * servo.delay_s:g})",
        servo.source,
    ]


def poles_text(poles_rad_s: ComplexArray) -> str:
    """Real poles, then pairs, of which each is listed once [rad/s]."""
    real = [f"{p.real:.2f}" for p in poles_rad_s if p.imag == 0.0]
    pairs = [f"{p.real:.2f} ± {p.imag:.2f}i" for p in poles_rad_s if p.imag > 0.0]
    return ", ".join(real + pairs)


def _record(servo: Servo) -> dict[str, Any]:
    transfer = servo.printed
    return {
        **servo.model_dump(exclude_none=True),
        "numerator": transfer.numerator,
        "denominator": transfer.denominator,
        "poles_rad_s": [[p.real, p.imag] for p in transfer.poles_rad_s],
        "dc_gain": transfer.dc_gain,
        "bandwidth_rad_s": transfer.bandwidth_rad_s,
        "transport_delay_s": servo.transport_delay_s,
    }
