"""An identification as one HTML page that needs nothing else: no network, no script."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from servofd.outputs.identify_figures import identify_figures
from servofd.outputs.page import page

if TYPE_CHECKING:
    from servofd.identification.result import Identification


def identify_page(found: Identification, source: str) -> str:
    """Text of the page.

    Parameters
    ----------
    source : str
        Where the data came from.
    """
    return page(
        "identify.html",
        surface=found.surface,
        sentence=sentence_of(found),
        method=found.method,
        source=source,
        rows=identified(found),
        notes=found.notes,
        pictures=identify_figures(found),
    )


def sentence_of(found: Identification) -> str:
    """What was identified, in a sentence."""
    linear = found.servo.linear
    bandwidth = linear.transfer.bandwidth_rad_s
    sentence = f"a servo of order {linear.order}, delay {1e3 * linear.delay_s:.3g} ms"
    if math.isfinite(bandwidth):
        sentence += f", bandwidth {bandwidth:.3g} rad/s"
    return f"{sentence}; the fit leaves {found.rms_deg:.3g} deg rms"


def identified(found: Identification) -> list[tuple[str, str, str]]:
    """Each number, its value, and its 95 % interval if it has one."""
    linear, servo = found.servo.linear, found.servo
    values: dict[str, tuple[str, float | None, float]] = {
        "dc_gain": ("dc gain", linear.gain, 1.0),
        "delay_s": ("delay [ms]", linear.delay_s, 1e3),
        "lag_s": ("total lag [ms]", linear.lag_s, 1e3),
        "bandwidth_rad_s": ("bandwidth [rad/s]", linear.transfer.bandwidth_rad_s, 1.0),
        "rate_up_deg_s": ("rate limit up [deg/s]", servo.rate_up_deg_s, 1.0),
        "rate_down_deg_s": ("rate limit down [deg/s]", servo.rate_down_deg_s, 1.0),
        "dead_band_deg": ("dead band [deg]", servo.dead_band_deg, 1.0),
    }
    for k, pole in enumerate(found.poles_rad_s):
        values[f"pole_{k}_real_rad_s"] = (f"pole {k + 1}, real part [rad/s]", pole.real, 1.0)
        if pole.imag:
            values[f"pole_{k}_imag_rad_s"] = (f"pole {k + 1}, imaginary part [rad/s]", pole.imag, 1.0)
    rows = []
    for name, (label, value, scale) in values.items():
        if value is not None and math.isfinite(value):
            interval = found.intervals.get(name)
            shown = "" if interval is None else f"{scale * interval.low:.5g} to {scale * interval.high:.5g}"
            rows.append((label, f"{scale * value:.5g}", shown))
    return [*rows, ("rms error [deg]", f"{found.rms_deg:.4g}", "")]
