"""The monitor of one surface: commands and positions in, events out, on the clock of the data alone.

Alarms leave at once. What an alarm is, the bank tells from a copy of the last minutes (`Look`), which may be judged by
another thread; the names that it finds are those of an audit, and the last look at the end of a stream is the audit's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.pace import (
    OUTAGE_S,
    SAME_PACE,
    SLOWEST_RATE_HZ,
    WARM_UP_S,
    WARM_UP_STEPS,
    link_period_s,
    pace_steps,
)
from servofd.aircraft.watch import STANDS_STILL_S, New, Watch
from servofd.core.errors import DesignError
from servofd.core.series import latest
from servofd.detection.event import Event, Inputs, Reading
from servofd.detection.looks import Looks
from servofd.detection.seen import Healthy, Pace, least_rate_hz, too_few
from servofd.detection.verdict import too_slow
from servofd.servo.context import Context

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servofd.core.types import FloatArray, Marks
    from servofd.detection.seen import HealthyStream
    from servofd.detection.stream import Piece
    from servofd.servo.context import Context
    from servofd.servo.servo_model import ServoModel


_MOST = 0.5
"""Share of the time that must be judged for a verdict."""
_REVIEW_S = 20.0
"""How often it is asked whether that is so on a link [s]."""
_STEADY_S = 2.0
_SAME_LEFT = 2.0
"""What a link leaves of a pace scatters by so many times."""
_LEAST_SHARE = 0.75
"""Of the slowest rate that is judged, as the mean of what a link leaves of it between pauses longer than this [s]."""
_QUIET, _TOGETHER, _FAST_S = 0.3, 2, 0.025
"""Positions that come as fast as this [s] go two at a time while the residual is a small share of its threshold."""
_LONGEST_WAIT = 6_000
"""Samples that are kept while a position that has never changed may still turn out to be one."""


@dataclass(slots=True)
class SurfaceMonitor(Looks):
    """One surface, from its first sample on.

    Examples
    --------
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> aircraft = plain_aircraft(["rudder"], "hs225bb-eq31")
    >>> model = aircraft.model("rudder")
    >>> monitor = SurfaceMonitor("rudder", aircraft.surfaces["rudder"], model)
    >>> time_s = np.arange(0.0, 20.0, 0.02)
    >>> command_deg = 10.0 * np.sin(2.0 * time_s)
    >>> jammed_deg = np.where(time_s < 12.0, model.simulate(time_s, command_deg, time_s), 5.0)
    >>> events = []
    >>> for k in range(time_s.size):
    ...     here = slice(k, k + 1)
    ...     events += monitor.feed((time_s[here], command_deg[here]), (time_s[here], jammed_deg[here]))
    ...     if look := monitor.due():
    ...         events += monitor.events_of(look, look.find())
    >>> [(event.event, event.kind, round(event.time_s, 1)) for event in events + monitor.finish()]
    [('alarm', 'unknown', 12.0), ('named', 'stuck', 12.3)]
    """

    model: ServoModel
    beside: HealthyStream | None = None
    """What is read of it in a healthy servo; None: its position, as its file describes it."""
    listener: Callable[[str, Piece, Inputs], None] | None = None
    """Called with every piece that was evaluated."""
    reading: Reading | None = None
    drawn: Reading | None = None
    """What was read last of the current beside its position [A]."""
    stands_in: str = ""
    """Why it watches the current of a surface whose position tells nothing, in words; empty if it does not."""
    unseen: str = ""
    """Why a position beside it, of which some has come, was not judged; an audit does not clear such a surface."""
    suspended: str = ""
    """Why its calibration is not believed any more; empty if it is."""
    outage: str = ""
    """What stopped coming, and has not come steadily since; empty if nothing has."""
    is_periodic: bool = False
    """Whether commands are sent at a steady rate, as on a link: where they come unevenly, the rest was lost."""
    patience_s: float = 2.0
    """Without commands or positions for so long, while the vehicle sends, nothing is known of it [s]."""
    _waiting: tuple[list[tuple[float, float]], list[tuple[float, float]]] = field(default_factory=lambda: ([], []))
    _drawn: list[tuple[float, float]] = field(default_factory=list)
    """Currents beside positions that are not handed over yet."""
    _recent: deque[float] = field(default_factory=lambda: deque(maxlen=WARM_UP_STEPS + 1))
    _period_s: float = float("nan")
    _paces_s: tuple[float, float] = (float("nan"), float("nan"))
    """Median and mean time between positions as they come, those that only repeat the one before included [s]."""
    _least_hz: float = SLOWEST_RATE_HZ
    _passed_on_s: float = -np.inf
    """Time of the last command that the listener was given [s]."""
    _begun_s: float = float("inf")
    """Since when positions were evaluated,"""
    _judged_s: float = 0.0
    """how long they were judged, of the time between those that had a value,"""
    _valued_s: float = float("nan")
    """and the latest that had one [s]."""
    _command_period_s: float = float("nan")
    _off_pace: int = 0
    _received: dict[str, list[float]] = field(
        default_factory=lambda: {"command": [np.nan, 0.0], "position": [np.nan, 0.0]}
    )
    """When the latest of each was made [s], and for how long since then nothing at all was received [s]."""
    _steady_s: float = np.inf
    _latest_seen: float = float("nan")
    _moved: bool = False
    """Whether positions have changed while the stream had not begun."""
    _told_still: bool = False
    _told_slow: bool = False
    _reviewed: tuple[float, float] | None = None
    """When it was last asked what share of the time is judged [s], and how much was judged by then [s]."""
    _slow: str = ""
    _excused: tuple[float, float] = (-np.inf, 0.0)
    """Until when nothing at all was received of the vehicle, and for how long [s]."""
    _watch: Watch = field(default_factory=Watch)
    _asked_last: tuple[float, float] = (float("nan"), float("nan"))
    """Time [s] and value of the latest command, as the marks take it [deg]."""

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now; samples not yet evaluated are evaluated with them."""
        self.context = context
        if self.stream is not None:
            self.stream.surroundings(context)

    def feed(
        self,
        commands: tuple[FloatArray, FloatArray],
        positions: tuple[FloatArray, FloatArray],
        stands: Marks | None = None,
        stood_s: Sequence[tuple[float, float]] = (),
        drawn: tuple[FloatArray, FloatArray] | None = None,
    ) -> list[Event]:
        """Take the next commands, positions and currents `drawn` beside them: times [s] and values as logged, (n,).

        Commands come before positions of the same instant. `stands` tells of each position whether the telemetry of
        all surfaces stood still then (`servofd.aircraft.watch.Bus`), and `stood_s` from when to when it turns out to
        have stood [s]: what was raised meanwhile is taken back.
        """
        if self.suspended:
            return []
        asked_deg = self.surface.command.to_deg(commands[1])
        if self.surface.command_saturation_deg is not None:
            asked_deg = np.clip(asked_deg, *self.surface.command_saturation_deg)
        given = np.isfinite(asked_deg)
        asked = list(zip(commands[0][given].tolist(), asked_deg[given].tolist(), strict=True))
        known = np.isfinite(positions[1])
        seen_deg = (
            positions[1][known] if self.surface.measured is None else self.surface.measured.to_deg(positions[1][known])
        )
        fresh = np.ones(seen_deg.size, dtype=bool) if stands is None else stands == 0
        seen = list(zip(positions[0][known][fresh].tolist(), seen_deg[fresh].tolist(), strict=True))
        for what, rows in (("command", asked), ("position", seen)):
            if rows:
                until_s, gap_s = self._excused
                self._received[what] = [rows[-1][0], gap_s if rows[-1][0] < until_s else 0.0]
        events = self._alive(seen)
        if drawn is not None:
            self._drawn += zip(drawn[0].tolist(), drawn[1].tolist(), strict=True)
            del self._drawn[:-_LONGEST_WAIT]
        counting = seen
        if self.quantity == "position":  # a current may well stand still
            new = New.of(self.surface, commands, positions)
            counting = self._watch.take(new.time_s, new.position_deg, self._asked_at(new), seen_deg, stands)
        if self.stream is None:
            events += self._warm_up(asked, counting)
        else:
            self._hand_over(asked, counting)
            events += self._evaluated(self.stream.evaluate())
        for from_s, until_s in stood_s if self.quantity == "position" else ():
            events += [*self._taken_back(from_s, until_s), *self._stands_still(from_s, until_s)]
        return events

    def _asked_at(self, new: New) -> FloatArray:
        """The command in force at each new position [deg]; NaN before any."""
        before_s, before_deg = self._asked_last
        command_s, command_deg = new.command_s, new.command_deg
        if np.isfinite(before_s):
            command_s, command_deg = np.append(before_s, command_s), np.append(before_deg, command_deg)
        if not command_s.size:
            return np.full(new.time_s.size, np.nan)
        self._asked_last = float(command_s[-1]), float(command_deg[-1])
        return latest(command_s, command_deg, new.time_s)

    def _stands_still(self, since_s: float, now_s: float) -> list[Event]:
        """Tell, once in each outage, that the telemetry of all surfaces stands still since then [s]."""
        if self.suspended or now_s - since_s < STANDS_STILL_S:
            return []
        was_known, self._steady_s = self.outage, np.inf
        self.outage = f"positions of all servos stand still since {since_s:.1f} s: servo bus?"
        return [] if was_known else [Event(now_s, self.name, "no_data", text=self.outage)]

    @property
    def is_watched(self) -> bool:
        """Whether residuals are being judged."""
        return self.stream is not None and not self.silenced

    @property
    def silenced(self) -> str:
        """Why nothing is known of it now, in words; empty if there is no reason."""
        return self.suspended or self.outage or self.problem

    def rests(self, for_s: float) -> bool:
        """Whether nothing is looked into for so long [s] after what was evaluated last, as far as is known now."""
        if self.is_calm or self.reading is None:
            return self.is_calm
        return self.next_s - self.reading.time_s > for_s

    @property
    def was_judged(self) -> bool:
        """Whether any sample was ever judged."""
        return self.reading is not None and self.stream is not None

    @property
    def is_heard(self) -> bool:
        """Whether any position has come, or current where that is watched."""
        return bool(np.isfinite(self._received["position"][0]))

    @property
    def unjudged(self) -> str:
        """Why this surface was not judged to the end, and for most of its time, in words; empty if it was."""
        if self.silenced:
            return self.silenced
        if self.reading is None or not self.was_judged:
            channels = {"command": self.surface.command.channel, "position": self.surface.watched_channel}
            missing = [channel for what, channel in channels.items() if np.isnan(self._received[what][0])]
            return f"no {' and no '.join(missing)} came" if missing else "never judged"
        share = self._judged_s / max(self.reading.time_s - self._begun_s, 1e-9)
        return f"judged for {share:.0%} of the time" if share < _MOST else self.unseen

    @property
    def needs(self) -> frozenset[str]:
        """What acts on its servo beside the command, by the names of `servofd.aircraft.series.SURROUNDINGS`."""
        return self._healthy.needs

    @property
    def _healthy(self) -> HealthyStream:
        return self.beside or Healthy(self.surface, self.model)

    @property
    def rate_hz(self) -> float:
        """Of the positions, lately [Hz]; NaN if that is not known."""
        if len(self._recent) < 2:
            return float("nan")
        return (len(self._recent) - 1) / max(self._recent[-1] - self._recent[0], 1e-9)

    @property
    def too_slow(self) -> str:
        """What comes too slowly for the bandwidth of the servo, in words; empty if nothing does."""
        return self._slow if self.stream is not None else ""

    def excuse(self, gap_s: float, until_s: float) -> None:
        """Nothing of the vehicle was received for so long, until then [s]: that is no silence of this surface alone."""
        self._excused = until_s, gap_s
        if self._reviewed is not None:
            self._reviewed = self._reviewed[0] + gap_s, self._reviewed[1]
        for received in self._received.values():
            received[1] += gap_s

    def suspend(self, why: str, now_s: float) -> list[Event]:
        """Tell that nothing is known of this surface from now on [s], and why; empty: it is watched again."""
        was_known, self.suspended = self.suspended, why
        return [Event(now_s, self.name, "no_data", text=why)] if why and not was_known else []

    def may_wait(self, commands: int, positions: int) -> bool:
        """Whether so many commands and positions that have come need not be evaluated yet.

        One position may wait for the next while the residual is far below its threshold, and commands while no
        position waits for them: evaluating two together costs what one does.
        """
        if self.stream is None or self.reading is None or commands > 2 * _TOGETHER or positions >= _TOGETHER:
            return False
        quiet = self._period_s <= _FAST_S and self.at_ease
        return quiet if positions else (quiet and commands < _TOGETHER) or not self.stream.is_waiting

    @property
    def at_ease(self) -> bool:
        """Whether no alarm is near: it is not judged, or stands in alarm, or is far below its threshold."""
        reading = self.reading
        if reading is None or not self.is_watched or self.standing:
            return True
        return reading.settled and abs(reading.residual_deg) < _QUIET * reading.threshold_deg

    def silence(self, now_s: float) -> list[Event]:
        """Tell, once in each outage, that commands or positions have stopped, by the vehicle's newest message [s]."""
        if self.suspended:
            return []
        for what, period_s in (("position", self._period_s), ("command", self._command_period_s)):
            last_s, excused_s = self._received[what]
            longest_s = max(self.patience_s, 5.0 * (period_s if np.isfinite(period_s) else 1.0))
            if now_s - last_s - excused_s > longest_s:
                missing = self.quantity if what == "position" else what
                was_known, self.outage, self._steady_s = self.outage, f"no {missing} since {last_s:.1f} s", np.inf
                return [] if was_known else [Event(now_s, self.name, "no_data", text=self.outage)]
        if self.outage:
            self._steady_s = min(self._steady_s, now_s)
            if now_s - self._steady_s >= _STEADY_S:
                self.outage = ""
        return []

    def finish(self) -> list[Event]:
        """End of the stream: evaluate what waits for more, and look once more at all of it."""
        events: list[Event] = []
        left = self._watch.finish()
        if self.stream is None:
            self._waiting[1].extend(left)
            events = self._begin()
        else:
            self._hand_over([], left)
        if self.stream is None:
            return events
        events += self._evaluated(self.stream.evaluate(final=True))
        look = self.look()
        return events + (self.events_of(look, look.find()) if look is not None else [])

    def restart(self) -> list[Event]:
        """Begin anew, because the vehicle did; what was found is kept."""
        events = self.finish()
        self._begin_looks()
        self._waiting = ([], [])
        self._drawn.clear()
        self._watch, self._asked_last = Watch(), (float("nan"), float("nan"))
        self._latest_seen, self._moved = float("nan"), False
        self._recent.clear()
        self._off_pace = 0
        return events

    def _alive(self, seen: list[tuple[float, float]]) -> list[Event]:
        """Follow the pace of the positions; a new one means to begin anew."""
        if not seen:
            return []
        for time_s, value in seen:
            if np.isfinite(value) and not (self._recent and time_s <= self._recent[-1]):
                self._recent.append(time_s)
        if self.stream is None or len(self._recent) <= WARM_UP_STEPS:
            return []
        self._off_pace += len(seen)
        if self._off_pace < WARM_UP_STEPS:
            return []
        self._off_pace = 0
        thin, latest_s = self._thin, self._recent[-1]
        if thin:
            events, was_known = self.restart(), self._told_slow
            self.problem, self._told_slow = thin, True
            return events if was_known else [*events, Event(latest_s, self.name, "no_data", text=thin)]
        mean_s = (self._recent[-1] - self._recent[0]) / WARM_UP_STEPS
        now = float(np.median(np.diff(np.array(self._recent)))) / self._paces_s[0]
        most = SAME_PACE if self._least_hz == SLOWEST_RATE_HZ else _SAME_LEFT
        same = any(1.0 / most <= pace <= most for pace in (now, mean_s / self._paces_s[1]))
        if same or mean_s / self._paces_s[0] > 10.0 * now:
            return []
        text = f"positions now come at {self.rate_hz:.3g} Hz, not {1.0 / self._paces_s[0]:.3g} Hz; begins anew"
        return [*self.restart(), Event(latest_s, self.name, "no_data", text=text)]

    @property
    def _thin(self) -> str:
        """That too many positions are lost to judge a servo by the rest, in words; empty if they are not."""
        steps_s = np.diff(np.array(self._recent))
        steps_s = steps_s[steps_s <= OUTAGE_S]
        if steps_s.size < 2 or 1.0 / float(np.mean(steps_s)) >= _LEAST_SHARE * self._least_hz:
            return ""
        came_hz, least_hz = 1.0 / float(np.mean(steps_s)), _LEAST_SHARE * self._least_hz
        return (
            f"{came_hz:.2g} positions a second arrive: the link is too poor to judge a servo, which takes {least_hz:g}"
        )

    def _warm_up(self, asked: list[tuple[float, float]], seen: list[tuple[float, float]]) -> list[Event]:
        """Wait for the pace, and for a position that is not always the same."""
        commands, positions = self._waiting
        for rows, new in ((commands, asked), (positions, seen)):
            for row in new:  # as the stream does: a pace of zero might come of the others
                if not rows or row[0] > rows[-1][0]:
                    rows.append(row)
        for _, value in seen:
            if np.isfinite(value):
                self._moved = self._moved or (value != self._latest_seen and np.isfinite(self._latest_seen))
                self._latest_seen = value
        if not commands or not positions:
            del commands[:-WARM_UP_STEPS], positions[:-WARM_UP_STEPS]
            return []
        now_s = max(commands[-1][0], positions[-1][0])
        for rows in (commands, positions):
            if len(rows) <= WARM_UP_STEPS and now_s - rows[0][0] <= WARM_UP_S:
                return []
        if not self._moved:
            del commands[:-_LONGEST_WAIT], positions[:-_LONGEST_WAIT]
            if self._told_still or now_s - positions[0][0] < WARM_UP_S:
                return []
            self._told_still = True
            text = f"the {self.quantity} has not changed yet: watched as soon as it does"
            return [Event(now_s, self.name, "no_data", text=text)]
        return self._begin()

    def _begin(self) -> list[Event]:
        """Design filter and threshold for the pace, and evaluate what has come so far."""
        commands, positions = self._waiting
        valued_s = np.array([time_s for time_s, value in positions if np.isfinite(value)][: WARM_UP_STEPS + 1])
        steps_s = pace_steps(valued_s)
        if not commands or steps_s.size < 2 or np.ptp([value for _, value in positions if np.isfinite(value)]) == 0.0:
            return []
        self._period_s = float(np.median(steps_s))
        came_s = pace_steps(np.array(self._recent))
        self._paces_s = float(np.median(came_s)), float(np.mean(came_s))
        logged_s = np.array([time_s for time_s, _ in commands[: WARM_UP_STEPS + 1]])
        sent_s = link_period_s(logged_s) if self.is_periodic else None
        self._least_hz = least_rate_hz(self._healthy, logged_s, is_link=sent_s is not None)
        few = too_few(self._healthy, self._period_s, logged_s, valued_s, is_link=sent_s is not None)
        problem, stream = few or self._thin, None
        if not problem:
            try:
                stream = self._healthy.stream(Pace(self._period_s, logged_s, sent_s))
            except DesignError as error:
                problem = str(error)
        if stream is None:
            was_known, self.problem, self._told_slow = self._told_slow, problem, True
            self._waiting = ([], positions[-WARM_UP_STEPS // 2 :])
            return [] if was_known else [Event(positions[-1][0], self.name, "no_data", text=problem)]
        self.problem, self.stream = "", stream
        self._command_period_s = float(np.median(pace_steps(logged_s)))
        if self.quantity == "position":
            self._slow = too_slow(self.model.transfer.bandwidth_rad_s, self._period_s, self._command_period_s)
        self._begun_s = min(self._begun_s, float(valued_s[0]))
        stream.surroundings(self.context)
        self._waiting = ([], [])
        self._hand_over(commands, positions)
        return self._evaluated(stream.evaluate())

    def _hand_over(self, asked: list[tuple[float, float]], seen: list[tuple[float, float]]) -> None:
        if self.stream is not None:
            self.stream.commands(*np.array(asked, dtype=float).reshape(-1, 2).T)
            for time_s, measured_deg in seen:
                self.stream.position(time_s, measured_deg)
            for time_s, current in self._drawn:
                self.stream.drawn(time_s, current)
            self._drawn.clear()

    def _evaluated(self, piece: Piece | None) -> list[Event]:
        """Events of a piece."""
        if self.stream is not None and self.stream.beside is not None:
            self._shown_beside(self.stream.beside)
        if piece is None or self.stream is None:
            return []
        residuals, level_deg = piece.residuals, piece.threshold.level_deg
        events = self._taken(piece)
        valued = np.isfinite(residuals.measured_deg)
        if valued.any():
            valued_s = residuals.time_s[valued]
            begin_s = self._valued_s if np.isfinite(self._valued_s) else valued_s[0]
            steps_s = np.minimum(np.diff(valued_s, prepend=begin_s), OUTAGE_S)
            self._judged_s += float(steps_s[(residuals.settled & piece.sharp)[valued]].sum())
            self._valued_s = float(valued_s[-1])
            events += self._hardly_judged()
        last = int(residuals.time_s.size) - 1
        commands = self.stream.logged.commands().command_deg
        if self.listener is not None:
            came_s = self.stream.logged.time_s
            held = np.searchsorted(came_s, residuals.time_s, side="right") - 1
            asked_deg = commands[np.maximum(held, 0)] if commands.size else np.full(held.size, np.nan)
            new = slice(int(np.searchsorted(came_s, self._passed_on_s, side="right")), None)
            came = came_s[new].copy(), commands[new].copy()
            self.listener(self.name, piece, Inputs(asked_deg, *came, self.context, is_current=bool(self.stands_in)))
            self._passed_on_s = float(came_s[-1]) if came_s.size else self._passed_on_s
        self.reading = Reading(
            float(residuals.time_s[last]),
            float(commands[-1]) if commands.size else float("nan"),
            float(residuals.measured_deg[last]),
            float(residuals.residual_deg[last]),
            float(level_deg[last]),
            bool(residuals.settled[last]),
        )
        return events

    def _shown_beside(self, piece: Piece) -> None:
        """Keep what was drawn beside the position, and pass it on."""
        r, level_a = piece.residuals, piece.threshold.level_deg
        command_deg = float(self.stream.logged.commands().command_deg[-1]) if self.stream is not None else np.nan
        last = float(r.time_s[-1]), command_deg, float(r.measured_deg[-1]), float(r.residual_deg[-1])
        self.drawn = Reading(*last, float(level_a[-1]), bool(r.settled[-1]))
        if self.listener is not None:
            none = np.zeros(0)
            self.listener(self.name, piece, Inputs(none, none, none, self.context, is_current=True))

    def _hardly_judged(self) -> list[Event]:
        """Say once that a link leaves too few commands to judge the servo for most of the time, and how many would."""
        since_s, judged_s = self._reviewed or (self._valued_s, self._judged_s)
        if self._reviewed is None or self._valued_s - since_s >= _REVIEW_S:
            self._reviewed = self._valued_s, self._judged_s
        share = (self._judged_s - judged_s) / max(self._valued_s - since_s, 1e-9)
        is_told = bool(self._told_slow or self.outage)
        if not self.is_periodic or self._valued_s - since_s < _REVIEW_S or share >= _MOST or is_told:
            return []
        self._told_slow = True
        lost, borne = self._borne(since_s, share)
        text = f"the link is too poor: {lost}a fault would show for {share:.0%} of the last {_REVIEW_S:g} s{borne}"
        return [Event(self._valued_s, self.name, "no_data", text=text)]

    def _borne(self, since_s: float, share: float) -> tuple[str, str]:
        """How many commands are lost since then [s], and how many may be if most of the time is to be judged, in words.

        A position is judged where some commands before it came; with `share` of them judged that is as many as make
        it so likely.
        """
        lost = self.stream.lost_share(since_s) if self.stream is not None else 0.0
        if not 0.0 < lost < 1.0 or not 0.0 < share < _MOST:
            return "", ""
        borne = 1.0 - float(np.exp(np.log(1.0 - lost) * np.log(_MOST) / np.log(share)))
        return f"{lost:.0%} of the commands are lost, and ", f"; up to {borne:.0%} lost it would for most"
