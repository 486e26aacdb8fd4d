"""The monitor on MAVLink streams: as an audit of the same bytes, over bad links, and on real sockets."""

from __future__ import annotations

import io
import json
import re
import socket
import struct
import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import logparsers
import servofd
from logparsers.codec import Codec, Signature, signing_key
from logparsers.replay import replayed
from servofd.aircraft.schema import load_aircraft, plain_aircraft
from servofd.cli import main
from servofd.detection.audit import audit_log
from servofd.detection.event import Look
from servofd.detection.monitor import SurfaceMonitor
from servofd.feedback.draft import draft_to_toml
from servofd.live.run import Pace, replay_log, replay_telemetry
from servofd.live.session import Session, stamped
from servofd.live.threads import ALLOWED
from servofd.servo.faults import Bias, Stuck
from servofd.simulation.telemetry_writer import telemetry_log
from tests.live.relay import BadLink, relayed
from tests.live.vehicles import DEADLINE_S, PLANE, flown, flying, free_port, plane_file, until

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from servofd.aircraft.schema import Aircraft
    from servofd.detection.event import Event
    from servofd.detection.stream import Piece

SECONDS = 40.0
KINDS = ("alarm", "named", "clear")
FAULTS = {"elevator": Stuck(10.0), "rudder": Bias(18.0, bias_deg=3.0)}


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("plane") / "plane.toml"
    healthy = logparsers.read(io.BytesIO(telemetry_log(flown(rate_hz=40.0, duration_s=SECONDS), PLANE)))
    drafted = draft_to_toml(healthy)
    # Less is said of a servo that was fitted to the log than of one that was chosen.
    path.write_text(re.sub(r"^model = .*\n", "", drafted, flags=re.MULTILINE))
    return path


@pytest.fixture(scope="module")
def aircraft(config: Path) -> Aircraft:
    return load_aircraft(config)


@pytest.fixture(scope="module")
def log() -> bytes:
    """Telemetry of a flight in which two servos break."""
    return telemetry_log(flown(rate_hz=40.0, duration_s=26.0, faults=FAULTS), PLANE)


@pytest.fixture(scope="module")
def healthy() -> bytes:
    return telemetry_log(flown(rate_hz=40.0, duration_s=SECONDS), PLANE)


def heard(
    frames: Iterable[tuple[float, bytes]], aircraft: Aircraft, codec: Codec | None = None, *, aside: bool = False
) -> tuple[Session, list[Event]]:
    """Feed a session frame by frame."""
    session, events = Session(codec or Codec(0, 191), {0: aircraft}, aside=aside), []
    stepped_s, now_s = 0.0, 0.0
    for now_s, frame in frames:
        events += session.take(now_s, frame)
        if now_s - stepped_s > 0.1:
            stepped_s = now_s
            events += session.step(now_s)
    return session, events + session.finish(now_s)


def of_a_late_bank(log: bytes, aircraft: Aircraft) -> list[Event]:
    """Events where the bank answers at the end of the flight alone."""
    looked, ended = SurfaceMonitor.look, threading.Event()

    def frames() -> Iterator[tuple[float, bytes]]:
        yield from replayed(log)
        ended.set()

    def look(monitor: SurfaceMonitor, until_s: float = np.inf) -> Look | None:
        found = looked(monitor, until_s)
        if found is None:
            return None
        find = found.find
        return found._replace(find=lambda: (ended.wait(DEADLINE_S), find())[1])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SurfaceMonitor, "look", look)
        return heard(frames(), aircraft, aside=True)[1]


def brief(events: list[Event], *kinds: str) -> list[tuple[str, str, str]]:
    return [(event.surface, event.event, event.kind) for event in events if event.event in (kinds or KINDS)]


def raised(session: Session) -> dict[str, list[tuple[str, float]]]:
    """By surface, the last names of its alarms and when they were raised."""
    alarms = [alarm for vehicle in session.vehicles.values() for alarm in vehicle.alarms.all]
    return {m.name: [(a.kind, a.raised_s) for a in alarms if a.surface == m.name] for _, m in session.watched}


def audited(log: bytes, aircraft: Aircraft) -> dict[str, list[tuple[str, float]]]:
    result = audit_log(logparsers.read(io.BytesIO(log)), aircraft)
    return {s.surface: [(fault.kind, fault.alarm_s) for fault in s.faults] for s in result.surfaces}


class TestAsAnAudit:
    @pytest.mark.slow
    def test_of_the_same_bytes(self, log: bytes, aircraft: Aircraft) -> None:
        session, events = heard(replayed(log), aircraft)
        found = raised(session)
        assert found == audited(log, aircraft)
        assert {name for name, faults in found.items() if faults} == {"elevator", "rudder"}
        assert {event.surface: event.time_s for event in events if event.event == "alarm"} == {
            name: faults[0][1] for name, faults in found.items() if faults
        }

    @pytest.mark.slow
    def test_of_a_servo_that_the_air_bends(self, healthy: bytes, tmp_path: Path) -> None:
        """The residuals of an audit but for the airspeed between two messages, which a monitor can only hold."""
        path = tmp_path / "bent.toml"
        path.write_text(plane_file(["rudder"]) + "[surfaces.rudder.effects]\nairload = { deg_per_deg_pa = 2e-3 }\n")
        bent = load_aircraft(path)
        session = Session(Codec(0, 191), {0: bent})
        pieces: list[tuple[Any, Any]] = []

        def listen(surface: str, piece: Piece, _: Any) -> None:
            if surface == "rudder":
                pieces.append((piece.residuals.time_s, piece.residuals.residual_deg))

        session.listener = listen
        for number, (now_s, frame) in enumerate(replayed(healthy)):
            session.take(now_s, frame)
            if number % 20 == 0:
                session.step(now_s)
        session.finish(now_s)
        time_s, residual_deg = (np.concatenate(column) for column in zip(*pieces, strict=True))
        log = logparsers.read(io.BytesIO(healthy))
        (verdict,) = (s for s in audit_log(log, bent).surfaces if s.surface == "rudder")
        assert verdict.residuals is not None
        expected_deg = np.interp(time_s, verdict.residuals.time_s, verdict.residuals.residual_deg)
        assert np.nanmax(np.abs(expected_deg)) > 1.0, "the load has to matter"
        assert np.nanmax(np.abs(residual_deg - expected_deg)) < 0.1

    @pytest.mark.slow
    def test_what_it_stores_is_the_log(self, log: bytes, aircraft: Aircraft) -> None:
        stored = bytearray()
        session = Session(Codec(0, 191), {0: aircraft}, store=stored.extend)
        for now_s, frame in replayed(log):
            session.take(now_s, frame)
        assert bytes(stored) == log

    @pytest.mark.slow
    def test_over_the_overflow_of_the_microseconds(self, log: bytes, aircraft: Aircraft) -> None:
        """The same flight, 71.5 minutes after boot."""
        late = b"".join(stamped(at_s, later(frame, 4_290.0)) for at_s, frame in replayed(log))
        session, _ = heard(replayed(late), aircraft)
        found = raised(session)
        assert found == audited(late, aircraft)
        assert found["elevator"][0][1] > 4_300.0


def later(frame: bytes, by_s: float) -> bytes:
    """The same message of a vehicle that was booted so much earlier."""
    codec = Codec(1, 1)
    (message,) = codec.decode(frame)
    fields = dict(message.fields)
    for name, tick_s in (("time_boot_ms", 1e-3), ("time_usec", 1e-6)):
        if name in fields:
            fields[name] = (fields[name] + round(by_s / tick_s)) % 2**32
    again = Codec(message.system, message.component)
    again._mav.seq = message.sequence
    return again.encode(message.name, fields)


class TestBadLinks:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("link", "most_lost"),
        [
            pytest.param(BadLink(loss=0.05, seed=1), 0.1, marks=pytest.mark.nightly),
            pytest.param(BadLink(loss=0.3, seed=2), 0.4, marks=pytest.mark.nightly),
            pytest.param(BadLink(duplicate=0.2, reorder=0.1, seed=3), 0.05, marks=pytest.mark.nightly),
            pytest.param(BadLink(corrupt=0.05, seed=4), 0.1, marks=pytest.mark.nightly),
        ],
        ids=["5 %", "30 %", "order", "corrupt"],
    )
    def test_a_healthy_flight_raises_no_alarm(
        self, healthy: bytes, aircraft: Aircraft, link: BadLink, most_lost: float
    ) -> None:
        frames = ((at_s, piece) for at_s, frame in replayed(healthy) for piece in link.through(frame))
        session, events = heard(frames, aircraft)
        assert brief(events, "alarm", "link_lost") == []
        assert all(monitor.was_judged for _, monitor in session.watched)
        (vehicle,) = session.vehicles.values()
        assert vehicle.losses[1].lost < most_lost * (vehicle.losses[1].received + vehicle.losses[1].lost)

    @pytest.mark.nightly
    def test_a_jam_is_told_through_five_percent_loss(self, log: bytes, aircraft: Aircraft) -> None:
        link = BadLink(loss=0.05, seed=5)
        frames = [(at_s, piece) for at_s, frame in replayed(log) for piece in link.through(frame)]
        session, events = heard(frames, aircraft)
        assert {surface for surface, _, _ in brief(events, "alarm")} == {"elevator", "rudder"}
        stored = b"".join(stamped(at_s, frame) for at_s, frame in frames)
        found = raised(session)
        assert found == audited(stored, aircraft)

    @pytest.mark.slow
    @pytest.mark.nightly
    @pytest.mark.parametrize("outage_s", [1.0, 4.0, 20.0])
    def test_silence_is_a_lost_link_and_no_fault(self, healthy: bytes, aircraft: Aircraft, outage_s: float) -> None:
        all_frames = list(replayed(healthy))
        begin_s = all_frames[0][0] + 15.0
        frames = [(at_s, frame) for at_s, frame in all_frames if not begin_s < at_s < begin_s + outage_s]
        session, events = heard(frames, aircraft)
        expected = ["link_lost", "link_restored"] if outage_s > 2.0 else []
        assert [event.event for event in events if event.event in ("alarm", "link_lost", "link_restored")] == expected
        assert all(monitor.is_watched for _, monitor in session.watched)

    @pytest.mark.nightly
    def test_a_vehicle_that_restarts_is_watched_anew(self, healthy: bytes, aircraft: Aircraft) -> None:
        whole = list(replayed(healthy))
        first = [(at_s, frame) for at_s, frame in whole if at_s < whole[0][0] + 15.0]
        gap_s = first[-1][0] - first[0][0] + 1.0
        session, events = heard([*first, *((at_s + gap_s, frame) for at_s, frame in first)], aircraft)
        assert [event.text for event in events if event.text.startswith("vehicle")] == [
            "vehicle 1 has restarted; the monitor begins anew"
        ]
        assert brief(events, "alarm") == []
        (vehicle,) = session.vehicles.values()
        assert vehicle.now_s == pytest.approx(gap_s - 1.0, abs=1.0), "seconds of its second boot"
        assert vehicle.began_s == [0.0, pytest.approx(gap_s - 1.0, abs=1.0)]

    @pytest.mark.slow
    def test_with_a_key_unsigned_frames_say_nothing(self, healthy: bytes, aircraft: Aircraft) -> None:
        session, events = heard(replayed(healthy), aircraft, Codec(0, 191, signature=Signature(bytes(32), 1.7e9)))
        assert (session.frames, events) == (0, [])
        assert session.waiting().startswith("nothing that it hears is signed")


class Listener:
    """Hears all that is sent to a port."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.1)
        self.port = self._socket.getsockname()[1]
        self._codec = Codec(255, 190)
        self.messages: list[Any] = []

    def close(self) -> None:
        self._socket.close()

    def listen(self) -> list[Any]:
        try:
            while True:
                self.messages += self._codec.decode(self._socket.recv(65_536))
        except TimeoutError:
            return self.messages


def in_background(arguments: list[str]) -> tuple[threading.Thread, list[int]]:
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(main(arguments)))
    thread.start()
    return thread, codes


def test_no_alarm_over_a_threshold_waits_for_the_bank(aircraft: Aircraft) -> None:
    log = telemetry_log(flown(duration_s=11.0, faults={"elevator": Stuck(6.0)}), PLANE)
    early, late = heard(replayed(log), aircraft)[1], of_a_late_bank(log, aircraft)
    assert brief(early) == brief(late) == [("elevator", "alarm", "unknown"), ("elevator", "named", "stuck")]
    assert early[0].time_s < late[0].time_s < early[0].time_s + 1.0
    assert abs(early[0].residual_deg) < early[0].threshold_deg
    assert abs(late[0].residual_deg) > late[0].threshold_deg


class TestOnSockets:
    @pytest.mark.slow
    def test_alarm_names_alerts_files_and_exit_code(self, config: Path, tmp_path: Path) -> None:
        """In real time: the arrival times in the log that it writes have to be believable."""
        port, listener = free_port(), Listener()
        lines, tlog, rrd = (tmp_path / name for name in ("events.jsonl", "own.tlog", "own.rrd"))
        flight = flown(duration_s=11.0, faults={"elevator": Stuck(6.0)})
        outputs = ["--json-lines", str(lines), "--tlog", str(tlog), "--rrd", str(rrd)]
        target = ["--alert-to", f"udpout:127.0.0.1:{listener.port}"]
        arguments = ["monitor", f"udpin:127.0.0.1:{port}", "-c", str(config), "--plain", "--duration", "13"]
        up = BadLink()
        with relayed(port, BadLink(), up) as relay:
            thread, codes = in_background([*arguments, *outputs, *target])
            with flying(f"udpout:127.0.0.1:{relay}", flight, wait=False, message_hz=40.0) as counted:
                until(lambda: listener.listen() is not None and counted, "the end of the flight")
            thread.join(DEADLINE_S)
        assert codes == [1]
        listener.listen()
        listener.close()
        events = [json.loads(line) for line in lines.read_text().splitlines()]
        assert {event["schema"] for event in events} == {"servofd.event/1"}
        alarm = next(event for event in events if event["event"] == "alarm")
        assert alarm["surface"] == "elevator"
        (result,) = servofd.audit(str(tlog), load_aircraft(config))
        (verdict,) = (s for s in result.surfaces if s.surface == "elevator")
        assert verdict.faults[0].kind == "stuck"
        if abs(alarm["residual_deg"]) > alarm["threshold_deg"]:  # sooner than a busy machine had made its look
            late = of_a_late_bank(tlog.read_bytes(), load_aircraft(config))
            assert alarm["time_s"] == next(event.time_s for event in late if event.event == "alarm")
        else:
            assert alarm["time_s"] == verdict.faults[0].alarm_s
        assert [e["kind"] for e in events if e["event"] in ("alarm", "named")][-1] == "stuck"
        texts = [m.fields["text"] for m in listener.messages if m.name == "STATUSTEXT"]
        assert any(text.startswith("ELEVATOR stuck ") for text in texts)
        assert all(len(text) <= 50 for text in texts)
        said = {m.name for m in listener.messages} | {m.name for m in Codec(1, 1).decode(bytes(up.record))}
        assert said <= ALLOWED
        assert {m.component for m in listener.messages} == {191}
        commands = [m for m in Codec(1, 1).decode(bytes(up.record)) if m.name == "COMMAND_LONG"]
        assert {m.fields["command"] for m in commands} == {511}
        assert rrd.stat().st_size > 10_000

    @pytest.mark.parametrize(
        ("endpoint", "words"),
        [
            ("./plane.elf", "not a MAVLink endpoint"),
            ("mcast:", "not a MAVLink endpoint"),
            ("udpin:127.0.0.1:70000", "is no port"),
            ("tcp:127.0.0.1:1", "start the other end first"),
            ("/dev/ttyNoSuch", "is it plugged in?"),
        ],
    )
    def test_bad_endpoints(self, config: Path, endpoint: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["monitor", endpoint, "-c", str(config)]) == 2
        error = capsys.readouterr().err
        assert words in error
        assert error.count("\n") == 1

    def test_an_empty_key_signs_nothing(self, config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        key = tmp_path / "empty.key"
        key.write_bytes(b" \n")
        arguments = ["monitor", f"udpin:{free_port()}", "-c", str(config), "--plain", "--duration", "0.2"]
        assert main([*arguments, "--signing-key", str(key)]) == 2
        assert "holds no key" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("option", "value"), [("--component", "256"), ("--system", "0"), ("--viewer-port", "70000")]
    )
    def test_numbers_out_of_range(
        self, config: Path, option: str, value: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with pytest.raises(SystemExit, match="2"):
            main(["monitor", f"udpin:{free_port()}", "-c", str(config), option, value])
        assert f"argument {option}: must be" in capsys.readouterr().err

    @pytest.mark.slow
    def test_nobody_there(self, config: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["monitor", f"udpin:{free_port()}", "-c", str(config), "--duration", "0.2", "--plain"]) == 2
        assert "waiting for the first byte" in capsys.readouterr().err


@pytest.mark.slow
def test_replay_writes_json_lines(log: bytes, config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(log)
    assert main(["monitor", str(path), "-c", str(config), "--speed", "0", "--json-lines", "-"]) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    kinds = {(event["surface"], event["event"], event["kind"]) for event in events}
    assert ("elevator", "named", "stuck") in kinds
    assert ("rudder", "named", "bias") in kinds
    assert np.isfinite([event["time_s"] for event in events]).all()


@dataclass
class Counting:
    """Takes what a replay tells, and counts its steps."""

    told: list[Event] = field(default_factory=list)
    steps: int = 0

    def events(self, events: list[Event]) -> None:
        self.told += events

    def tick(self, now_s: float) -> None:  # noqa: ARG002 - of a watcher
        self.steps += 1


@pytest.mark.slow
def test_a_replay_evaluates_at_once_what_no_look_divides(log: bytes, aircraft: Aircraft, tmp_path: Path) -> None:
    """Steps of a tenth of a second tell the same, in three times as many."""
    path, counting, session = tmp_path / "flight.tlog", Counting(), Session(Codec(0, 191), {0: aircraft})
    path.write_bytes(log)
    now_s = replay_telemetry(session, path, counting, Pace(0.0), np.inf)
    _, slowly = heard(replayed(log), aircraft)
    kinds = ("alarm", "named", "clear")
    assert brief(counting.told + session.finish(now_s), *kinds) == brief(slowly, *kinds)
    assert counting.steps < 30


@dataclass
class Interrupting(Counting):
    """Is interrupted after a few steps."""

    def tick(self, now_s: float) -> None:
        super().tick(now_s)
        if self.steps == 5:
            raise KeyboardInterrupt


def test_a_replay_that_is_interrupted_ends_where_it_is(log: bytes, aircraft: Aircraft, tmp_path: Path) -> None:
    path, watcher, session = tmp_path / "flight.tlog", Interrupting(), Session(Codec(0, 191), {0: aircraft})
    path.write_bytes(log)
    now_s = replay_telemetry(session, path, watcher, Pace(0.0), np.inf)
    (vehicle,) = session.vehicles.values()
    assert (watcher.steps, now_s) == (5, vehicle.received_s)
    table, plain = logparsers.read("sample_logs/table_three_faults.csv"), plain_aircraft(["rudder"], "hs225bb-eq31")
    session, watcher = Session(Codec(0, 191), {0: plain}, is_stream=False), Interrupting()
    now_s = replay_log(session, table, watcher, Pace(0.0), np.inf)
    (vehicle,) = session.vehicles.values()
    assert (watcher.steps, now_s) == (5, vehicle.received_s)
    assert now_s < table.ends_s[1] - 1.0


@pytest.fixture(scope="module")
def signed(log: bytes) -> bytes:
    """The same telemetry, signed."""
    plane, reader = Codec(1, 1, signature=Signature(signing_key(b"ours"), 1.6e9)), Codec(0, 1)
    frames = [(at_s, reader.decode(frame)[0]) for at_s, frame in replayed(log)]
    return b"".join(stamped(at_s, plane.encode(m.name, m.fields)) for at_s, m in frames)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "code", "line"),
    [
        ("ours", 1, "signatures are those of the key: what carries no such one is not believed"),
        ("theirs", 2, "no frame is signed with this key: they carry another's signature"),
        (None, 1, "frames are signed, and taken unchecked: --signing-key FILE would check them"),
    ],
    ids=["right key", "wrong key", "no key"],
)
def test_replay_of_a_signed_log_checks_signatures_and_says_so_in_one_line(
    signed: bytes,
    config: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    key: str | None,
    code: int,
    line: str,
) -> None:
    """However long ago it was signed."""
    (tmp_path / "signed.tlog").write_bytes(signed)
    arguments = ["monitor", str(tmp_path / "signed.tlog"), "-c", str(config), "--speed", "0", "--plain"]
    if key:
        (tmp_path / "key").write_text(key)
        arguments += ["--signing-key", str(tmp_path / "key")]
    assert main(arguments) == code
    told = capsys.readouterr()
    assert (told.err if code == 2 else told.out).count(line) == 1
    assert told.err.count("\n") == (code == 2)


@pytest.mark.slow
def test_replay_of_a_signed_log_believes_no_forged_frame_between_its_own(healthy: bytes, aircraft: Aircraft) -> None:
    """Each tenth of the positions is another's: with the key they are as if they had not been sent."""
    ours, theirs = (Signature(signing_key(name), 1.6e9) for name in (b"ours", b"theirs"))
    plane, forger, reader = Codec(1, 1, signature=ours), Codec(1, 1, signature=theirs), Codec(0, 1)
    frames = []
    for number, (at_s, frame) in enumerate(list(replayed(healthy))[:4000]):
        (m,) = reader.decode(frame)
        frames.append((at_s, plane.encode(m.name, m.fields)))
        if m.name == "NAMED_VALUE_FLOAT" and number % 10 == 0:
            frames.append((at_s, forger.encode(m.name, dict(m.fields) | {"value": 40.0})))
    session, events = heard(frames, aircraft, Codec(0, 191, signature=ours.of_any_time()))
    assert session.signed == (4000, len(frames) - 4000)
    assert session.signed[1] > 100
    alone, _ = heard([f for f in frames if reader.decode(f[1])[0].fields.get("value") != 40.0], aircraft)
    assert brief(events, "alarm") == []
    assert [m.reading for _, m in session.watched] == [m.reading for _, m in alone.watched]


@pytest.mark.slow
def test_review_and_audit_of_what_was_recorded_agree_with_what_was_told_live(
    log: bytes, config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same surfaces, names and times."""
    flight, kept, recording = (tmp_path / name for name in ("flight.tlog", "kept.tlog", "kept.rrd"))
    flight.write_bytes(log)
    told: list[str] = ["monitor", str(flight), "-c", str(config), "--speed", "0", "--json-lines", "-"]
    assert main([*told, "--tlog", str(kept), "--rrd", str(recording)]) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    names = {e["surface"]: e["kind"] for e in events if e["event"] == "named"}
    live = [(e["surface"], names[e["surface"]], e["time_s"]) for e in events if e["event"] == "alarm"]
    assert [(surface, kind) for surface, kind, _ in sorted(live)] == [("elevator", "stuck"), ("rudder", "bias")]
    for words in (["audit", str(kept), "-c", str(config)], ["review", str(recording)]):
        assert main([*words, "--json", "-"]) == 1
        (document,) = json.loads(capsys.readouterr().out)["logs"]
        faults = [(name, f["kind"], f["alarm_s"]) for name, s in document["surfaces"].items() for f in s["faults"]]
        assert [fault[:2] for fault in sorted(faults)] == [alarm[:2] for alarm in sorted(live)]
        assert [f[2] for f in sorted(faults)] == pytest.approx([alarm[2] for alarm in sorted(live)], abs=0.1)


def test_stamps_are_those_of_a_telemetry_log() -> None:
    assert stamped(1.5, b"x") == struct.pack(">Q", 1_500_000) + b"x"
