"""Who is believed on a link: bound by system, component and content; others are named, and never obeyed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from logparsers.codec import Codec, Received
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.cli import main
from servofd.live.channels import ChannelTable
from servofd.live.session import Session
from tests.live.test_troubles import STEPPED, Field, kinds, lively
from tests.live.vehicles import plane_file, vehicle

if TYPE_CHECKING:
    from pathlib import Path

POSITION = "NAMED_VALUE_FLOAT[SRVP2].value"


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    path: Path = tmp_path_factory.mktemp("plane") / "plane.toml"
    path.write_text(plane_file())
    return load_aircraft(path)


def position(component: int, deg: float) -> Received:
    return Received("NAMED_VALUE_FLOAT", 1, component, {"name": "SRVP2", "value": deg})


def test_only_the_autopilot_and_who_is_named_are_sensors() -> None:
    """A companion of the same system id, or another monitor, is told of once; `1/158:` would take it."""
    table, named = ChannelTable([POSITION]), ChannelTable([f"1/158:{POSITION}"])
    for _ in range(3):
        assert not table.obeys(position(158, 40.0))
        assert table.of(position(158, 40.0)) == []
    assert table.obeys(position(1, 3.0))
    assert table.of(position(1, 3.0)) == [(POSITION, 3.0)]
    assert table.news == ["NAMED_VALUE_FLOAT: not that of component 158"]
    assert named.obeys(position(158, 40.0))
    assert named.of(position(158, 40.0)) == [(f"1/158:{POSITION}", 40.0)]
    assert named.of(position(1, 3.0)) == []


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 3e38, -3e38])
def test_what_is_no_number_of_a_servo_is_dropped_and_told_once(value: float) -> None:
    table = ChannelTable([POSITION])
    assert [table.of(position(1, value)) for _ in range(5)] == [[]] * 5
    assert len(table.news) == 1
    assert "no measurement" in table.news[0]
    assert table.of(position(1, 3.0)) == [(POSITION, 3.0)]


@pytest.mark.slow
def test_two_monitors_on_one_network_both_see(aircraft: Aircraft) -> None:
    """The other one's health, heartbeats and stamps, which run ahead, change nothing for this one."""
    field, other = Field.of({0: aircraft}), Codec(1, 191)
    plane = vehicle(lively(duration_s=14.0, stuck_s=9.0))
    turn = plane.turn

    def beside(index: int) -> list[Any]:
        ahead_ms = 5_000 + 20 * index
        for name in ("SF_ELEVATO", "SRVP2"):
            health = {"time_boot_ms": ahead_ms, "name": name, "value": 1.0}
            field.session.take(field.now_s, other.encode("NAMED_VALUE_FLOAT", health))
        beat = {"type": 18, "autopilot": 8, "mavlink_version": 3}
        field.session.take(field.now_s, other.encode("HEARTBEAT", beat))
        return turn(index)

    plane.turn = beside  # type: ignore[method-assign]
    field.fly(plane)
    events = field.end()
    assert [surface for surface, _ in kinds(events, "alarm")] == ["elevator"]
    assert kinds(events, "no_data") == []


@pytest.mark.slow
def test_a_second_sender_of_positions_raises_no_alarm_and_is_named(aircraft: Aircraft) -> None:
    field, stray, plane = Field.of({0: aircraft}), Codec(1, 158), vehicle(lively(duration_s=12.0))
    turn = plane.turn

    def beside(index: int) -> list[Any]:
        wrong = {"time_boot_ms": 1, "name": "SRVP2", "value": 44.0}
        field.session.take(field.now_s, stray.encode("NAMED_VALUE_FLOAT", wrong))
        return turn(index)

    plane.turn = beside  # type: ignore[method-assign]
    field.fly(plane)
    assert kinds(field.end(), "alarm") == []
    assert [note for note in field.session.notes if "158" in note] == ["NAMED_VALUE_FLOAT: not that of component 158"]


@pytest.mark.slow
def test_a_foreign_heartbeat_captures_nothing(aircraft: Aircraft) -> None:
    field, other = Field.of({0: aircraft}), Codec(7, 1)
    beat = other.encode("HEARTBEAT", {"type": 1, "autopilot": 3, "mavlink_version": 3})
    field.session.take(field.now_s, beat)
    assert list(field.session.vehicles) == [7], "nobody else has spoken yet"
    field.fly(vehicle(lively(duration_s=14.0, stuck_s=9.0)))
    field.session.take(field.now_s, beat)
    assert list(field.session.vehicles) == [1]
    assert {surface for surface, _ in kinds(field.end(), "alarm")} == {"elevator"}
    assert "vehicle 1 sends the positions: it is watched, not vehicle 7" in field.session.notes


@pytest.mark.slow
def test_a_vehicle_whose_number_changes_in_flight_is_watched_on(aircraft: Aircraft) -> None:
    """The operator set its system id in flight; a servo jams 8 s later."""
    field, plane = Field.of({0: aircraft}), vehicle(lively(duration_s=20.0, stuck_s=15.0))
    speakers, monitor, asked = {1: Codec(1, 1), 7: Codec(7, 1)}, Codec(1, 191), set()
    begin_s = field.now_s - 1e-6 * int(plane.time_us[0])
    for turn, now_us in enumerate(plane.time_us.tolist()):
        field.now_s = begin_s + 1e-6 * now_us
        plane.system = 7 if field.now_s >= begin_s + 7.0 else 1
        for message in plane.turn(turn):
            field.events += field.session.take(field.now_s, speakers[plane.system].encode(*message))
        for name, fields in field.sent:
            asked.add((plane.system, fields.get("target_system", plane.system)))
            for received in speakers[plane.system].decode(monitor.encode(name, fields)):
                for answer in plane.receive(received, now_us):
                    field.events += field.session.take(field.now_s, speakers[plane.system].encode(*answer))
        field.sent.clear()
        if turn % STEPPED == 0:
            field.events += field.session.step(field.now_s)
    events = field.end()
    assert {surface for surface, _ in kinds(events, "alarm")} == {"elevator"}
    assert kinds(events, "alarm")[0][1] == pytest.approx(15.5, abs=1.0)
    assert kinds(events, "link_lost") == []
    assert (7, 7) in asked
    assert list(field.session.vehicles) == [1]
    assert [note for note in field.session.notes if note.startswith("vehicle")] == [
        "vehicle 1 speaks as vehicle 7 now: it is watched on"
    ]


@pytest.mark.slow
def test_another_aircraft_on_the_port_is_named_and_not_watched(aircraft: Aircraft) -> None:
    field = Field.of({0: aircraft})
    field.fly(vehicle(lively(duration_s=14.0)), vehicle(lively(duration_s=14.0, stuck_s=9.0, seed=5), system=2))
    assert kinds(field.end(), "alarm") == []
    assert list(field.session.vehicles) == [1]
    assert [note for note in field.session.notes if note.startswith("vehicle 2")] == [
        "vehicle 2 is not watched: -c 2=FILE would"
    ]


@pytest.mark.parametrize(
    ("files", "sent", "expected"),
    [
        ((("elevator", "rudder"), ("aileron",)), {7: (2, 4), 3: (1,)}, {7: 0, 3: -1}),
        ((("aileron",), ("elevator", "aileron")), {3: (1, 2), 7: (1,)}, {3: -1, 7: 0}),
        ((("elevator",), ("elevator", "rudder")), {3: (1,), 9: (2, 4)}, {9: -1}),
        ((("elevator",), ("elevator",)), {7: (2,)}, {}),
        ((("elevator",), ("elevator",)), {7: (2,), 3: (2,), 9: (2,)}, {3: 0, 7: -1}),
    ],
)
def test_of_files_without_a_number_each_vehicle_has_that_of_its_positions(
    files: tuple[tuple[str, ...], ...], sent: dict[int, tuple[int, ...]], expected: dict[int, int], tmp_path: Path
) -> None:
    """Where two would do, they go by the numbers of the vehicles; whoever is left over is named once."""
    aircraft = {}
    for place, names in enumerate(files):
        path = tmp_path / f"{place}.toml"
        path.write_text(plane_file(names))
        aircraft[-place] = load_aircraft(path)
    session, notes = Session(Codec(0, 191), aircraft), []
    for now_s in (1.0, 1.5, 2.0, 2.5, 3.0, 3.5):
        for system, numbers in sent.items():
            codec = Codec(system, 1)
            beat = codec.encode("HEARTBEAT", {"type": 1, "autopilot": 3, "mavlink_version": 3})
            session.take(now_s, beat)
            for number in numbers:
                value = {"time_boot_ms": int(1e3 * now_s), "name": f"SRVP{number}", "value": 1.0}
                session.take(now_s, codec.encode("NAMED_VALUE_FLOAT", value))
        session.step(now_s)
        notes += session.notes
        session.notes.clear()
    assert {system: vehicle.aircraft for system, vehicle in session.vehicles.items()} == {
        system: aircraft[number] for system, number in expected.items()
    }
    left = [note for note in notes if "is not watched" in note]
    assert len(left) == (len(expected) == len(files)) * (len(sent) - len(files))
    assert ("waits for its vehicle" in session.waiting()) == (0 < len(expected) < len(files))


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["plane.toml", "plane.toml"], "given twice"),
        (["plane.toml", "copy.toml"], "given twice"),
        (["1=plane.toml", "1=copy.toml"], "vehicle 1 has two files"),
        (["300=plane.toml"], "no system id"),
    ],
)
def test_files_that_cannot_be_told_apart_are_refused_in_one_line(
    words: list[str], why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("plane.toml", "copy.toml"):
        (tmp_path / name).write_text(plane_file())
    assert main(["monitor", "udpin:127.0.0.1:0", *(each for word in words for each in ("-c", word))]) == 2
    error = capsys.readouterr().err
    assert why in error
    assert error.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("gone", ["", "NAMED_VALUE_FLOAT", "SERVO_OUTPUT_RAW"])
def test_healthy_is_only_what_was_judged_to_the_end(
    tmp_path: Path, gone: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a replayed log whose commands, or positions, stop at 20 s of 30."""
    import struct

    plane, codec = vehicle(lively(duration_s=30.0), message_hz=40.0), Codec(1, 1)
    log, config = tmp_path / "flight.tlog", tmp_path / "plane.toml"
    config.write_text(plane_file())
    with log.open("wb") as out:
        for turn in range(plane.time_us.size):
            for message in plane.turn(turn):
                if message.name != gone or turn < 1000:
                    stamp = 1_700_000_000_000_000 + int(plane.time_us[turn])
                    out.write(struct.pack(">Q", stamp) + codec.encode(*message))
    code = main(["monitor", str(log), "-c", str(config), "--speed", "0", "--plain"])
    error = capsys.readouterr().err
    assert code == (2 if gone else 0)
    assert error.count("\n") == bool(gone)
    if gone:
        assert f"no {'position' if gone.startswith('NAMED') else 'command'} since" in error


def test_nobody_is_judged_of_no_vehicle(aircraft: Aircraft) -> None:
    assert Session(Codec(0, 191), {0: aircraft}).unjudged() == "waiting for the first byte"
