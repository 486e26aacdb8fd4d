"""Faults in words, and what comes too slowly."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from servofd.detection.bank.flight import Fault

_SAMPLES_PER_PERIOD = 4.0
"""Of the servo's bandwidth; twice what the sampling theorem asks for."""
_NAMES = {
    "stuck": "stuck at {position_deg:.1f} deg",
    "bias": "off by {bias_deg:+.1f} deg",
    "hardover": "ran to {position_deg:.1f} deg and stays there",
    "floating": "floating: moves by itself within about ±{amplitude_deg:.1f} deg",
    "oscillation": "oscillates by ±{amplitude_deg:.1f} deg at {frequency_hz:.2f} Hz",
    "deadband": "dead band, stiction or play of {width_deg:.1f} deg",
    "loss_of_effectiveness": "moves by only {gain:.0%} of its command",
    "unknown": "left the model in a way that no known fault explains",
    "healthy": "away from its model for longer than chance allows, yet within the tolerances of a working servo,",
}
_SLOW = {
    "bandwidth_scale": "slow: {bandwidth_scale:.0%} of its bandwidth is left",
    "rate_limit_deg_s": "slow: no faster than {rate_limit_deg_s:.0f} deg/s",
}
_SURE = 0.95
_PERHAPS = {
    "bias": "an offset",
    "hardover": "run to its stop",
    "oscillation": "oscillating",
    "deadband": "a dead band",
    "loss_of_effectiveness": "a loss of travel",
    "unknown": "something else",
    "healthy": "within tolerance",
}

EXPLAINED = {
    "": "the tolerances of a working servo explain it",
    "fitted": "what followed contradicts no servo",
}
"""Why an alarm is taken back; by the origin of its model."""


def describe(fault: Fault) -> str:
    """One clause: what, since when, until when, how sure.

    Examples
    --------
    >>> from servofd.estimate.statistics import Estimate
    >>> from servofd.detection.bank.flight import Fault
    >>> describe(Fault("stuck", 10.0, 10.4, None, {"position_deg": Estimate(3.1, 3.0, 3.2)}, 0.8, ("deadband",)))
    'stuck at 3.1 deg since 10.00 s, perhaps a dead band (alarm at 10.40 s)'
    """
    values = {name: estimate.value for name, estimate in fault.parameters.items()}
    text = next((form for name, form in _SLOW.items() if name in values), None) or _NAMES[fault.kind]
    since = (
        f"from {fault.start_s:.2f} to {fault.end_s:.2f} s"
        if fault.end_s is not None
        else f"since {fault.start_s:.2f} s"
    )
    doubt = ""
    if fault.kind == "unknown" and fault.alternatives:
        text, doubt = "at fault, with too little motion to tell which", _perhaps(fault)
    elif fault.probability < _SURE and fault.alternatives and fault.kind != "healthy":
        doubt = _perhaps(fault)
    if fault.kind == "healthy" and fault.level == "fault":
        text = "crossed the threshold, but the tolerances of a working servo explain it"
    return f"{text.format(**values)} {since}{doubt} (alarm at {fault.alarm_s:.2f} s)"


def _perhaps(fault: Fault) -> str:
    """What else it may be."""
    return f", perhaps {' or '.join(_PERHAPS.get(kind, kind) for kind in fault.alternatives)}"


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
