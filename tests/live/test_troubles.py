"""Vehicle and monitor through links that fail, message by message and without sockets: nothing is left to chance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from logparsers.codec import Codec, Signature
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.live.session import Session
from servofd.servo.faults import Stuck
from tests.detection.test_lost_commands import KNOWN
from tests.live.relay import BadLink
from tests.live.vehicles import flown, plane_file, said, vehicle

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from servofd.detection.event import Event
    from servofd.simulation.flight import SimulatedFlight
    from servofd.simulation.vehicle.vehicle import Vehicle

EPOCH_S = 1.7e9
STEPPED = 5
"""Turns, at 50 Hz, to a step of the monitor: as in a replay, which takes steps of 0.1 s."""
QUIET = {"link_lost", "link_restored", "no_data"}


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    path: Path = tmp_path_factory.mktemp("plane") / "plane.toml"
    path.write_text(plane_file())
    return load_aircraft(path)


def lively(*, stuck_s: float | None = None, **options: Any) -> SimulatedFlight:
    faults = {} if stuck_s is None else {"elevator": Stuck(stuck_s)}
    return flown(command="lively", faults=faults, **({"duration_s": 30.0} | options))


@dataclass
class Field:
    """A monitor and the air between it and vehicles; time is that of the receiver [s]."""

    session: Session
    down: BadLink = field(default_factory=BadLink)
    up: BadLink = field(default_factory=BadLink)
    codec: Codec = field(default_factory=lambda: Codec(1, 1))
    sent: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    signature: Signature | None = None
    now_s: float = EPOCH_S

    @staticmethod
    def of(
        aircraft: dict[int, Aircraft],
        *,
        remote_log: bool = False,
        store: Callable[[bytes], None] = lambda _: None,
        **options: Any,
    ) -> Field:
        sent: list[tuple[str, dict[str, Any]]] = []

        def say(_: int, name: str, fields: dict[str, Any]) -> None:
            sent.append((name, fields))

        codec = Codec(250, 1, signature=options.get("signature"))
        session = Session(codec, aircraft, store=store, send=say, alert=say, remote_log=remote_log)
        return Field(session, sent=sent, **options)

    def fly(self, *planes: Vehicle) -> None:
        """All of them, turn by turn; the monitor's answers arrive at the next."""
        speakers = {plane.system: self.codec if plane.system == 1 else Codec(plane.system, 1) for plane in planes}
        begin_s, monitor = self.now_s, Codec(1, 191, signature=self.signature)
        for turn in range(planes[0].time_us.size):
            for plane in planes:
                now_us = int(plane.time_us[turn])
                self.now_s = begin_s + 1e-6 * (now_us - int(plane.time_us[0]))
                frames = [speakers[plane.system].encode(*message) for message in plane.turn(turn)]
                self._down(frames)
                for name, fields in [m for m in self.sent if m[1].get("target_system", 0) == plane.system]:
                    for datagram in self.up.through(monitor.encode(name, fields)):
                        for heard in speakers[plane.system].decode(datagram):
                            self._down([speakers[plane.system].encode(*m) for m in plane.receive(heard, now_us)])
            self.sent.clear()
            if turn % STEPPED == 0:
                self.events += self.session.step(self.now_s)

    def wait(self, duration_s: float) -> None:
        """Nothing comes."""
        for now_s in np.arange(self.now_s, self.now_s + duration_s, 0.1):
            self.events += self.session.step(float(now_s))
        self.now_s += duration_s

    def _down(self, frames: list[bytes]) -> None:
        for frame in frames:
            for datagram in self.down.through(frame):
                self.events += self.session.take(self.now_s, datagram)

    def end(self) -> list[Event]:
        self.events += self.session.finish(self.now_s)
        return self.events


def kinds(events: Sequence[Event], kind: str) -> list[tuple[str, float]]:
    return [(event.surface, event.time_s) for event in events if event.event == kind]


TROUBLES: dict[str, dict[str, Any]] = {
    "none": {},
    "5 % lost": {"loss": 0.05},
    "30 % lost": {"loss": 0.3},
    "duplicates": {"duplicate": 0.3},
    "reordered": {"reorder": 0.2},
    "damaged": {"corrupt": 0.05},
    "everything": {"loss": 0.1, "duplicate": 0.1, "reorder": 0.1, "corrupt": 0.1},
    "2 s away": {"outages_s": ((8.0, 10.0),)},
}


def some(*often: str) -> list[Any]:
    """All troubles, of which these are met in every run."""
    return [pytest.param(each, marks=[] if each in often else pytest.mark.nightly) for each in TROUBLES]


@pytest.mark.slow
@pytest.mark.parametrize("trouble", some("everything"))
def test_a_fault_is_found_and_nothing_else_through_a_bad_link(aircraft: Aircraft, trouble: str) -> None:
    field = Field.of({0: aircraft}, down=BadLink(**TROUBLES[trouble], seed=1), up=BadLink(seed=2))
    field.fly(vehicle(lively(duration_s=20.0, stuck_s=15.0)))
    events = field.end()
    assert {surface for surface, _ in kinds(events, "alarm")} == {"elevator"}
    assert kinds(events, "alarm")[0][1] == pytest.approx(15.5, abs=1.0)
    assert "stuck" in [event.kind for event in events if event.event == "named"]


@pytest.mark.slow
@pytest.mark.parametrize("trouble", some("everything"))
def test_a_healthy_flight_stays_quiet_through_a_bad_link(aircraft: Aircraft, trouble: str) -> None:
    field = Field.of({0: aircraft}, down=BadLink(**TROUBLES[trouble], seed=3), up=BadLink(seed=4))
    field.fly(vehicle(flown(duration_s=20.0)))
    assert {event.event for event in field.end()} <= QUIET


@pytest.mark.slow
def test_silence_is_a_lost_link_and_no_servo(aircraft: Aircraft) -> None:
    field = Field.of({0: aircraft}, down=BadLink(outages_s=((8.0, 14.0),)))
    field.fly(vehicle(lively(duration_s=20.0, stuck_s=16.0)))
    events = field.end()
    (lost,), (restored,) = kinds(events, "link_lost"), kinds(events, "link_restored")
    assert lost[1] == pytest.approx(8.0, abs=2.5)
    assert restored[1] >= lost[1]
    assert [surface for surface, _ in kinds(events, "alarm")] == ["elevator"]
    assert kinds(events, "alarm")[0][1] > 16.0


@pytest.mark.slow
def test_a_vehicle_that_starts_again_is_watched_again(aircraft: Aircraft) -> None:
    """Clock back to zero, rates back to the usual ones: the monitor asks again, and tells times of the new boot."""
    field = Field.of({0: aircraft})
    field.fly(vehicle(lively(duration_s=8.0)))
    field.wait(5.0)
    field.fly(vehicle(lively(duration_s=15.0, stuck_s=10.0, seed=4)))
    events = field.end()
    assert [e.text for e in events if e.event == "no_data"] == ["vehicle 1 has restarted; the monitor begins anew"]
    assert [surface for surface, _ in kinds(events, "alarm")] == ["elevator"]
    assert kinds(events, "alarm")[0][1] == pytest.approx(10.2, abs=1.0)
    rate_hz = next(monitor.rate_hz for _, monitor in field.session.watched if monitor.name == "elevator")
    assert rate_hz == pytest.approx(40.0, abs=4.0)


@pytest.mark.nightly
def test_the_wrap_of_the_clock_is_no_event(aircraft: Aircraft) -> None:
    flight = lively(stuck_s=15.0)
    field = Field.of({0: aircraft})
    field.fly(vehicle(replace(flight, time_s=np.round(flight.time_s + 4285.0, 6))))
    events = field.end()
    assert {event.event for event in events} <= {"alarm", "named"}
    assert kinds(events, "alarm")[0][1] == pytest.approx(4285.0 + 15.5, abs=1.0)


@pytest.mark.slow
def test_two_vehicles_with_the_same_messages_are_kept_apart(aircraft: Aircraft) -> None:
    field = Field.of({1: aircraft, 2: aircraft})
    field.fly(
        vehicle(lively(duration_s=14.0), system=1), vehicle(lively(duration_s=14.0, stuck_s=9.0, seed=5), system=2)
    )
    field.end()
    found = {
        (vehicle.system, monitor.name): [fault.kind for fault in monitor.faults]
        for vehicle, monitor in field.session.watched
    }
    assert {which for which, kinds in found.items() if kinds} == {(2, "elevator")}


@pytest.mark.slow
def test_unsigned_frames_are_not_believed_when_there_is_a_key(aircraft: Aircraft) -> None:
    key = Signature(bytes(range(32)), 1.8e9)
    field = Field.of({0: aircraft}, signature=key)
    field.fly(vehicle(lively(duration_s=5.0)))
    assert not field.session.vehicles
    field.codec = Codec(1, 1, signature=key)
    field.fly(vehicle(lively(duration_s=14.0, stuck_s=9.0)))
    assert {surface for surface, _ in kinds(field.end(), "alarm")} == {"elevator"}


@pytest.mark.slow
def test_what_another_station_slows_down_is_asked_for_again(aircraft: Aircraft) -> None:
    field = Field.of({0: aircraft})
    plane = vehicle(flown(duration_s=45.0))
    turn = plane.turn

    def slowed(index: int) -> Any:
        if index == 500:  # 10 s; MAVProxy does so every few seconds unless it is told not to
            plane.receive(said("REQUEST_DATA_STREAM", req_stream_id=0, req_message_rate=4, start_stop=1), 0)
        return turn(index)

    plane.turn = slowed  # type: ignore[method-assign]
    notes = field.session.notes
    field.fly(plane)
    slow = [note for note in notes if "asks again" in note]
    assert len(slow) == 1, notes
    assert slow[0].startswith("SERVO_OUTPUT_RAW comes at ")
    assert notes.count("SERVO_OUTPUT_RAW at 40 Hz granted") == 2
    assert {event.event for event in field.end()} <= QUIET


@pytest.mark.slow
@pytest.mark.parametrize(("rate_hz", "is_slow"), [(25.0, False), (12.0, True)])
def test_what_comes_too_slowly_for_the_servo_is_told(aircraft: Aircraft, rate_hz: float, is_slow: bool) -> None:
    field = Field.of({0: aircraft})
    field.session.send = None
    field.fly(vehicle(flown(duration_s=15.0), message_hz=rate_hz))
    told = [
        note for note in field.session.notes if "slow for a servo whose bandwidth is 4.5 Hz: 18 Hz would do" in note
    ]
    assert len(told) == (3 if is_slow else 0), field.session.notes


@pytest.mark.slow
def test_a_link_that_is_too_poor_is_told_to_the_ground_while_its_surfaces_are_watched(aircraft: Aircraft) -> None:
    known = KNOWN.model_copy(update={"reach_deg": (-5.0, 5.0)})
    surfaces = {
        name: surface.model_copy(update={"calibrated": known, "threshold": "interval"})
        for name, surface in aircraft.surfaces.items()
    }
    told: list[str] = []
    field = Field.of({0: aircraft.model_copy(update={"surfaces": surfaces})}, down=BadLink(loss=0.75, seed=1))
    field.session.alert = lambda _, name, fields: told.append(fields["text"]) if name == "STATUSTEXT" else None
    field.fly(vehicle(flown(command="lively", duration_s=45.0)))
    poor = [event for event in field.end() if event.event == "no_data"]
    assert {event.text.partition(":")[0] for event in poor} == {"the link is too poor"}
    assert any(": the link is too poor" in text for text in told)
