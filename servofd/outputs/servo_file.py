"""An identified servo as a servo file: an entry for an aircraft file, with its intervals and where it comes from."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from servofd.core.toml_text import toml_key, toml_lines
from servofd.feedback.fitted import levels_of
from servofd.servo.library import Servo
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from servofd.identification.result import Identification

_LEVELS = (
    "# How a surface is judged that this servo turns: its tests are healthy by it. --servo takes it along; in an",
    "# aircraft file these keys belong to the surface.",
)


def servo_file(found: Identification, name: str, source: str) -> str:
    """Text of a servo file that ``servofd audit --servo`` and an aircraft file's ``[servos]`` take as it is.

    Parameters
    ----------
    source : str
        Where the data came from.
    """
    linear, servo = found.servo.linear, found.servo
    rates = [
        f"{way} {rate:.4g} {_interval(found, f'rate_{way}_deg_s')}".rstrip()
        for way, rate in (("up", servo.rate_up_deg_s), ("down", servo.rate_down_deg_s))
        if rate is not None
    ]
    table = {
        "title": name,
        "numerator": [float(value) for value in linear.transfer.numerator],
        "denominator": [float(value) for value in linear.transfer.denominator],
        "delay_s": linear.delay_s,
        "hold": "zoh",
        "unity_dc": False,
        "rate_limit_deg_s": found.rate_limit_deg_s,
        "free_play_deg": servo.dead_band_deg,
        "source": f"servofd identify: {source}",
        "notes": list(found.notes) or None,
    }
    comments = {
        "denominator": f"poles {_poles(found)} rad/s",
        "delay_s": _interval(found, "delay_s"),
        "hold": "the delay does not contain the hold of the sampled command",
        "unity_dc": f"dc gain {linear.gain:.5g} {_interval(found, 'dc_gain')}".rstrip(),
        "rate_limit_deg_s": ", ".join(rates),
        "free_play_deg": _interval(found, "dead_band_deg"),
    }
    lines = [
        f"# Identified by servofd from {_comment(source)}, method {found.method}.",
        "# Intervals in brackets hold the truth with a probability of 95 %.",
        f"# rms error {found.rms_deg:.4g} deg; bandwidth {linear.transfer.bandwidth_rad_s:.5g} rad/s "
        f"{_interval(found, 'bandwidth_rad_s')}".rstrip(),
        *(f"# note: {_comment(note)}" for note in found.notes),
        "",
        f"[servos.{toml_key(name)}]",
        *toml_lines(table, comments),
    ]
    servo_entry = Servo.model_validate({key: value for key, value in table.items() if value is not None})
    levels = levels_of(ServoModel.of(servo_entry), found.segments)
    if levels:
        lines += ["", *_LEVELS, "[surface]", *toml_lines(levels)]
    return "\n".join(lines) + "\n"


def _interval(found: Identification, name: str) -> str:
    interval = found.intervals.get(name)
    if interval is None or not (math.isfinite(interval.low) and math.isfinite(interval.high)):
        return ""
    return f"[{interval.low:.5g}, {interval.high:.5g}]"


def _poles(found: Identification) -> str:
    return ", ".join(
        f"{p.real:.4g}" + (f" +- {p.imag:.4g}i" if p.imag else "") for p in found.poles_rad_s if p.imag >= 0.0
    )


def _comment(text: str) -> str:
    return " ".join(text.split())
