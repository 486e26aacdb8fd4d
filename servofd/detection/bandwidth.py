"""Whether what arrives is enough for what a servo can do."""

from __future__ import annotations

import math

_SAMPLES_PER_PERIOD = 4.0
"""Of the servo's bandwidth; twice what the sampling theorem asks for."""


def too_slow(bandwidth_rad_s: float, position_period_s: float, command_period_s: float) -> str:
    """What comes too slowly for the bandwidth of a servo, in words; empty if nothing does or periods are NaN.

    Examples
    --------
    >>> too_slow(28.5, 1.0 / 12.0, 0.02)
    'position at 12 Hz: slow for a servo of 4.5 Hz, which needs 18 Hz'
    >>> too_slow(28.5, 0.04, 0.02)
    ''
    """
    bandwidth_hz = bandwidth_rad_s / (2.0 * math.pi)
    enough_hz = _SAMPLES_PER_PERIOD * bandwidth_hz
    periods_s = {"position": position_period_s, "command": command_period_s}
    slow = [f"{what} at {1.0 / s:.3g} Hz" for what, s in periods_s.items() if s * enough_hz > 1.0]
    if not slow:
        return ""
    return f"{' and '.join(slow)}: slow for a servo of {bandwidth_hz:.2g} Hz, which needs {enough_hz:.2g} Hz"
