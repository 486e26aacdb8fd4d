"""Curves over time for a page: vector graphics that fill any width, with text beside them that never shrinks.

One ``<svg>`` a panel is stretched to whatever width there is; ticks, names and values are text of the page around it.
`chart.js` adds the value under the pointer, and a closer view. A judged surface is drawn after thesis Fig. 4.5.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from logparsers.records import FlightLog
from servofd.axes.model import FORMS
from servofd.core.errors import NoMeasurement
from servofd.core.types import FloatArray, IntArray
from servofd.detection.kinds import KINDS
from servofd.detection.verdict import WITHIN_SIGMAS, Fault, SurfaceAudit, gravest
from servofd.outputs.sentence import clock, spoken

if TYPE_CHECKING:
    from servofd.axes.motion import Motion
    from servofd.axes.verdict import AxisAudit
    from servofd.flight.change import AxisChange

WIDTH, HEIGHT = 2000, 500
"""Units of the drawing: two to a column of pixels of a wide screen, two to a row of a tall panel."""
_TIME_STEPS_S = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 43200, 86400)
"""Steps of the time axis [s]: the smallest of them that needs no more labels than fit is taken."""
_BRIDGED_PERIODS, _BRIDGED_S = 5.0, 0.1
"""A line is broken where samples are missing for longer than both: this many periods, and this many seconds."""
_MOST_TIME_TICKS, _MOST_VALUE_TICKS = 6, 5
"""Labels at most on the axis and on that of values."""
_TINY = 1e-12
"""Stands for nothing on an axis of ratios."""
_ALL = (-math.inf, math.inf)
"""The whole of an axis."""
_SLACK, _LEAST_DEG = 0.06, 0.5
"""Of a panel's height, above and below its curves, and at least of deflections [deg]."""


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One line of a panel; a value that is not finite interrupts it."""

    name: str
    """In the legend; empty for a line that belongs to the one before."""
    role: str
    """Class in `page.css`, which gives it its colour."""
    x: FloatArray
    values: FloatArray
    style: Literal["line", "steps", "dots", "bars"] = "line"
    """Steps: each value lasts until the next. Bars: upright lines to what `until` says."""
    until: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """Curves of one quantity."""

    title: str
    unit: str
    curves: tuple[Curve, ...]
    low: float
    high: float

    @classmethod
    def around(
        cls, title: str, unit: str, curves: Sequence[Curve], least: float = 1e-9, within: Sequence[float] = _ALL
    ) -> Panel:
        """A panel as high as its curves are `within` a part of the axis, with at least `least` above and below them."""
        every = [np.zeros(0)]
        for curve in curves:
            first, last = np.searchsorted(curve.x, within)
            rows = slice(max(int(first) - 1, 0), int(last) + 1)  # a line comes from the sample before
            every += [np.asarray(one)[rows] for one in (curve.values, curve.until) if one is not None]
        known = np.concatenate(every)
        known = known[np.isfinite(known)]
        low, high = (float(known.min()), float(known.max())) if known.size else (-1.0, 1.0)
        room = max(_SLACK * (high - low), least)
        return cls(title, unit, tuple(curves), low - room, high + room)

    def top(self, value: float) -> float:
        """Where a value stands, in percent from above."""
        return 100.0 * (self.high - value) / (self.high - self.low)

    @property
    def label(self) -> str:
        """Title with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Place [%] and text of each tick."""
        return [(self.top(value), f"{value:g}") for value in nice_ticks(self.low, self.high, _MOST_VALUE_TICKS)]


@dataclass(frozen=True, slots=True)
class Span:
    """A part of the axis that is shaded."""

    role: str
    start: float
    end: float
    label: str


@dataclass(frozen=True, slots=True)
class Mark:
    """A place on the axis that is marked."""

    role: str
    x: float
    label: str


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """Panels above each other, over the same axis: the time, or what `axis` names.

    Examples
    --------
    >>> time_s = np.array([0.0, 1.0, 2.0])
    >>> curve = Curve("residual", "residual", time_s, np.array([0.0, 0.5, np.nan]))
    >>> panel = Panel("residual", "deg", (curve,), -1.0, 1.0)
    >>> Chart("Residual", "What is left.", 0.0, 2.0, (panel,)).paths(panel)
    [('residual', 'M0 250l1000-125')]
    >>> Chart("", "", 1.0, 100.0, (panel,), axis="frequency [Hz]", log=True).ticks[:2]
    [(0.0, '1'), (15.05149978319906, '2')]
    """

    title: str
    text: str
    """What it shows, for readers who cannot see it."""
    first: float
    last: float
    panels: tuple[Panel, ...]
    spans: tuple[Span, ...] = ()
    marks: tuple[Mark, ...] = ()
    points: int = 700
    """Points drawn per curve, at most; the extremes of each column survive. A threshold gets half of them."""
    axis: str = ""
    """Name and unit of the axis; empty where it is the time, shown as on a clock."""
    log: bool = False
    """Whether equal steps of the axis are equal ratios."""

    @property
    def ends(self) -> tuple[float, float]:
        """Both ends of the axis, as it is drawn: logarithms to base ten where it is logarithmic."""
        return (math.log10(self.first), math.log10(self.last)) if self.log else (self.first, self.last)

    def _share(self, x: Any) -> Any:  # noqa: ANN401 - a number or an array
        first, last = self.ends
        return ((np.log10(np.maximum(x, _TINY)) if self.log else x) - first) / (last - first)

    def across(self, x: float) -> float:
        """Where something stands, in units of the drawing from the left, within it."""
        return round(min(max(float(self._share(x)), 0.0), 1.0) * WIDTH)

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Place [%] and text of each tick of the axis."""
        span = self.last - self.first
        if self.log:
            begin, end = (math.floor(one) for one in self.ends)
            every = [k * 10.0**power for power in range(begin, end + 1) for k in (1, 2, 5)]
            shown = [(x, f"{x:g}") for x in every if self.first <= x <= self.last]
        elif self.axis:
            shown = [(x, f"{x:g}") for x in nice_ticks(self.first, self.last, _MOST_TIME_TICKS)]
        else:
            step_s = next((step for step in _TIME_STEPS_S if span / step <= _MOST_TIME_TICKS), span)
            first, last = math.ceil(self.first / step_s - 1e-9), math.floor(self.last / step_s + 1e-9)
            times_s = [k * step_s for k in range(first, last + 1)]
            shown = [(x, clock(x).removesuffix(" UTC") if step_s >= 1 else f"{x:.1f} s") for x in times_s]
        return [(100.0 * float(self._share(x)), text) for x, text in shown]

    @property
    def legend(self) -> list[tuple[str, str]]:
        """Role and name of each curve that has one."""
        return list(dict.fromkeys((c.role, c.name) for panel in self.panels for c in panel.curves if c.name))

    def paths(self, panel: Panel) -> list[tuple[str, str]]:
        """Role and outline of each curve of a panel."""
        return [(curve.role, self._path(curve, panel)) for curve in panel.curves]

    def _path(self, curve: Curve, panel: Panel) -> str:
        x, values = curve.x, curve.values
        heights = HEIGHT / (panel.high - panel.low)
        if curve.style in ("dots", "bars"):
            ends = values if curve.until is None else curve.until
            places = np.round(
                np.column_stack([self._share(x) * WIDTH, *((panel.high - y) * heights for y in (values, ends))])
            )
            known = np.all(np.isfinite(places), axis=1) & (x >= self.first) & (x <= self.last)
            return "".join(f"M{at} {y}l0 {end - y}" for at, y, end in places[known].astype(int).tolist())
        inside = slice(max(int(np.searchsorted(x, self.first)) - 1, 0), int(np.searchsorted(x, self.last)) + 1)
        most = self.points // (2 if curve.role == "threshold" else 1)
        x, values = thinned(x[inside], values[inside], most)
        if curve.style == "steps":
            end = max(self.last, float(x[-1])) if x.size else self.last
            x = np.repeat(np.append(x, end), 2)[1:-1]
            values = np.repeat(values, 2)
        y = np.round((panel.high - values) * heights)
        return _outline(np.round(self._share(x) * WIDTH), np.clip(y, -HEIGHT, 2 * HEIGHT))


def _outline(x: FloatArray, y: FloatArray) -> str:
    """Path through whole numbers, in steps from point to point; broken where a value is missing."""
    pieces = []
    known = np.flatnonzero(np.isfinite(y))
    for run in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        if run.size == 0:
            continue
        points = np.column_stack([x[run], y[run]]).astype(np.int64)
        steps = np.diff(points, axis=0)
        turning = np.ones(len(points), dtype=bool)
        # A point on the straight line from its neighbour to its neighbour is not needed.
        cross = steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0]
        forth = np.sum(steps[:-1] * steps[1:], axis=1) >= 0
        turning[1:-1] = (cross != 0) | ~forth
        kept = points[turning]
        first, *moves = (
            f"{x}{y}" if y < 0 else f"{x} {y}" for x, y in np.diff(kept, axis=0, prepend=[[0, 0]]).tolist()
        )
        pieces.append(f"M{first}l{' '.join(moves) or '0 0'}")
    return "".join(pieces)


def thinned(time_s: FloatArray, values: FloatArray, points: int) -> tuple[FloatArray, FloatArray]:
    """Keep the smallest and the largest sample of each column, so that no spike is lost; `points` of them at most.

    Columns are equally long in time, however often there is a sample. Besides, what is missing is kept once a column,
    so that no line goes on over it.

    Examples
    --------
    >>> time_s = np.arange(8.0)
    >>> thinned(time_s, np.array([0.0, 5.0, 1.0, 1.0, np.nan, np.nan, 2.0, -3.0]), 4)
    (array([0., 1., 4., 6., 7.]), array([ 0.,  5., nan,  2., -3.]))
    """
    kept = extremes(time_s, values, points)
    return time_s[kept], values[kept]


def extremes(time_s: FloatArray, values: FloatArray, points: int) -> IntArray:
    """Places of the samples that `thinned` keeps, shape (n,)."""
    if time_s.size <= points:
        return np.arange(time_s.size)
    columns = points // 2
    into = np.minimum((time_s - time_s[0]) * (columns / (time_s[-1] - time_s[0])), columns - 1).astype(int)
    begins = np.flatnonzero(np.diff(into, prepend=-1))
    of_sample = np.repeat(np.arange(begins.size), np.diff(begins, append=values.size))
    low, high = np.fmin.reduceat(values, begins), np.fmax.reduceat(values, begins)
    is_missing = np.isnan(values)
    breaks = is_missing & ~np.append(False, is_missing[:-1])
    kept = []
    for wanted in (is_missing & np.isnan(low)[of_sample] | breaks, values == low[of_sample], values == high[of_sample]):
        at = np.flatnonzero(wanted)
        kept.append(at[np.diff(of_sample[at], prepend=-1) > 0])
    return np.unique(np.concatenate(kept))


def bridged(time_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Leave out missing samples between others that are near, so that a line goes on there; longer silence breaks it.

    Readings that a logger wrote twice are missing the second time: every other sample then stands alone.
    """
    known = np.flatnonzero(np.isfinite(values))
    if known.size < 2 or known.size == values.size:
        return time_s, values
    apart_s = np.diff(time_s[known])
    near = apart_s <= max(_BRIDGED_PERIODS * float(np.median(apart_s)), _BRIDGED_S)
    kept = np.isfinite(values)
    before = np.searchsorted(known, np.arange(values.size), side="right") - 1
    kept |= (before < 0) | (before >= near.size) | ~np.append(near, False)[before]
    return time_s[kept], values[kept]


def nice_ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers between two others.

    Examples
    --------
    >>> nice_ticks(-3.2, 8.1, 4), nice_ticks(0.0, 1.0, 4)
    ([0.0, 5.0], [0.0, 0.5, 1.0])
    """
    power = 10.0 ** math.floor(math.log10((high - low) / most))
    step = next(power * k for k in (1, 2, 5, 10, 20) if (high - low) / (power * k) <= most)
    return [k * step + 0.0 for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


MOST_FAULTS = 4
"""Faults that are shown in a close-up; the table lists all."""
_MARGIN_S, _MARGIN = 2.0, 0.35
"""Shown before and after a fault: the more of so many seconds and of this share of the time from onset to alarm."""
_NEAR_S = 10.0
"""Time before the onset and after the alarm in a close-up of a current [s]."""
_POINTS, _POINTS_WELL = 700, 400
"""Points per curve of a whole flight; of a surface that is well, whose chart is folded away."""
_POINTS_OF_PAGE = 2400
"""Points per curve of all surfaces of a page together: with six surfaces, three of them at fault, it has 190 kB."""


def surface_charts(surface: SurfaceAudit, of: int = 1) -> list[Chart]:
    """Close-ups of what was found, that of the headline first, then the whole flight of a surface, one `of` so many.

    Of a surface without a position its current is drawn, with one close-up; nothing of one without both.
    """
    seen = surface.residuals or surface.current
    if seen is None or seen.time_s is None or seen.time_s.size < 2:
        return []
    found = (*surface.faults, *surface.suspicions)
    first = gravest(surface.faults or surface.suspicions) if found else None
    ordered = sorted(found, key=lambda fault: fault is not first)
    return [
        *(_close_up(surface, fault) for fault in ordered[: 1 if surface.residuals is None else MOST_FAULTS]),
        flight_chart(surface, of),
    ]


def flight_chart(surface: SurfaceAudit, of: int = 1) -> Chart:
    """The whole flight of one surface, one `of` so many on a page."""
    if surface.residuals is None:
        return _chart("Whole flight", _of_current(surface), surface, -math.inf, math.inf)
    largest = "" if surface.statistics is None else f", at most {surface.statistics.max_abs_deg:.2f} deg"
    text = (
        f"Above, what {spoken(surface.surface)} was asked, what a healthy servo would have done, and what was "
        f"measured. Below, the residual{largest}, and its threshold, {surface.threshold_deg:.3g} deg."
    )
    chart = _chart("Whole flight", text, surface, -math.inf, math.inf)
    points = _POINTS if surface.faults or surface.suspicions else _POINTS_WELL
    return replace(chart, points=round(points * min(1.0, _POINTS_OF_PAGE / (_POINTS * of))))


def _close_up(surface: SurfaceAudit, fault: Fault) -> Chart:
    title = f"{kind_of(fault).capitalize()} at {clock(fault.start_s)}, close-up"
    if surface.residuals is None:
        from_s, to_s = fault.start_s - _NEAR_S, fault.alarm_s + _NEAR_S
        return _chart(title, _of_current(surface), surface, from_s, to_s)
    margin_s = max(_MARGIN_S, _MARGIN * (fault.alarm_s - fault.start_s))
    last_s = max(fault.alarm_s, fault.start_s) + margin_s
    if fault.end_s is not None and fault.end_s < last_s + margin_s:
        last_s = fault.end_s + margin_s
    text = (
        f"It began at {clock(fault.start_s)} ({fault.start_s:.2f} s; shaded from there); in flight the alarm would "
        f"have been raised at {fault.alarm_s:.2f} s (vertical line)."
    )
    return _chart(title, text, surface, fault.start_s - margin_s, last_s)


def _of_current(surface: SurfaceAudit) -> str:
    return f"Above, what {spoken(surface.surface)} was asked; below, what it drew, and what a good servo draws."


def _chart(title: str, text: str, surface: SurfaceAudit, from_s: float, to_s: float) -> Chart:
    """What was asked and done above; below, what is left of it, or what was drawn."""
    seen, current = surface.residuals or surface.current, surface.current
    if seen is None or seen.time_s is None:
        raise NoMeasurement(f"{surface.surface}: there is nothing to draw: {surface.reason}")
    begin_s, end_s = float(seen.time_s[0]), float(seen.time_s[-1])
    from_s, to_s = max(from_s, begin_s), min(to_s, end_s)
    if to_s <= from_s:
        from_s, to_s = begin_s, end_s
    panels = _position_panels(surface, from_s, to_s)
    if surface.residuals is None and current is not None and current.command is not None:
        asked = Curve("command", "command", *current.command, "steps")
        panels.append(Panel.around("deflection", "deg", [asked], _LEAST_DEG))
    panels += _current_panel(surface, from_s, to_s)
    found = [("fault", fault) for fault in surface.faults] + [("suspect", fault) for fault in surface.suspicions]
    ends_s = (end_s if fault.end_s is None else fault.end_s for _, fault in found)
    spans = tuple(Span(role, one.start_s, at_s, kind_of(one)) for (role, one), at_s in zip(found, ends_s, strict=True))
    marks = tuple(Mark(role, one.alarm_s, f"alarm {clock(one.alarm_s)}") for role, one in found)
    return Chart(title, text, from_s, to_s, tuple(panels), spans, marks)


def _position_panels(surface: SurfaceAudit, from_s: float, to_s: float) -> list[Panel]:
    """What was asked and done; what is left of it, its threshold, and where it was beyond that."""
    segment, residuals, threshold = surface.segment, surface.residuals, surface.threshold
    if segment is None or residuals is None or threshold is None:
        return []
    time_s = residuals.time_s
    inside = slice(*np.searchsorted(time_s, (from_s, np.nextafter(to_s, np.inf))))
    curves = (
        Curve("command", "command", segment.command_s, segment.command_deg, "steps"),
        Curve("healthy servo", "simulated", time_s, residuals.simulated_deg),
        Curve("measured", "measured", *bridged(time_s, residuals.measured_deg)),
    )
    judged = np.where(residuals.settled, residuals.residual_deg, np.nan)
    size = np.abs(judged[inside])
    limit = 1.15 * max(float(np.nanmax(size, initial=0.0)), 1.3 * threshold.typical_deg)
    level_s, level_deg = time_s, threshold.level_deg
    if threshold.kind == "constant":
        level_s, level_deg = time_s[[0, -1]], threshold.level_deg[[0, -1]]
    with np.errstate(invalid="ignore"):
        alarm = np.where(np.abs(judged) >= threshold.level_deg, -0.96 * limit, np.nan)
    left = [Curve("residual", "residual", *bridged(time_s, judged))]
    left += [Curve(name, "threshold", level_s, sign * level_deg) for name, sign in (("threshold", 1.0), ("", -1.0))]
    if np.isfinite(alarm).any():
        left.append(Curve("over threshold", "alarm", time_s, alarm))
    return [
        Panel.around("deflection", "deg", curves, _LEAST_DEG, (from_s, to_s)),
        Panel("residual", "deg", tuple(left), -limit, limit),
    ]


def _current_panel(surface: SurfaceAudit, from_s: float, to_s: float) -> list[Panel]:
    """What was drawn, what a good servo draws, and what good ones differ by; nothing without a current."""
    current = surface.current
    if current is None or current.time_s is None or current.current_a is None:
        return []
    if current.healthy_a is None or current.sigma_a is None:
        return []
    time_s, healthy_a, width_a = current.time_s, current.healthy_a, WITHIN_SIGMAS * current.sigma_a
    curves = (
        Curve("good servo", "simulated", time_s, healthy_a),
        Curve("drawn", "measured", time_s, current.current_a),
        Curve("good ones differ by", "threshold", time_s, healthy_a + width_a),
        Curve("", "threshold", time_s, healthy_a - width_a),
    )
    return [Panel.around("current", "A", curves, 1e-3, (from_s, to_s))]


def kind_of(fault: Fault) -> str:
    """Kind of a fault, in the words of its sentence."""
    return KINDS[fault.kind].perhaps.removeprefix("a ").removeprefix("an ")


_MOST_OF_IT = 0.998
"""Share of the samples that the scale of an axis' chart holds; the rest is drawn beyond its ends."""
_HEADROOM = 1.1
"""Height of the chart of distances, over its largest value."""
_HIGHEST = 20.0
"""Largest distance from healthy that is drawn, in thresholds."""


def axis_chart(axis: AxisAudit) -> Chart:
    """The whole flight of one axis."""
    time_s, usable = axis.time_s, axis.inputs.usable
    asked, shown = (np.where(usable, values, np.nan) for values in (axis.asked, axis.shown))
    both = np.concatenate([asked[usable], shown[usable], [0.0]])
    low, high = (float(x) for x in np.quantile(both, (1.0 - _MOST_OF_IT, _MOST_OF_IT)))
    margin = 0.1 * (high - low) + 1e-9
    unit = FORMS[axis.model.form].unit
    effect = Panel(
        "effect of the command",
        unit,
        (Curve("expected", "simulated", time_s, asked), Curve("as the motion shows", "measured", time_s, shown)),
        low - margin,
        high + margin,
    )
    score = np.sqrt(np.clip(axis.score, 0.0, _HIGHEST**2))
    top = _HEADROOM * max(1.2, float(score.max()))
    title, score = "distance from healthy over its threshold", np.where(usable, score, np.nan)
    distance = _distances(title, "1", "threshold", time_s, score, top)
    text = (
        "Above, the part of the motion that the command should cause, and the part that nothing else explains; a lost "
        "surface keeps the second from following the first. Below, how far lost share and offset are from those of "
        "healthy flights. Where nothing is drawn, nothing was judged."
    )
    last_s = float(time_s[-1])
    spans = tuple(Span("fault", e.start_s, e.end_s or last_s, "lost") for e in axis.events if not e.cause)
    marks = tuple(Mark("alarm", e.alarm_s, "alarm") for e in axis.events if not e.cause)
    return Chart("Whole flight", text, float(time_s[0]), last_s, (effect, distance), spans, marks)


def _distances(title: str, unit: str, limit: str, time_s: FloatArray, score: FloatArray, top: float) -> Panel:
    """How far an axis was from what is usual, and the limit at 1."""
    curves = Curve("distance", "residual", time_s, score), Curve(limit, "threshold", time_s[[0, -1]], np.ones(2))
    return Panel(title, unit, curves, 0.0, top)


def alone_chart(motion: Motion, axes: Mapping[str, AxisChange]) -> Chart:
    """Commands, rates, and how far roll and pitch are from their own past."""
    panels = []
    for place, axis in enumerate(("roll", "pitch")):
        if axis in motion.commands_us:
            asked = Curve("command", "command", motion.time_s, motion.commands_us[axis])
            rate = Curve("rate", "measured", motion.time_s, motion.rates_deg_s[place])
            panels.append(Panel.around(f"{axis} command", "us", [asked], 1.0))
            panels.append(Panel.around(f"{axis} rate", "deg/s", [rate], 1.0))
        one = axes.get(axis)
        if one is not None and one.time_s:
            time_s, score = np.array(one.time_s), np.sqrt(np.array(one.score))
            title = f"{axis}: distance from its own past"
            panels.append(_distances(title, "limits", "limit", time_s, score, max(1.2, float(np.nanmax(score)))))
    marks = [Mark("onset", one.since_s, f"{one.axis} changed") for one in axes.values() if one.since_s is not None]
    text = "An axis whose distance from its own past exceeds 1 for three seconds no longer answers as it did."
    first_s, last_s = float(motion.time_s[0]), float(motion.time_s[-1])
    return Chart("The flight against its own past", text, first_s, last_s, tuple(panels), marks=tuple(marks))


_MOST_LANES = 12
"""Lanes of a page: with 300 points each they are 20 kB of it."""
_LANE_POINTS = 300
"""Points of a lane."""
_SHOWN_LANES = re.compile(
    r"(?:ATT\.(?:Roll|Pitch|Yaw)|ARSP(?:\[0\])?\.Airspeed|BAT(?:\[0\])?\.(?:Volt|Curr)|POWR\.V(?:Servo|cc)"
    r"|CTUN\.ThO|BARO(?:\[0\])?\.Alt|ATTITUDE\.(?:roll|pitch|yaw)|VFR_HUD\.(?:airspeed|throttle|alt)"
    r"|SYS_STATUS\.(?:voltage|current)_battery|airspeed\[0\]\.indicated_airspeed_m_s"
    r"|battery_status\[0\]\.(?:voltage_v|current_a)|system_power\[0\]\.voltage5v_v)"
)
"""Of an autopilot's hundreds of channels: attitude, airspeed, supply, throttle, height; modes have a band."""
_OF_SURFACES = re.compile(r".*_(?:cmd|pos)_(?:deg|rad)|d[aefr]\w*|time")


def lanes_of(log: FlightLog) -> list[dict[str, Any]]:
    """Channels that are not those of surfaces: name, unit, outline (as of `Chart.paths`), and the ends of its axes."""
    if log.is_of_autopilot:
        wanted = [name for name in log.channels if _SHOWN_LANES.fullmatch(name)]
    else:
        wanted = [name for name in log.channels if not _OF_SURFACES.fullmatch(name)]
    lanes = []
    for name in wanted[:_MOST_LANES]:
        channel = log[name]
        known = channel.values[np.isfinite(channel.values)]
        if channel.time_s.size < 2 or not known.size or channel.time_s[-1] <= channel.time_s[0]:
            continue
        steady = 1.0 if np.ptp(known) == 0.0 else 1e-9
        panel = Panel.around(name, channel.unit, [Curve(name, "other", channel.time_s, channel.values)], steady)
        first_s, last_s = float(channel.time_s[0]), float(channel.time_s[-1])
        ((_, path),) = Chart("", "", first_s, last_s, (panel,), points=_LANE_POINTS).paths(panel)
        lanes.append(
            {"name": name, "unit": channel.unit, "low": panel.low, "high": panel.high}
            | {"first": first_s, "last": last_s, "path": path}
        )
    return lanes
