"""What a real ArduPilot does on a link, done by the simulated one: the monitor stays quiet, and finds the jam."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from logparsers.codec import Codec
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.cli import main
from servofd.live.session import Session
from servofd.live.view import View
from servofd.simulation.vehicle.fly import legs
from servofd.simulation.vehicle.troubles import Air, Edit, Freeze, Jump, Late, Pause, Reboot, Silence, Stall, Trouble
from servofd.simulation.vehicle.vehicle import Settings
from tests.live.test_troubles import STEPPED, Field, kinds, lively
from tests.live.vehicles import PLANE, ask, command, plane_file, said, vehicle

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.detection.event import Event

EPOCH_S = 1.7e9


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    path: Path = tmp_path_factory.mktemp("plane") / "plane.toml"
    path.write_text(plane_file())
    return load_aircraft(path)


def watched(aircraft: Aircraft, *troubles: Trouble, **options: Any) -> tuple[Session, list[Event]]:
    """A flight of 40 s with a jam at 30 s, as it arrives."""
    flight = lively(**({"duration_s": 40.0, "stuck_s": 30.0} | options))
    codec, air, session, events = Codec(1, 1), Air(troubles), Session(Codec(0, 191), {0: aircraft}), []
    now_s = 0.0
    for leg in legs(flight, PLANE, Settings(message_hz=40.0, troubles=tuple(troubles))):
        times_us = leg.vehicle.time_us
        leg.vehicle.receive(said("PARAM_REQUEST_LIST"), 0)
        for index in range(times_us.size):
            now_s = leg.begun_s + 1e-6 * float(times_us[index] - times_us[0])
            codec.skip(air.jump(now_s))
            frames = [codec.encode(*message) for message in leg.vehicle.turn(index)]
            for frame in air.through(now_s, frames):
                events += session.take(EPOCH_S + now_s, frame)
            if index % STEPPED == 0:
                events += session.step(EPOCH_S + now_s)
    while not air.empty:
        now_s += 0.02
        for frame in air.through(now_s, []):
            events += session.take(EPOCH_S + now_s, frame)
        events += session.step(EPOCH_S + now_s)
    return session, events + session.finish(EPOCH_S + now_s)


TROUBLES: dict[str, tuple[Trouble, ...]] = {
    "none": (),
    "1.1 s late": (Late(20.0, by_s=1.1),),
    "4 s late": (Late(20.0),),
    "10 s late": (Late(20.0, by_s=10.0),),
    "a pause, then a burst": (Pause(20.0, for_s=6.0),),
    "a silence": (Silence(12.0, for_s=8.0),),
    "numbers that jump": (Jump(10.0), Jump(20.0, by=100.0)),
    "a frozen bus": (Freeze(18.0), Freeze(22.0)),
    "a bus frozen for long": (Freeze(18.0, for_s=1.5),),
    "a trim and a direction": (Edit(18.0, "SERVO2_TRIM", 1560.0), Edit(21.0, "SERVO4_REVERSED", 1.0)),
    "travel": (Edit(18.0, "SERVO1_MIN", 1200.0), Edit(19.0, "SERVO1_MAX", 1800.0)),
}


@pytest.mark.slow
def test_the_jam_alone_is_told_on_a_bus_that_freezes(aircraft: Aircraft) -> None:
    """The shortest of these flights: what happens at 18 s and later in the others begins as soon as can be."""
    _, events = watched(aircraft, Freeze(10.0), Freeze(12.0), stuck_s=15.0, duration_s=19.0)
    assert [surface for surface, _ in kinds(events, "alarm")] == ["elevator"]
    assert kinds(events, "alarm")[0][1] == pytest.approx(15.3, abs=0.5)
    assert [e.kind for e in events if e.event == "named"] == ["stuck"]
    assert kinds(events, "no_data") == []


@pytest.mark.slow
def test_surfaces_that_are_not_watched_tell_a_frozen_bus_from_a_jam(aircraft: Aircraft) -> None:
    surfaces = {
        name: surface if name == "elevator" else surface.model_copy(update={"servo": "unknown"})
        for name, surface in aircraft.surfaces.items()
    }
    one = aircraft.model_copy(update={"surfaces": surfaces})
    session, events = watched(one, Freeze(10.0, for_s=0.6), stuck_s=None, duration_s=13.0)
    assert [monitor.name for _, monitor in session.watched] == ["elevator"]
    assert kinds(events, "alarm") == []


@pytest.mark.nightly
@pytest.mark.parametrize("trouble", TROUBLES)
def test_the_jam_alone_is_told(aircraft: Aircraft, trouble: str) -> None:
    _, events = watched(aircraft, *TROUBLES[trouble])
    assert [surface for surface, _ in kinds(events, "alarm")] == ["elevator"]
    assert kinds(events, "alarm")[0][1] == pytest.approx(30.3, abs=0.5)
    assert [e.kind for e in events if e.event == "named"] == ["stuck"]
    silent = kinds(events, "no_data")  # a bus that stands still for more than a second is told
    told = ["aileron", "elevator", "rudder"] if trouble == "a bus frozen for long" else []
    assert sorted(surface for surface, _ in silent) == told
    assert [at_s for _, at_s in silent] == pytest.approx([19.1] * len(told), abs=0.2)


@pytest.mark.slow
def test_numbers_that_jump_are_skipped_and_not_lost(aircraft: Aircraft) -> None:
    """Nobody can tell a lost frame from one that was routed elsewhere: neither is said."""
    session, events = watched(aircraft, *(Jump(at_s) for at_s in (4.0, 6.0, 8.0)), stuck_s=None, duration_s=10.0)
    link = View(session, "it").plain(EPOCH_S + 10.0)[3]
    assert session.vehicles[1].losses[1].lost == 27
    assert f"; {27 / (27 + session.frames):.1%} of " in link
    assert link.endswith(" frames did not come here")
    assert "lost" not in link.lower()
    assert [e for e in events if e.event in ("link_lost", "no_data")] == []


@pytest.mark.nightly
def test_a_restart_is_told_and_watched_on(aircraft: Aircraft) -> None:
    _, events = watched(aircraft, Reboot(12.0, away_s=4.0))
    assert [surface for surface, _ in kinds(events, "alarm")] == ["elevator"]
    # Of the boot that began 4 s after 12 s of flight.
    assert kinds(events, "alarm")[0][1] == pytest.approx(30.3 - 16.0, abs=0.5)
    assert [e.text for e in events if e.event == "no_data"] == ["vehicle 1 has restarted; the monitor begins anew"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "edit", [pytest.param(Edit(15.0), marks=pytest.mark.nightly), Edit(15.0, "SERVO2_TRIM", 1560.0)]
)
def test_what_a_parameter_changes_is_told_and_no_fault(aircraft: Aircraft, edit: Edit) -> None:
    session, events = watched(aircraft, edit, stuck_s=None, duration_s=20.0)
    assert kinds(events, "alarm") == []
    assert [note for note in session.notes if edit.name in note]


@pytest.mark.slow
@pytest.mark.parametrize("value", [160.0, pytest.param(90.0, marks=pytest.mark.nightly)])
def test_a_range_that_nobody_has_heard_before_is_asked_for_or_suspends(aircraft: Aircraft, value: float) -> None:
    """Whoever may not ask cannot know whether it is another one now."""
    flight = lively(duration_s=18.0)
    edited = Settings(message_hz=40.0, troubles=(Edit(11.0, value=value),))
    deaf, asking = (Field.of({0: aircraft}) for _ in range(2))
    deaf.session.send = None
    for field in (deaf, asking):
        field.fly(legs(flight, PLANE, edited)[0].vehicle)
        assert kinds(field.end(), "alarm") == []
    assert sorted(surface for surface, _ in kinds(deaf.events, "no_data")) == ["aileron", "elevator", "rudder"]
    assert "SERVO_VOLZ_RANGE is" in deaf.session.waiting()
    assert kinds(asking.events, "no_data") == []


def test_an_answer_to_another_reader_at_the_start_is_no_change(aircraft: Aircraft) -> None:
    """A replay, or a monitor that may not ask, hears what ArduPilot answered to a name: with place 65535."""
    session, codec = Session(Codec(0, 191), {0: aircraft}), Codec(1, 1)
    answer = {"param_id": "SERVO_VOLZ_RANGE", "param_value": 200.0, "param_type": 4, "param_count": 900}
    alive = {"type": 1, "autopilot": 3, "base_mode": 0, "custom_mode": 0, "system_status": 4, "mavlink_version": 3}
    session.take(EPOCH_S, codec.encode("HEARTBEAT", alive))
    session.take(EPOCH_S + 4.0, codec.encode("PARAM_VALUE", answer | {"param_index": 65_535}))
    assert "SERVO_VOLZ_RANGE" not in session.waiting()
    session.take(EPOCH_S + 60.0, codec.encode("PARAM_VALUE", answer | {"param_index": 65_535, "param_value": 160.0}))
    (only,) = session.vehicles.values()
    assert any("200 -> 160: calibration follows" in news for news in only.news)


@pytest.mark.slow
@pytest.mark.parametrize("stalled_s", [pytest.param(5.0, marks=pytest.mark.nightly), 7.0])
def test_a_pause_of_the_log_around_arming_is_no_event(stalled_s: float, tmp_path: Path) -> None:
    from tests.live.test_remote_log import aircraft_of_the_card

    plane = legs(lively(duration_s=22.0), PLANE, Settings(troubles=(Stall(10.0, for_s=stalled_s),)))[0].vehicle
    field = Field.of({0: aircraft_of_the_card(tmp_path)}, remote_log=True)
    field.fly(plane)
    assert field.end() == []
    (only,) = field.session.vehicles.values()
    assert only.log is not None
    assert [monitor.was_judged for monitor in only.monitors.values()] == [True] * 3


def test_positions_cannot_be_asked_for_and_are_not(aircraft: Aircraft) -> None:
    plane = vehicle(lively(duration_s=3.0))
    answers = plane.receive(command(511, 251, 25_000), 0)
    assert [a.fields.get("text") for a in answers if a.name == "STATUSTEXT"] == ["No ap_message for mavlink id (251)"]
    assert ask(plane, 251, 25_000) == 2
    field = Field.of({0: aircraft})
    asked: list[Any] = []
    receive = plane.receive
    plane.receive = lambda message, now_us: asked.append(message.fields.get("param1")) or receive(message, now_us)  # type: ignore[func-returns-value,method-assign]
    field.fly(plane)
    assert 36.0 in asked
    assert 251.0 not in asked


@pytest.mark.slow
def test_answers_that_come_late_are_not_taken_for_others(aircraft: Aircraft) -> None:
    """Of a link of 2.5 s there and back: 50 Hz are denied, and 40 granted; nobody takes 25."""
    field, plane = Field.of({0: aircraft}), vehicle(lively(duration_s=15.0))
    receive, waiting = plane.receive, []

    def late(message: Any, now_us: int) -> list[Any]:
        waiting.append((now_us + 2_500_000, receive(message, now_us)))
        return []

    turn = plane.turn

    def with_answers(index: int) -> list[Any]:
        now_us = int(plane.time_us[index])
        due = [answer for at_us, answers in waiting if at_us <= now_us for answer in answers]
        waiting[:] = [entry for entry in waiting if entry[0] > now_us]
        return [*turn(index), *due]

    plane.receive, plane.turn = late, with_answers  # type: ignore[method-assign]
    field.fly(plane)
    notes = [note for note in field.session.notes if note.startswith("SERVO_OUTPUT_RAW")]
    assert notes == ["SERVO_OUTPUT_RAW at 50 Hz denied", "SERVO_OUTPUT_RAW at 40 Hz granted"]


@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        ("later@3", "did you mean late?"),
        ("late@3:for_s=2", "takes start_s, by_s"),
        ("late@x", "write KIND@START"),
        ("silence@5:for_s=-1", "give seconds from 0"),
        ("freeze@500", "the flight is over by then"),
    ],
)
def test_troubles_that_make_no_sense(trouble: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--stream", "udpout:14999", "--duration", "5", "--trouble", trouble]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
