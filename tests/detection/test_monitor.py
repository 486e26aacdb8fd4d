"""A monitor in flight does what an audit does: the same residuals, alarms at the same times, and names."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from servofd.aircraft.marks import Why
from servofd.aircraft.pace import WARM_UP_STEPS
from servofd.aircraft.schema import Surface, plain_aircraft
from servofd.aircraft.series import Series, is_unsettled
from servofd.aircraft.watch import Bus, New
from servofd.detection.event import Event, Look
from servofd.detection.faults import Found
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.named import with_hold
from servofd.detection.seen import Healthy, Pace
from servofd.detection.stream import CommandBuffer, History, Piece
from servofd.detection.verdict import Fault
from servofd.servo.servo_model import ServoModel
from tests.detection.windows import troubled, without_spikes

SAME_DEG = 1e-9
TIME_S = np.arange(0.0, 40.0, 0.02)
COMMAND_DEG = 8.0 * np.sin(1.3 * TIME_S) + 6.0 * np.sign(np.sin(0.7 * TIME_S))
NOTHING = np.zeros(0)


def surface(kind: str = "interval", servo: str = "s9254") -> tuple[Surface, ServoModel]:
    aircraft = plain_aircraft(["x"], servo)
    return aircraft.surfaces["x"].model_copy(update={"threshold": kind}), aircraft.model("x")


def flight(seed: int, *, servo: str = "s9254", lost: float = 0.0, stuck_s: float = 1e9) -> Series:
    """A noisy flight with lost samples, spikes, which are marked, a hole, and maybe a jam."""
    rng = np.random.default_rng(seed)
    _, model = surface(servo=servo)
    measured_deg = model.simulate(TIME_S, COMMAND_DEG, TIME_S) + 0.05 * rng.standard_normal(TIME_S.size)
    jammed = np.searchsorted(TIME_S, min(stuck_s, TIME_S[-1]))
    if stuck_s < TIME_S[-1]:
        measured_deg[jammed:] = measured_deg[jammed]
    measured_deg[700] += 20.0
    measured_deg[900:902] -= 9.0
    measured_deg = without_spikes(TIME_S, COMMAND_DEG, measured_deg)
    measured_deg[1200:1230] = np.nan
    asked, seen = rng.random(TIME_S.size) >= lost, rng.random(TIME_S.size) >= lost
    asked[1000:1040] = False
    why = is_unsettled((TIME_S[asked], COMMAND_DEG[asked]), TIME_S[seen], measured_deg[seen], TIME_S[seen]) * np.int8(
        Why.UNSETTLED
    )
    return Series("x", TIME_S[asked], COMMAND_DEG[asked], TIME_S[seen], measured_deg[seen], why=why)


def in_order(segment: Series) -> list[tuple[float, int, float]]:
    asked = zip(segment.command_s.tolist(), [0] * segment.command_s.size, segment.command_deg.tolist(), strict=True)
    seen = zip(segment.measured_s.tolist(), [1] * segment.measured_s.size, segment.measured_deg.tolist(), strict=True)
    return sorted([*asked, *seen], key=lambda sample: sample[:2])


def assert_same_as_offline(model: ServoModel, raw: Series, entry: Surface) -> None:
    """Residual and threshold of a stream that is cut at random are those of the whole."""
    assert with_hold(model, raw)[1] == ()
    healthy = Healthy(entry, model)
    whole = healthy.beside(raw)
    residuals, threshold = whole.residuals, whole.threshold
    stream = healthy.stream(Pace(raw.period_s, raw.command_s[: WARM_UP_STEPS + 1], None))
    rng = np.random.default_rng(2)
    evaluated: list[Piece | None] = []
    commands: list[tuple[float, float]] = []
    for time_s, role, value in [*in_order(raw), (np.inf, 1, np.nan)]:
        if role:
            stream.position(time_s, value)
        else:
            commands.append((time_s, value))
        if time_s == np.inf or rng.random() < 0.3:
            stream.commands(*np.array(commands).reshape(-1, 2).T)
            commands.clear()
            evaluated.append(stream.evaluate())
    pieces = [piece for piece in (*evaluated, stream.evaluate(final=True)) if piece is not None]
    for name in ("simulated_deg", "measured_deg", "residual_deg", "settled", "time_s"):
        together = np.concatenate([getattr(piece.residuals, name) for piece in pieces])
        np.testing.assert_allclose(together, getattr(residuals, name), rtol=0.0, atol=SAME_DEG, err_msg=name)
    for name in ("level_deg", "sigma_deg"):
        together = np.concatenate([getattr(piece.threshold, name) for piece in pieces])
        np.testing.assert_allclose(together, getattr(threshold, name), rtol=1e-9, atol=SAME_DEG, err_msg=name)


class TestTheSameStepAsOffline:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("servo", "lost", "period_s"),
        [
            ("hs225bb-eq31", 0.3, None),
            ("s9254", 0.05, 0.02),
            *(
                pytest.param(servo, lost, period_s, marks=pytest.mark.nightly)
                for servo in ("hs225bb-eq31", "s9254")
                for lost in (0.0, 0.05, 0.3)
                for period_s in (None, 0.02)
                if (lost, period_s) not in ((0.3, None), (0.05, 0.02))
            ),
        ],
    )
    def test_residual_and_threshold_do_not_depend_on_how_a_stream_is_cut(
        self, servo: str, lost: float, period_s: float | None
    ) -> None:
        entry, model = surface(servo=servo)
        if period_s is not None:
            entry = entry.model_copy(update={"command_hold": "linear", "command_period_s": period_s})
        raw = replace(flight(1, servo=servo, lost=lost, stuck_s=30.0), command_period_s=period_s)
        assert_same_as_offline(model, raw, entry)

    @pytest.mark.slow
    @pytest.mark.parametrize("servo", ["hs225bb-eq31", "s9254", "s3151"])
    def test_in_twelve_seconds_of_all_that_can_happen(self, servo: str) -> None:
        entry, model = surface(servo=servo)
        assert_same_as_offline(model, troubled(servo), entry)

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("kind", "lost"),
        [
            ("interval", 0.05),
            *(
                pytest.param(*each, marks=pytest.mark.nightly)
                for each in (("interval", 0.0), ("constant", 0.0), ("constant", 0.05))
            ),
        ],
    )
    def test_alarms_come_at_the_same_times_with_the_same_names(self, kind: str, lost: float) -> None:
        entry, model = surface(kind)
        raw = flight(4, lost=lost, stuck_s=22.0)
        found = Healthy(entry, model).beside(raw).found
        monitor, events = watched(entry, model, raw, 5)
        assert [(f.kind, f.alarm_s, f.end_s) for f in monitor.faults] == [
            (f.kind, f.alarm_s, f.end_s) for f in found.faults
        ]
        assert [f.kind for f in found.faults] == ["stuck"]
        alarms = [event.time_s for event in events if event.event == "alarm"]
        assert alarms == [f.alarm_s for f in found.faults]
        named = [event for event in events if event.event == "named"]
        assert named[-1].kind == "stuck"
        assert named[0].time_s - alarms[0] < 4.1

    @pytest.mark.slow
    def test_a_healthy_flight_is_quiet(self) -> None:
        entry, model = surface()
        monitor, events = watched(entry, model, flight(5, lost=0.05), 5)
        assert (events, monitor.has_fault, monitor.was_judged) == ([], False, True)


def watched(entry: Surface, model: ServoModel, segment: Series, piece: int = 1) -> tuple[SurfaceMonitor, list[Event]]:
    """Feed a monitor so many samples at a time, and let the bank look whenever it wants to."""
    monitor = SurfaceMonitor("x", entry, model)
    events: list[Event] = []
    samples = in_order(segment)
    for begin in range(0, len(samples), piece):
        rows = np.array(samples[begin : begin + piece]).T
        asked, seen = (rows[0][rows[1] == role] for role in (0, 1)), (rows[2][rows[1] == role] for role in (0, 1))
        commands, positions = zip(asked, seen, strict=True)
        events += monitor.feed(commands, positions)
        while look := monitor.due():
            events += monitor.events_of(look, look.find())
    return monitor, events + monitor.finish()


@pytest.mark.nightly
@pytest.mark.parametrize("what", ["jam", "offset"])
def test_pieces_of_any_length_tell_the_same_at_the_same_times(what: str) -> None:
    entry, model = surface()
    segment = flight(3)
    measured_deg, at_fault = segment.measured_deg.copy(), (segment.measured_s >= 26.0) & (segment.measured_s < 32.0)
    measured_deg[at_fault] = measured_deg[at_fault][0] if what == "jam" else measured_deg[at_fault] + 2.0
    faulty = replace(segment, measured_deg=measured_deg)
    told = [watched(entry, model, faulty, piece)[1] for piece in (1, 37)]
    seen = [[(event.time_s, event.event, event.kind) for event in events] for events in told]
    assert [event for _, event, _ in seen[0] if event != "named"] == ["alarm", "clear"]
    assert seen[1] == seen[0]


class TestNoVerdictFromNoMeasurement:
    @pytest.mark.slow
    def test_a_wrong_scale_is_one_alarm_that_is_taken_back_and_then_said(self) -> None:
        entry, model = surface()
        right = flight(3)
        monitor, events = watched(entry, model, replace(right, measured_deg=2.0 * right.measured_deg), 5)
        assert [event.event for event in events if event.event != "named"] == ["alarm", "clear"]
        assert "check the scale" in monitor.unjudged
        assert not monitor.has_fault

    @pytest.mark.slow
    def test_a_position_that_never_changes_is_none(self) -> None:
        entry, model = surface()
        constant = Series("x", TIME_S, COMMAND_DEG, TIME_S, np.full(TIME_S.size, 3.0))
        monitor, events = watched(entry, model, constant)
        assert [(event.event, event.text) for event in events] == [
            ("no_data", "the position has not changed yet: watched as soon as it does")
        ]
        assert not monitor.was_judged

    @pytest.mark.slow
    def test_slow_positions_are_refused(self) -> None:
        entry, model = surface()
        slow = flight(6)
        slow = Series("x", slow.command_s, slow.command_deg, slow.measured_s[::10], slow.measured_deg[::10])
        monitor, events = watched(entry, model, slow)
        assert "a servo cannot be judged below 8 Hz" in events[0].text
        assert not monitor.is_watched

    def test_silence_is_told_once_and_raises_no_alarm(self) -> None:
        entry, model = surface()
        raw = flight(7)
        monitor, events = SurfaceMonitor("x", entry, model), []
        half = raw.measured_s < 20.0
        events += monitor.feed((raw.command_s, raw.command_deg), (raw.measured_s[half], raw.measured_deg[half]))
        events += [event for now_s in np.arange(20.0, 40.0, 0.5) for event in monitor.silence(now_s)]
        assert [(event.event, event.time_s) for event in events] == [("no_data", 22.0)]

    @pytest.mark.slow
    def test_a_new_pace_begins_anew(self) -> None:
        entry, model = surface()
        raw = flight(8)
        late = raw.measured_s >= 20.0
        keep = ~late | (np.arange(raw.measured_s.size) % 2 == 0)
        monitor, events = watched(
            entry, model, Series("x", raw.command_s, raw.command_deg, raw.measured_s[keep], raw.measured_deg[keep])
        )
        assert [event.event for event in events] == ["no_data"]
        assert "Hz, not 50 Hz" in events[0].text
        assert monitor.is_watched


class TestWhatTheBankTells:
    """Alarms of one surface, as looks at them tell more."""

    stuck = Fault("stuck", 11.8, 12.0, None, {}, 0.99, ())
    healthy = Fault("healthy", 11.8, 12.0, None, {}, 0.99, ())

    @staticmethod
    def told(monitor: SurfaceMonitor, at_s: float, *faults: Fault, problem: str = "") -> list[tuple[float, str, str]]:
        time_s = np.arange(0.0, at_s, 0.1)
        levels = SimpleNamespace(time_s=time_s, residual_deg=2.0 * time_s, level_deg=0.0 * time_s + 1.5)
        look = cast("Look", SimpleNamespace(at_s=at_s, residuals=levels, threshold=levels))
        wrong = tuple(fault for fault in faults if fault.kind != "healthy")
        right = tuple(fault for fault in faults if fault.kind == "healthy")
        events = monitor.events_of(look, Found(wrong, right, 0.0 * time_s, problem))
        return [(event.time_s, event.event, event.kind) for event in events]

    def test_a_name_a_better_name_and_an_end(self) -> None:
        monitor = SurfaceMonitor("x", *surface())
        assert self.told(monitor, 13.0, self.stuck) == [(13.0, "alarm", "stuck")]
        assert (monitor.standing, monitor.has_fault, monitor.faults) == ("stuck", True, (self.stuck,))
        assert self.told(monitor, 13.5, self.stuck) == []
        floating = replace(self.stuck, kind="floating")
        assert self.told(monitor, 14.0, floating) == [(14.0, "named", "floating")]
        bias = replace(self.stuck, kind="bias")
        unsure = replace(bias, probability=0.9)
        assert self.told(monitor, 15.0, unsure) == []  # more than 2 s after the alarm: for the report alone
        assert monitor.standing == "bias"
        assert self.told(monitor, 15.5, self.stuck) == [(15.5, "named", "stuck")]
        assert self.told(monitor, 15.7, bias) == [(15.7, "named", "bias")]
        over = replace(bias, end_s=14.5)
        assert self.told(monitor, 16.0, over) == [(16.0, "clear", "bias")]
        assert (monitor.standing, monitor.has_fault, monitor.faults) == ("", True, (over,))
        assert self.told(monitor, 17.0, over) == []

    def test_a_name_that_becomes_sure_late_is_reported_and_stays_a_fault(self) -> None:
        monitor = SurfaceMonitor("x", *surface())
        unknown, slow = (replace(self.stuck, kind=kind, probability=0.7) for kind in ("unknown", "slow"))
        self.told(monitor, 12.3, unknown)
        assert self.told(monitor, 15.0, slow) == []
        assert self.told(monitor, 18.0, replace(slow, probability=0.99)) == [(18.0, "named", "slow")]
        assert [what for _, what, _ in self.told(monitor, 19.0, replace(unknown, end_s=13.0))] == ["clear"]
        assert monitor.has_fault

    def test_what_is_over_within_two_seconds_without_a_name_is_no_fault_but_to_be_looked_at(self) -> None:
        monitor = SurfaceMonitor("x", *surface())
        self.told(monitor, 12.3, replace(self.stuck, kind="unknown"))
        over = replace(self.stuck, kind="unknown", end_s=12.9)
        assert [what for _, what, _ in self.told(monitor, 13.0, over)] == ["clear"]
        assert (monitor.has_fault, monitor.suspicions) == (False, (over,))

    def test_what_tolerances_explain_is_acquitted_until_they_do_not(self) -> None:
        monitor = SurfaceMonitor("x", *surface())
        self.told(monitor, 13.0, self.stuck)
        assert self.told(monitor, 14.0, self.healthy) == []  # one look does not take back what another one has named
        assert self.told(monitor, 15.0, self.healthy) == [(15.0, "clear", "healthy")]
        assert (monitor.standing, monitor.has_fault, monitor.faults) == ("", False, ())
        assert self.told(monitor, 15.5, self.healthy) == []
        assert self.told(monitor, 16.0, self.stuck) == [(16.0, "alarm", "stuck")]
        assert (monitor.has_fault, monitor.faults) == (True, (self.stuck,))

    def test_a_finished_fault_never_returns(self) -> None:
        monitor = SurfaceMonitor("x", *surface())
        over, later = replace(self.stuck, end_s=15.0), replace(self.stuck, start_s=19.0, alarm_s=20.0)
        self.told(monitor, 21.0, over, later)
        assert self.told(monitor, 22.0, self.stuck) == []
        assert monitor.faults == (over, later)

    def test_a_wrong_calibration_takes_everything_back(self) -> None:
        monitor = SurfaceMonitor("x", *surface())
        self.told(monitor, 13.0, self.stuck)
        assert self.told(monitor, 14.0, problem="check the sign") == [(14.0, "clear", "unknown")]
        assert (monitor.problem, monitor.is_watched, monitor.has_fault) == ("check the sign", False, False)


class TestPace:
    @pytest.fixture
    def monitor(self) -> SurfaceMonitor:
        """Three seconds at 50 Hz."""
        entry, model = surface(servo="hs225bb-eq31")
        monitor, time_s = SurfaceMonitor("x", entry, model), TIME_S[:150]
        position_deg = model.simulate(time_s, COMMAND_DEG[:150], time_s)
        assert monitor.feed((time_s, COMMAND_DEG[:150]), (time_s, position_deg)) == []
        assert monitor.is_watched
        return monitor

    @pytest.mark.parametrize(("interval_s", "is_new"), [(0.0125, True), (0.014, False), (0.029, False), (0.031, True)])
    def test_half_as_fast_again_is_still_the_same(
        self, monitor: SurfaceMonitor, interval_s: float, is_new: bool
    ) -> None:
        later_s = np.linspace(2.98 + interval_s, 2.98 + 101 * interval_s, 101)
        events = monitor.feed((NOTHING, NOTHING), (later_s, np.sin(later_s)))
        texts = [event.text for event in events if event.event == "no_data"]
        told = f"positions now come at {1.0 / interval_s:.3g} Hz, not 50 Hz; begins anew"
        assert texts == [told] * is_new
        assert monitor.is_watched != is_new
        assert monitor.rate_hz == pytest.approx(1.0 / interval_s) or is_new

    @pytest.mark.parametrize(("bursts_s", "is_new"), [(0.4, False), (0.1, True)])
    def test_bursts_of_late_positions_are_no_new_pace(
        self, monitor: SurfaceMonitor, bursts_s: float, is_new: bool
    ) -> None:
        """Twenty within 20 ms, every so often: on the average one in 20 ms, or one in 5 ms."""
        later_s = 3.0 + (bursts_s * np.arange(6)[:, None] + 0.001 * np.arange(20)).ravel()
        events = monitor.feed((NOTHING, NOTHING), (later_s, np.sin(later_s)))
        assert bool([event for event in events if event.event == "no_data"]) == is_new

    def test_hundred_positions_are_needed_to_tell_a_new_one(self, monitor: SurfaceMonitor) -> None:
        later_s = np.linspace(3.02, 6.94, 99)
        events = monitor.feed((NOTHING, NOTHING), (later_s, np.sin(later_s)))
        assert monitor.is_watched
        assert "no_data" not in {event.event for event in events}

    def test_what_was_too_slow_is_watched_once_it_is_quick_enough(self) -> None:
        monitor = SurfaceMonitor("x", *surface(servo="hs225bb-eq31"))
        slow_s = np.arange(101) / 5.0
        (refused,) = monitor.feed((slow_s, np.zeros(101)), (slow_s, np.sin(slow_s)))
        assert refused.text == "position comes at 5 Hz; a servo cannot be judged below 8 Hz"
        assert (refused.time_s, monitor.is_watched) == (20.0, False)
        quick_s = 20.0 + np.arange(1, 102) / 50.0
        monitor.feed((quick_s, np.zeros(101)), (quick_s, np.sin(quick_s)))
        assert (monitor.is_watched, monitor.problem) == (True, "")


@pytest.mark.slow
def test_a_link_that_becomes_too_thin_is_told_once_and_raises_no_alarm() -> None:
    """From 20 s on one position in twelve arrives, at random."""
    entry, model = surface()
    rng, time_s = np.random.default_rng(2), np.arange(0.0, 80.0, 0.02)
    command_deg = 10.0 * np.sin(1.3 * time_s)
    measured_deg = model.simulate(time_s, command_deg, time_s) + 0.05 * rng.standard_normal(time_s.size)
    kept = (time_s < 20.0) | (rng.random(time_s.size) < 1.0 / 12.0)
    monitor, events = watched(entry, model, Series("x", time_s, command_deg, time_s[kept], measured_deg[kept]), 5)
    assert [event.event for event in events] == ["no_data"]
    assert "positions a second arrive" in events[0].text
    assert not monitor.is_watched


@pytest.mark.slow
def test_memory_is_bounded() -> None:
    """Arrays that were made at the start are all there is, however long the flight."""
    entry, model = surface()
    monitor = SurfaceMonitor("x", entry, model)
    sizes = []
    time_s, command_deg = np.arange(40.0 * TIME_S.size) / 50.0, np.tile(COMMAND_DEG, 40)
    position_deg = model.simulate(time_s, command_deg, time_s)
    for lap in range(40):
        here = slice(lap * TIME_S.size, (lap + 1) * TIME_S.size)
        monitor.feed((time_s[here], command_deg[here]), (time_s[here], position_deg[here] + 1e-6 * lap))
        stream = monitor.stream
        assert stream is not None
        sizes.append((stream.history.size <= 30_000, stream.logged.size <= 120_000))
    assert all(all(size) for size in sizes)
    assert not monitor.has_fault


class TestMemory:
    def test_a_full_history_drops_a_quarter_and_says_so(self) -> None:
        history = History(8)
        rows = np.tile(np.arange(8.0), (history.rows.shape[0], 1))
        history.append(rows)
        assert (history.size, history.last_s) == (8, 7.0)
        history.append(rows[:, :1] + 8.0)
        assert (history.size, history.last_s) == (7, 8.0)
        history.append(np.tile(np.arange(9.0, 29.0), (history.rows.shape[0], 1)))
        assert (history.size, history.last_s) == (7, 28.0)
        assert np.isnan(History(4).last_s)

    def test_a_full_buffer_of_commands_drops_a_quarter(self) -> None:
        buffer = CommandBuffer(8)
        time_s = np.arange(10.0)
        assert [buffer.add(time_s[[k]], 2.0 * time_s[[k]]) for k in range(10)] == [0] * 8 + [2, 0]
        at_once = CommandBuffer(8)
        assert at_once.add(time_s, 2.0 * time_s) == 2
        assert buffer.time_s.tolist() == at_once.time_s.tolist() == time_s[2:].tolist()


def bus_that_stops(for_s: float, at_once: int) -> tuple[SurfaceMonitor, list[Event]]:
    """A bus stops at 10 s while one servo is asked to move and the others flicker at rest: it is not known at once."""
    names, rng = ("elevator", "aileron", "rudder", "flap"), np.random.default_rng(5)
    aircraft = plain_aircraft(names, "hs225bb-eq31")
    model, time_s = aircraft.model("elevator"), np.arange(0.0, 20.0, 0.04)
    asked_deg = np.where(time_s < 3.0, 8.0 * np.sin(3.0 * time_s), np.where(time_s < 10.0, 0.0, 10.0))
    read_deg = 0.5 * np.round(rng.uniform(-0.5, 0.5, (4, time_s.size)) * 1.4)
    read_deg[0] = 0.5 * np.round(2.0 * model.simulate(time_s, asked_deg, time_s))
    stopped = (time_s >= 10.0) & (time_s < 10.0 + for_s)
    read_deg[:, stopped] = read_deg[:, [np.argmax(stopped) - 1]]
    bus, monitor = Bus(names), SurfaceMonitor("elevator", aircraft.surfaces["elevator"], model)
    events: list[Event] = []
    for rows in np.split(np.arange(time_s.size), np.arange(at_once, time_s.size, at_once)):
        new = {
            name: New(time_s[rows], asked_deg[rows] * (name == "elevator"), time_s[rows], read_deg[k, rows])
            for k, name in enumerate(names)
        }
        stands = bus.take(new)
        events += monitor.feed(new["elevator"][:2], new["elevator"][2:4], stands["elevator"], bus.stood_s)
        if look := monitor.due():
            events += monitor.events_of(look, look.find())
    return monitor, events + monitor.finish()


@pytest.mark.parametrize("at_once", [1, 25])
def test_an_alarm_is_taken_back_where_all_positions_turn_out_to_have_stood_still(at_once: int) -> None:
    monitor, events = bus_that_stops(0.8, at_once)
    assert [event.event for event in events] == ["alarm", "clear"]
    assert 10.0 <= events[0].time_s <= events[1].time_s <= 11.0 + 0.04 * at_once
    assert "stood still" in events[1].text
    assert not monitor.has_fault


@pytest.mark.parametrize("at_once", [1, 100])
def test_a_bus_that_stood_for_more_than_a_second_is_told_however_much_is_evaluated_at_once(at_once: int) -> None:
    _, events = bus_that_stops(1.5, at_once)
    told = [event for event in events if event.event == "no_data"]
    assert [event.text for event in told] == ["positions of all servos stand still since 10.0 s: servo bus?"]
    assert told[0].time_s <= 11.7
