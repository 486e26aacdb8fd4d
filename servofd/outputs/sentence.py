"""The verdict on a log in one plain sentence: the same in the terminal, on pages and in notebooks."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from servofd.core.evidence import Detectable
from servofd.detection.kinds import KINDS, filled
from servofd.detection.verdict import Fault, LogAudit, Status, SurfaceAudit, by_gravity, check, gravest, next_step

if TYPE_CHECKING:
    from servofd.axes.verdict import AxisAudit
    from servofd.detection.verdict import CommonCause

STATUSES: tuple[Status, ...] = ("fault", "suspect", "healthy", "unknown", "no_data")
"""Of surfaces, the one that decides first: what could not be judged does not count beside what could."""
LEAST_CLEARED: tuple[Status, ...] = ("fault", "suspect", "unknown", "no_data", "healthy")
"""Of flights, the one to look at first: what could not be judged comes before what is healthy."""
_CAUSES = {
    "supply": "SUPPLY GAVE WAY",
    "bus": "SERVO BUS STOOD STILL",
    "clock": "CLOCKS DISAGREE",
    "servo_type": "WRONG SERVO TYPE",
    "unknown": "ONE CAUSE",
}
_AT_ITS_CAUSE_S = 5.0
"""A fault that begins so soon before or after a common cause is reported with it [s]."""
_STATES = ("OFF", "TOO", "BLOCKED", "WITHOUT", "NOT")
"""First words of what a fault is rather than does."""
_CLAUSE = re.compile(r"[:;]| \(|, ")
"""Where the first clause of a reason ends."""
_RARE_PER_HOUR = 1e-6
"""Rates below this are given as a bound [1/h]."""


def worst(surfaces: Sequence[SurfaceAudit | AxisAudit]) -> Status:
    """Worst status of the surfaces and axes that could be judged; of the others if none could.

    Examples
    --------
    >>> from servofd.detection.verdict import SurfaceAudit
    >>> worst([SurfaceAudit("flap", "no_data", "", "s9254", "constant", 1.5, True)])
    'no_data'
    """
    statuses: set[Status] = {surface.status for surface in surfaces}
    return next((status for status in STATUSES if status in statuses), "no_data")


def sentence(surfaces: Sequence[SurfaceAudit]) -> str:
    """What happened, and whether to fly."""
    faulty = [s for s in surfaces if s.status == "fault"]
    suspect = [s for s in surfaces if s.status == "suspect"]
    healthy = [s for s in surfaces if s.status == "healthy"]
    if faulty:
        each = (f"{spoken(s.surface).upper()} {_what(gravest(s.faults))}" for s in worst_first(faulty))
        return f"{'; '.join(each)}. Do not fly."
    if suspect:
        by_current = all(s.suspicions and all(f.witness == "current" for f in s.suspicions) for s in suspect)
        them, witness = ("it", ", by its current") if len(suspect) == 1 else ("them", ", by their currents")
        said = f"{_surfaces(suspect).upper()} SUSPECT{witness * by_current}"
        return f"{said}: look at {them} before the next flight."
    return _cleared(healthy, [s for s in surfaces if s.expected and not s.is_judged])


def _cleared(healthy: Sequence[SurfaceAudit], dark: Sequence[SurfaceAudit]) -> str:
    """Which surfaces are well, which were not tried, and on which there is no verdict, and why."""
    untried = [s for s in dark if healthy and not s.tried]
    dark = [s for s in dark if s not in untried]
    reasons = list(dict.fromkeys(_CLAUSE.split(s.reason, maxsplit=1)[0] for s in dark))
    why = f": {reasons[0]}" if len(reasons) == 1 else ""  # each with its numbers stands beside its surface
    missing = f"No verdict on {_surfaces(dark)}{why}." if dark else ""
    if not healthy:
        return f"Could not tell. {missing or 'No surface could be judged.'}"
    by_current = [s for s in healthy if s.feedback == "current"]
    if len(healthy) == 1:
        did = "drew the current of a healthy servo" if by_current else "followed its command"
        text = f"{spoken(healthy[0].surface).capitalize()} {did}."
    else:
        which = "that could be judged " if missing or untried else ""
        text = f"All {len(healthy)} surfaces {which}followed their commands"
        text += f" ({_surfaces(by_current)} by current alone)." if by_current else "."
    verb = "was" if len(untried) == 1 else "were"
    not_moved = f"{_surfaces(untried).capitalize()} {verb} not tried." if untried else ""
    return " ".join(part for part in (text, missing, not_moved) if part)


def worst_first(surfaces: Sequence[SurfaceAudit]) -> list[SurfaceAudit]:
    """Surfaces by their status, and by what their faults or suspicions may do to the aircraft."""

    def place(surface: SurfaceAudit) -> tuple[int, int]:
        found = surface.faults or surface.suspicions
        return STATUSES.index(surface.status), gravity_of([gravest(found).kind] if found else [])

    return sorted(surfaces, key=place)


def gravity_of(kinds: Iterable[str]) -> int:
    """Place of some kinds of faults among all, by what they may do to the aircraft; the worst is first.

    Examples
    --------
    >>> gravity_of(["deadband", "hardover"]) < gravity_of(["stuck"]) < gravity_of([])
    True
    """
    gravest_first = tuple(KINDS)
    return min((gravest_first.index(kind) for kind in kinds if kind in KINDS), default=len(KINDS))


def whole_sentence(audit: LogAudit) -> str:
    """What happened to surfaces and axes, and whether to fly, once; what all share comes first, and is said once."""
    parts = [f"{_CAUSES[one.kind]} at {clock(one.since_s)}: {one.text}." for one in audit.common_causes]
    apart = [s for s in audit.surfaces if not any(_is_of(s, one) for one in audit.common_causes)]
    if audit.surfaces and not any(s.status == "fault" for s in apart) and len(apart) < len(audit.surfaces):
        parts.append("Do not fly.")
    elif audit.surfaces:
        parts.append(sentence(apart))
    advised = worst(audit.surfaces)
    return " ".join([*parts, *([axes_sentence(audit.axes, advised)] if audit.axes else [])]) or sentence(())


def _is_of(surface: SurfaceAudit, cause: CommonCause) -> bool:
    """Whether all that a surface did wrong began with a common cause."""
    return (
        surface.surface in cause.surfaces
        and bool(surface.faults)
        and all(abs(fault.start_s - cause.since_s) <= _AT_ITS_CAUSE_S for fault in surface.faults)
    )


def answers(audit: LogAudit) -> list[str]:
    """Beside the sentence: what to do about each surface, the worst first; no verdicts and why; what is cleared.

    A surface with several faults names each, and one that rests on a fitted zero or scale says so. What is the same for
    several is said once.
    """
    advised: dict[str, list[str]] = {}
    surfaces = worst_first(audit.surfaces)
    for surface in surfaces:
        if surface.status in ("fault", "suspect"):
            step, either = next_step(surface).removeprefix("do not fly; "), other_way_round(surface)
            note = f" {either[:1].upper()}{either[1:]}." if either else ""
            advised.setdefault(f"{step}.{_also(surface)}{note}", []).append(spoken(surface.surface))
    if not advised:
        return []  # the sentence says all there is
    lines = [
        f"{_listed(names).capitalize()}{', each' if len(names) > 1 else ''}: {advice}"
        for advice, names in advised.items()
    ]
    dark = [s for s in surfaces if s.expected and not s.is_judged and s.status not in ("fault", "suspect")]
    lines += [f"No verdict on {spoken(s.surface)}: {_CLAUSE.split(s.reason, maxsplit=1)[0]}." for s in dark]
    healthy = [spoken(s.surface) for s in surfaces if s.status == "healthy"]
    if healthy:
        lines.append(f"Followed {'its command' if len(healthy) == 1 else 'their commands'}: {', '.join(healthy)}.")
    return lines


def _also(surface: SurfaceAudit) -> str:
    """What else a surface did, the worst first, and what to do about each; what to do is said once."""
    said, parts = {check(fault) for fault in by_gravity(surface.faults)[:1]}, []
    for fault in by_gravity(surface.faults)[1:]:
        what = _calmly(_what(fault))
        parts.append(what if check(fault) in said else f"{what}: {check(fault)}")
        said.add(check(fault))
    return f" It also {'; '.join(parts)}." if parts else ""


def _calmly(what: str) -> str:
    """What a fault does, without capitals, such as "was too slow since 0:05" or "jammed at 0:30"."""
    words = what.split(" ")
    plain = " ".join(word.lower() if word.isupper() and word != "UTC" else word for word in words)
    return f"was {plain}" if words[0] in _STATES else plain


def axes_sentence(axes: Sequence[AxisAudit], advised: Status = "no_data") -> str:
    """What motion tells of the axes; whether to fly only if that is graver than what a status has `advised` already."""
    lost = [axis for axis in axes if axis.status in ("fault", "suspect")]
    if lost:
        named = "; ".join(f"{axis.axis.upper()}: {axis.reason}" for axis in lost)
        gravest_status = worst(lost)
        if STATUSES.index(gravest_status) >= STATUSES.index(advised):
            return f"{named}."
        return f"{named}. {'Do not fly.' if gravest_status == 'fault' else 'Look at it before the next flight.'}"
    weaker = {axis.axis: axis.lost_share for axis in axes if axis.is_weaker and axis.lost_share}
    healthy = [axis.axis for axis in axes if axis.status == "healthy"]
    dark = [axis.axis for axis in axes if axis.status == "unknown" and axis.axis not in (*weaker, "thrust")]
    sentences = [f"{_listed(healthy).capitalize()} answered as on healthy days."] if healthy else []
    for axis, lost_share in weaker.items():  # without an alarm, and yet surely: how much, and how rare that is
        size = "{:.0f}% weaker ({:.0f} to {:.0f}%)".format(*(100.0 * share for share in lost_share))
        rare = "as one healthy flight in 40 seems to be: look at the next ones"
        sentences.append(f"{axis.capitalize()} is probably {size}, {rare}.")
    sentences = sentences or ["Could not tell."]
    return " ".join([*sentences, f"No verdict on {', '.join(dark)}."] if dark else sentences)


def _what(fault: Fault) -> str:
    values = {name: estimate.value for name, estimate in fault.parameters.items()}
    since = clock(fault.start_s)
    when = f"since {since}" if fault.end_s is None else f"from {since} to {clock(fault.end_s)}"
    text = filled(KINDS[fault.kind].headline, {"since": since, "when": when, **values})
    if fault.is_of_sensor:
        return f"{text} by its position, while its current says that it moves"
    if fault.confirmed_by is None:
        return text
    drawn_a = fault.confirmed_by.parameters["current_a"].value
    return f"{text}, confirmed by its current ({KINDS[fault.confirmed_by.kind].perhaps}, {drawn_a:.2g} A)"


def _surfaces(surfaces: Sequence[SurfaceAudit]) -> str:
    return _listed([spoken(s.surface) for s in surfaces])


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def spoken(name: str) -> str:
    """Name of a surface, a status or a fault as it is read aloud."""
    return name.replace("_", " ")


_LEAST_SAID_DEG, _LEAST_SAID_SHARE = 0.1, 0.01
"""Smallest angle [deg] and share that a sentence has digits for."""
_MOST_DECIMALS = 6
"""Decimals of a number that is known very well."""


def known_digits(value: float, low: float, high: float, most: int = _MOST_DECIMALS) -> tuple[str, str, str]:
    """A value and the ends of its interval, with as many decimals as two digits of the interval's width need.

    Examples
    --------
    >>> known_digits(28.381, 28.266, 28.693), known_digits(-0.3652, -0.3652, -0.3651)
    (('28.38', '28.27', '28.69'), ('-0.36520', '-0.36520', '-0.36510'))
    """
    width = high - low
    if not (math.isfinite(width) and width > 0.0):
        return f"{value:.4g}", f"{low:.4g}", f"{high:.4g}"
    digits = min(most, max(1 - math.floor(math.log10(width)), 0))
    first, second, third = (f"{one:z.{digits}f}" for one in (value, low, high))
    return first, second, third


def with_interval(value: float, low: float, high: float) -> str:
    """A value with its interval in brackets; alone where both ends read alike.

    Examples
    --------
    >>> with_interval(2.51, 2.43, 2.59), with_interval(-0.365, -0.365, -0.365)
    ('2.51 (2.43 to 2.59)', '-0.365')
    """
    if not low < high or not math.isfinite(high - low):
        return f"{value:.3g}"
    value_text, low_text, high_text = known_digits(value, low, high)
    return value_text if low_text == high_text else f"{value_text} ({low_text} to {high_text})"


def seen(detectable: Detectable) -> str:
    """The smallest faults that a flight would have shown; empty if it would have shown none.

    Examples
    --------
    >>> from servofd.core.evidence import Detectable
    >>> seen(Detectable(bias_deg=0.8, loss_share=0.2))
    'would have seen an offset of 0.8 deg, 20% less travel'
    >>> seen(Detectable(bias_deg=0.8, slow_share=0.5, oscillation_deg=0.42))
    'would have seen an offset of 0.8 deg, 50% less speed, ±0.4 deg of oscillation'
    """
    angle_deg, share = _LEAST_SAID_DEG, _LEAST_SAID_SHARE  # what is seen larger is seen as well: nothing is said of 0.0
    slow = detectable.slow_share
    sizes = (
        ("an offset of {:.1f} deg", detectable.bias_deg, angle_deg),
        ("{:.0%} less travel", detectable.loss_share, share),
        ("{:.0%} less speed", slow if slow is None else 1.0 - slow, share),
        ("{:.1f} deg of play", detectable.deadband_deg, angle_deg),
        ("±{:.1f} deg of oscillation", detectable.oscillation_deg, angle_deg),
    )
    known = [words.format(max(size, least)) for words, size, least in sizes if size is not None]
    return f"would have seen {', '.join(known)}" if known else ""


_AT_ONCE_S = 1.0
"""A fault that begins so soon after the log was there from its start."""


def other_way_round(surface: SurfaceAudit) -> str:
    """What an offset or a lost share means if the zero or scale that was fitted to this log is the wrong one.

    A fit takes most of the log for right. Empty where nothing rests on it.

    Examples
    --------
    >>> from servofd.core.evidence import ModelOrigin
    >>> from servofd.core.statistics import Estimate
    >>> from servofd.detection.verdict import Fault, SurfaceAudit
    >>> early = Fault("bias", 0.3, 0.4, 10.2, {"bias_deg": Estimate(-2.5, -2.6, -2.4)}, 1.0, ())
    >>> rudder = SurfaceAudit("rudder", "suspect", "", "x", "interval", 1.0, True, suspicions=(early,),
    ...                       model=ModelOrigin(origin="fitted", fitted_between_s=(10.2, 60.0)))
    >>> other_way_round(rudder)
    'its zero was fitted to this log: it may as well have been right until 0:10, and off by +2.5 deg since'
    """
    if surface.model.fitted_between_s is None:
        return ""
    for fault in (*surface.faults, *surface.suspicions):
        if fault.kind == "bias" and "bias_deg" in fault.parameters:
            what, other = "zero", f"off by {-fault.parameters['bias_deg'].value:+.1f} deg"
        elif fault.kind == "loss_of_effectiveness" and fault.parameters.get("gain") is not None:
            gain = fault.parameters["gain"].value
            if gain <= 0.0:
                continue
            what, other = "scale", f"moving by {1.0 / gain:.0%} of its command"
        else:
            continue
        since, segment = clock(fault.start_s), surface.segment
        begun_s = 0.0 if segment is None or not segment.measured_s.size else segment.measured_s[0]
        if fault.end_s is None:
            when = f"{other} until {since}, and right since"
        elif fault.start_s - begun_s < _AT_ONCE_S:
            when = f"right until {clock(fault.end_s)}, and {other} since"
        else:
            when = f"right from {since} to {clock(fault.end_s)}, and {other} before and after"
        return f"its {what} was fitted to this log: it may as well have been {when}"
    return ""


_DAY_S, _SINCE_1970_S = 86400, 1e8
"""A day [s]; and stamps from here on, three years, count from 1970, for no aircraft is powered for so long [s]."""


def clock(time_s: float) -> str:
    """A time of the log as its minutes and seconds; as the time of day where stamps count from 1970.

    Examples
    --------
    >>> clock(5.01), clock(3725.0), clock(-2.0), clock(1.7e9)
    ('0:05', '1:02:05', '-0:02', '22:13:20 UTC')
    """
    of_day = time_s >= _SINCE_1970_S
    seconds = round(abs(time_s)) % _DAY_S if of_day else round(abs(time_s))
    hours, minutes, rest = seconds // 3600, seconds // 60 % 60, seconds % 60
    text = f"{hours}:{minutes:02d}:{rest:02d}" if hours or of_day else f"{minutes}:{rest:02d}"
    if of_day:
        return f"{text} UTC"
    return f"-{text}" if time_s <= -0.5 else text


def minute_of(start_utc: str | None) -> str:
    """Day and minute of a time stamp as JSON tells it; empty if there is none."""
    return (start_utc or "")[:16].replace("T", " ")


def plain_rate(per_hour: float) -> str:
    """How often something happens, without powers of ten.

    Examples
    --------
    >>> plain_rate(1e-100), plain_rate(2e-4), plain_rate(0.5), plain_rate(12.0)
    ('less than one in a million hours', 'one in 5,000 hours', 'one in 2 hours', '12 an hour')
    """
    if per_hour < _RARE_PER_HOUR:
        return "less than one in a million hours"
    if per_hour < 1.0:
        hours = 1.0 / per_hour
        digits = 1 if hours >= 10.0 else 0
        scale = 10.0 ** (len(str(int(hours))) - 1 - digits)
        return f"one in {round(hours / scale) * scale:,.0f} hours"
    return f"{per_hour:.2g} an hour"
