"""What was found, in words: what it is, what it means for the people around the aircraft, and what they can do next."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.detection.bank.window import Fault
    from servofd.detection.verdict import SurfaceAudit

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
    >>> from servofd.detection.bank.window import Fault
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
    """What comes too slowly for the bandwidth of a servo, in words; empty if nothing does or periods are NaN."""
    bandwidth_hz = bandwidth_rad_s / (2.0 * math.pi)
    enough_hz = _SAMPLES_PER_PERIOD * bandwidth_hz
    periods_s = {"position": position_period_s, "command": command_period_s}
    slow = [f"{what} at {1.0 / s:.3g} Hz" for what, s in periods_s.items() if s * enough_hz > 1.0]
    if not slow:
        return ""
    return f"{' and '.join(slow)}: slow for a servo of {bandwidth_hz:.2g} Hz, which needs {enough_hz:.2g} Hz"


_MEANING = {
    "stuck": "The surface stayed where it was, whatever was asked: a jammed linkage, a stripped gear, a servo without "
    "power or signal, or a position sensor that froze.",
    "bias": "The surface follows, but beside its command: a slipped horn or linkage, a shifted sensor, or a trim that "
    "the aircraft file does not know.",
    "hardover": "The surface ran to one end and stays there: failed electronics or feedback inside the servo, or a "
    "broken signal wire.",
    "floating": "The surface moves without being asked: the linkage is open or the servo has no power, and the air "
    "moves it.",
    "oscillation": "The surface swings on top of what was asked: a worn feedback potentiometer, play that the air "
    "excites, or a loop inside the servo that is about to become unstable.",
    "deadband": "Small commands have no effect: worn gears, play in the linkage, or friction.",
    "slow": "The surface arrives late: low supply voltage, a binding hinge, too much load, or a worn motor.",
    "loss_of_effectiveness": "The surface moves less than asked: a slipping gear or horn, or a position channel of the "
    "wrong scale.",
    "unknown": "The surface left its model, and no single fault explains how, or there was too little motion to tell "
    "which one it is.",
    "healthy": "The surface is further from its model than chance allows, yet within what a working servo may be: the "
    "model is not quite that of this servo.",
}
_CHECK = {
    "stuck": "move it from stop to stop and feel for binding",
    "bias": "compare its neutral position with a ruler",
    "hardover": "watch where it goes when it is powered up",
    "floating": "pull at the surface with the servo powered: it must hold",
    "oscillation": "hold it at several deflections and listen for buzzing",
    "deadband": "move it in steps of 0.5 deg and look for steps it does not follow",
    "slow": "measure the supply at the servo while it moves, and the time from stop to stop",
    "loss_of_effectiveness": "compare its travel with the commanded one, in degrees",
}
_ANYHOW = "move it from stop to stop, slowly and fast, and compare with its command"


def meaning(fault: Fault) -> str:
    """What may have happened to the aircraft, in a sentence.

    Examples
    --------
    >>> from servofd.detection.bank.window import Fault
    >>> meaning(Fault("deadband", 10.0, 10.4, None, {}, 0.99, ()))
    'Small commands have no effect: worn gears, play in the linkage, or friction.'
    """
    return _MEANING[fault.kind]


def gravest(faults: Sequence[Fault]) -> Fault:
    """The first fault that lasts to the end of the log; the first of all if every one has passed.

    Examples
    --------
    >>> from servofd.detection.bank.window import Fault
    >>> passed, lasts = (Fault("bias", 1.0, 2.0, 3.0, {}, 1.0, ()), Fault("stuck", 5.0, 6.0, None, {}, 1.0, ()))
    >>> gravest([passed, lasts]).kind, gravest([passed]).kind
    ('stuck', 'bias')
    """
    return next((fault for fault in faults if fault.end_s is None), faults[0])


def next_step(surface: SurfaceAudit) -> str:
    """What to do about a verdict, in a sentence; empty if there is nothing to do.

    Examples
    --------
    >>> from servofd.detection.verdict import SurfaceAudit
    >>> next_step(SurfaceAudit("rudder", "healthy", "", "s9254", "constant", 1.5, True))
    ''
    """
    if surface.status == "fault":
        check = _CHECK.get(gravest(surface.faults).kind, _ANYHOW)
        return f"do not fly; on the ground, {check}; if it moves as asked, its position sensor is at fault"
    if surface.status == "suspect":
        check = _CHECK.get(gravest(surface.suspicions).kind, _ANYHOW) if surface.suspicions else _ANYHOW
        return (
            f"look at another flight; if it happens again, on the ground, {check}; 'servofd explain' says what the "
            "model lacks"
        )
    if surface.status == "unknown":
        return "no verdict: before the next flight, move it from stop to stop and watch that it follows"
    if surface.status == "no_data" and surface.expected:
        return "log its measured position; 'servofd info' says what this log holds and what is missing"
    return ""


def headline(surfaces: Sequence[SurfaceAudit]) -> str:
    """The verdict on a whole log, in a sentence.

    Examples
    --------
    >>> from servofd.detection.verdict import SurfaceAudit
    >>> rudder = SurfaceAudit("rudder", "healthy", "", "s9254", "constant", 1.5, True)
    >>> headline([rudder])
    'The one surface that could be judged is healthy.'
    >>> headline([rudder, rudder])
    'All 2 surfaces that could be judged are healthy.'
    """
    judged = [s for s in surfaces if s.is_judged]
    if not judged:
        return "No surface could be judged."
    count = len(judged)
    named = {
        status: ", ".join(s.surface for s in judged if s.status == status)
        for status in ("fault", "suspect")
        if any(s.status == status for s in judged)
    }
    parts = []
    if "fault" in named:
        parts.append(f"servo or position sensor at fault: {named['fault']}")
    if "suspect" in named:
        parts.append(f"suspect: {named['suspect']}")
    if parts:
        text = "; ".join(parts)
        text = f"{text[0].upper()}{text[1:]}"
        healthy = sum(s.status == "healthy" for s in judged)
        return f"{text}." + (f" {healthy} of {count} judged surfaces healthy." if healthy else "")
    missing = [s.surface for s in surfaces if s.expected and not s.is_judged]
    verdict = (
        "The one surface that could be judged is" if count == 1 else f"All {count} surfaces that could be judged are"
    )
    return f"{verdict} healthy." + (f" No verdict on {', '.join(missing)}." if missing else "")
