"""Faults in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from servofd.detection.bank.flight import Fault

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
    'stuck at 3.1 deg since 10.00 s (alarm 10.40 s; or deadband)'
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
        text, doubt = "at fault, with too little motion to tell which", f"; {' or '.join(fault.alternatives)}"
    elif fault.probability < _SURE and fault.alternatives and fault.kind != "healthy":
        doubt = "; or " + " or ".join(fault.alternatives)
    if fault.kind == "healthy" and fault.level == "fault":
        text = "crossed the threshold, but the tolerances of a working servo explain it"
    return f"{text.format(**values)} {since} (alarm {fault.alarm_s:.2f} s{doubt})"
