"""The autopilot's own log over MAVLink: it goes on after silence and restarts, and what was stored can be audited."""

from __future__ import annotations

import io
import json
from typing import TYPE_CHECKING

import numpy as np
import pytest

import logparsers
from logparsers.codec import Codec
from logparsers.dataflash.live import BlockStream
from logparsers.replay import replayed
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.cli import main
from servofd.detection.audit import audit_log
from servofd.live.session import Session
from servofd.simulation.dataflash_writer import dataflash_log
from tests.live.relay import BadLink
from tests.live.test_troubles import Field, kinds, lively
from tests.live.vehicles import PLANE, vehicle

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    return aircraft_of_the_card(tmp_path_factory.mktemp("plane"))


def aircraft_of_the_card(folder: Path, names: Sequence[str] = ("elevator", "aileron", "rudder")) -> Aircraft:
    """As its user has it for the log on the card; all of its surfaces, or some."""
    path = folder / "plane.toml"
    surfaces = [
        f'[surfaces.{name}]\nservo = "hs225bb-eq31"\nthreshold_deg = 1.5\n'
        f'command = {{ channel = "CSRV[{n - 1}].PosCmd", unit = "deg" }}\n'
        f'measured = {{ channel = "CSRV[{n - 1}].Pos", unit = "deg" }}\n'
        for name, n in (("elevator", 2), ("aileron", 1), ("rudder", 4))
        if name in names
    ]
    path.write_text('name = "plane"\n' + "".join(surfaces))
    return load_aircraft(path)


class TestBlocks:
    def test_those_that_come_again_are_no_new_beginning(self) -> None:
        stream = BlockStream()
        given = [stream.take(n, bytes([n % 256]), 0.0) for n in [*range(60), 57, 3, *range(60, 70)]]
        assert [data for ready in given for data in ready] == [bytes([n]) for n in range(70)]
        assert stream.restarts == 0

    def test_those_that_were_given_up_are_none_either(self) -> None:
        stream = BlockStream()
        for n in (*range(10), *range(12, 30)):
            stream.take(n, bytes([n]), 0.01 * n)
        assert stream.take(40, b"x", 5.0)[0] == b""
        assert (stream.take(10, b"\x0a", 5.1), stream.restarts, stream.lost) == ([], 0, 2)

    @pytest.mark.parametrize("before", [30, 5000])
    def test_the_first_one_again_with_other_content_is_one(self, before: int) -> None:
        stream = BlockStream()
        for n in range(before):
            stream.take(n, b"first" if n < 2 else bytes([n % 256]), 0.0)
        after = [data for n in range(20) for data in stream.take(n, b"first" if n < 2 else b"after", 9.0)]
        assert (stream.restarts, after) == (1, [b"", *[b"first"] * 2, *[b"after"] * 18])

    @pytest.mark.parametrize("order", [(0, 1, 2, 3), (1, 0, 3, 2), (3, 2, 1, 0)])
    def test_the_first_ones_may_overtake_each_other(self, order: tuple[int, ...]) -> None:
        stream = BlockStream()
        for n in range(5000):
            stream.take(n, bytes([n % 256]), 0.0)
        given = [data for n in order for data in stream.take(n, b"new%d" % n, 9.0)]
        assert [data for data in given if data] == [b"new%d" % n for n in range(4)]


def watching(aircraft: Aircraft, **options: BadLink) -> tuple[Field, bytearray]:
    stored = bytearray()
    return Field.of({0: aircraft}, store=stored.extend, remote_log=True, **options), stored


@pytest.mark.nightly
def test_it_goes_on_after_a_silence_in_which_it_was_given_up(aircraft: Aircraft) -> None:
    """Fifteen seconds without a word in either direction: the autopilot forgets whoever asked, and begins anew."""
    gone = ((6.0, 21.0),)
    field, stored = watching(aircraft, down=BadLink(outages_s=gone))
    field.up = field.down
    field.fly(vehicle(lively(duration_s=50.0, stuck_s=36.0)))
    assert {surface for surface, _ in kinds(field.end(), "alarm")} == {"elevator"}
    assert kinds(field.events, "alarm")[0][1] == pytest.approx(36.5, abs=1.0)
    assert kinds(field.events, "no_data") == []
    found = {m.name: [(f.kind, f.alarm_s) for f in m.faults] for _, m in field.session.watched}
    audit = audit_log(logparsers.read(io.BytesIO(bytes(stored))), aircraft)
    assert {s.surface: [(f.kind, f.alarm_s) for f in s.faults] for s in audit.surfaces} == found


@pytest.mark.nightly
def test_it_goes_on_after_the_vehicle_has_started_again(aircraft: Aircraft) -> None:
    field, stored = watching(aircraft)
    field.fly(vehicle(lively(duration_s=12.0)))
    field.wait(5.0)
    field.fly(vehicle(lively(duration_s=30.0, stuck_s=18.0, seed=4)))
    assert [surface for surface, _ in kinds(field.end(), "alarm")] == ["elevator"]
    assert kinds(field.events, "alarm")[0][1] == pytest.approx(18.5, abs=1.0), "seconds of its second boot"
    again = Session(Codec(0, 191), {0: aircraft}, remote_log=True)
    events = [e for now_s, frame in replayed(bytes(stored)) for e in (*again.take(now_s, frame), *again.step(now_s))]
    assert kinds(events, "alarm") == kinds(field.events, "alarm")


@pytest.mark.slow
def test_what_was_stored_is_what_the_card_holds(aircraft: Aircraft) -> None:
    """But for rows at the edge of lost blocks, which are left out."""
    field, stored = watching(aircraft, down=BadLink(loss=0.05, seed=7))
    flight = lively(duration_s=12.0)
    field.fly(vehicle(flight))
    live = logparsers.read(io.BytesIO(bytes(stored)))
    card = logparsers.read(io.BytesIO(dataflash_log(flight, PLANE)))
    for name in ("RCOU.C2", "CSRV[1].Pos", "CSRV[1].PosCmd"):
        rows = set(zip(live[name].time_s.tolist(), live[name].values.tolist(), strict=True))
        on_card = set(zip(card[name].time_s.tolist(), card[name].values.tolist(), strict=True))
        assert rows <= on_card
        assert len(rows) > 0.8 * len(on_card)
    assert live.parameters["SERVO2_FUNCTION"] == 19.0
    assert np.all(np.diff(live["CSRV[1].Pos"].time_s) > 0.0)


@pytest.mark.slow
def test_a_log_that_stops_in_the_middle_of_a_block_is_judged_until_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The telemetry log that the monitor kept, replayed and audited, and the blocks themselves as a log of the card."""
    field, stored = watching(aircraft_of_the_card(tmp_path, ["elevator"]))
    field.fly(vehicle(lively(duration_s=14.0, stuck_s=9.0)))
    ((_, alarm_s),) = kinds(field.end(), "alarm")
    reader, blocks, ends, at = Codec(0, 191), {}, [], 0
    for _, frame in replayed(bytes(stored)):
        at += 8 + len(frame)
        (heard,) = reader.decode(frame)
        if heard.name == "REMOTE_LOG_DATA_BLOCK":
            blocks[heard.fields["seqno"]] = bytes(heard.fields["data"])
            ends.append(at)
    cut = {
        "flight.tlog": bytes(stored)[: ends[-1] - 100],
        "flight.bin": b"".join(blocks[n] for n in sorted(blocks))[:-77],
    }
    for name, content in cut.items():
        path = tmp_path / name
        path.write_bytes(content)
        arguments = [str(path), "-c", str(tmp_path / "plane.toml")]
        assert main(["monitor", *arguments, "--speed", "0", "--json-lines", "-"]) == 1
        told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert main(["audit", *arguments, "--json", "-"]) == 1
        (log,) = json.loads(capsys.readouterr().out)["logs"]
        (fault,) = log["surfaces"]["elevator"]["faults"]
        assert (log["error"], fault["kind"]) == (None, "stuck")
        assert [(e["surface"], e["time_s"]) for e in told if e["event"] == "alarm"] == [("elevator", fault["alarm_s"])]
        assert fault["alarm_s"] == pytest.approx(alarm_s, abs=0.1)
        assert "truncated" in {damage["kind"] for damage in log["damage"]}
