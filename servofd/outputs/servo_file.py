"""An identified servo as a servo file: an entry for an aircraft file, with its intervals and where it comes from."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from servofd.identification.result import Identification

__all__ = ["servo_file"]


def servo_file(found: Identification, name: str, source: str) -> str:
    """Text of a servo file that ``servofd audit --servo`` and an aircraft file's ``[servos]`` take as it is.

    Parameters
    ----------
    found : Identification
        The servo.
    name : str
        Its key.
    source : str
        Where the data came from.
    """
    linear, servo = found.servo.linear, found.servo
    lines = [
        f"# Identified by servofd from {_comment(source)}, method {found.method}.",
        "# Intervals in brackets hold the truth with a probability of 95 %.",
        f"# rms error {found.rms_deg:.4g} deg; bandwidth {linear.transfer.bandwidth_rad_s:.5g} rad/s "
        f"{_interval(found, 'bandwidth_rad_s')}".rstrip(),
        *(f"# note: {_comment(note)}" for note in found.notes),
        "",
        f"[servos.{json.dumps(name)}]",
        f"title = {json.dumps(name)}",
        f"numerator = {_numbers(linear.transfer.numerator)}",
        f"denominator = {_numbers(linear.transfer.denominator)} # poles {_poles(found)} rad/s",
        _line("delay_s", linear.delay_s, _interval(found, "delay_s")),
        'hold = "zoh" # the delay does not contain the hold of the sampled command',
        f"unity_dc = false # dc gain {linear.gain:.5g} {_interval(found, 'dc_gain')}".rstrip(),
    ]
    if found.rate_limit_deg_s is not None:
        each = [
            f"{way} {rate:.4g} {_interval(found, f'rate_{way}_deg_s')}".rstrip()
            for way, rate in (("up", servo.rate_up_deg_s), ("down", servo.rate_down_deg_s))
            if rate is not None
        ]
        lines.append(f"rate_limit_deg_s = {found.rate_limit_deg_s!r} # {', '.join(each)}")
    if servo.dead_band_deg is not None:
        lines.append(_line("free_play_deg", servo.dead_band_deg, _interval(found, "dead_band_deg")))
    lines.append(f"source = {json.dumps('servofd identify: ' + source)}")
    if found.notes:
        lines.append(f"notes = {json.dumps(list(found.notes))}")
    return "\n".join(lines) + "\n"


def _line(key: str, value: float, interval: str) -> str:
    return f"{key} = {value!r}" + (f" # {interval}" if interval else "")


def _interval(found: Identification, name: str) -> str:
    interval = found.intervals.get(name)
    if interval is None or not (math.isfinite(interval.low) and math.isfinite(interval.high)):
        return ""
    return f"[{interval.low:.5g}, {interval.high:.5g}]"


def _numbers(values: Sequence[float]) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


def _poles(found: Identification) -> str:
    return ", ".join(
        f"{p.real:.4g}" + (f" +- {p.imag:.4g}i" if p.imag else "") for p in found.poles_rad_s if p.imag >= 0.0
    )


def _comment(text: str) -> str:
    return " ".join(text.split())
