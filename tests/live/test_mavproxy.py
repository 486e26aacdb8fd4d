"""The simulated vehicle and MAVProxy, which routes between it and a monitor as it does at the field."""

from __future__ import annotations

import io
import socket
from typing import TYPE_CHECKING

import pytest

import logparsers
import servofd
from servofd.servo.faults import Stuck
from servofd.simulation.dataflash_writer import dataflash_log
from tests.live.ground import mavproxy, pymavlink_station, received, router
from tests.live.vehicles import PLANE, flown, flying, free_port, until

if TYPE_CHECKING:
    from pathlib import Path

    from logparsers.records import FlightLog

COMPANION = (1, 191)


@pytest.mark.slow
def test_through_mavproxy_as_a_router(tmp_path: Path) -> None:
    """Heartbeat, parameters and commands pass; an alert shows on the console; the log that it writes is audited."""
    flight = flown(duration_s=30.0, faults={"elevator": Stuck(15.0)})
    with (
        router(tmp_path, "watch STATUSTEXT") as (console, vehicle, alerts, out),
        pymavlink_station(out, source=COMPANION) as monitor,
        pymavlink_station(alerts, source=COMPANION) as announcer,
    ):
        console.wait_for("Waiting for heartbeat")
        with flying(vehicle, flight, speed=5.0) as counted:
            until(lambda: received(monitor, "HEARTBEAT").autopilot == 3, "the vehicle's heartbeat")
            monitor.mav.command_long_send(1, 1, 511, 0, 36, 25_000, 0, 0, 0, 0, 0)
            assert received(monitor, "COMMAND_ACK").result == 0
            monitor.mav.param_request_list_send(1, 1)
            until(lambda: received(monitor, "PARAM_VALUE") and len(monitor.params) == 33, "33 parameters")
            console.wait_for("AP: ArduPlane V4.7.0-dev (simulated by servofd)")
            console.wait_for("Received 33 parameters")
            announcer.mav.heartbeat_send(18, 8, 0, 0, 4)
            announcer.mav.statustext_send(2, b"SERVO elevator: stuck")
            console.wait_for("AP: SERVO elevator: stuck")
            monitor.mav.statustext_send(2, b"SERVO rudder: stuck")
            console.wait_for("> STATUSTEXT {severity : 2, text : SERVO rudder: stuck")
            until(lambda: monitor.recv_match(blocking=True, timeout=0.1) is None and counted, "the end of the flight")
        log = console.telemetry_log()
    (result,) = servofd.audit(str(log))
    found = {surface.surface: [fault.kind for fault in surface.faults] for surface in result.surfaces}
    assert found == {"aileron": [], "elevator": ["stuck"], "rudder": []}
    (fault,) = next(surface.faults for surface in result.surfaces if surface.surface == "elevator")
    assert fault.start_s == pytest.approx(15.0, abs=0.5)


@pytest.mark.slow
def test_the_log_that_mavproxy_collects_is_the_one_that_a_file_holds(tmp_path: Path) -> None:
    """Its dataflash_logger asks, acknowledges and writes; whoever can read one of the two can read the other."""
    port = free_port(socket.SOCK_STREAM)
    flight = flown(duration_s=20.0)
    with flying(f"tcpin:127.0.0.1:{port}", flight, speed=2.0) as counted:
        arguments = ("--streamrate=-1", "--load-module=dataflash_logger")
        with mavproxy(tmp_path, f"--master=tcp:127.0.0.1:{port}", *arguments) as console:
            console.wait_for("DFLogger: logging started")
            until(lambda: console.read() and counted, "the end of the flight")
        (path,) = tmp_path.glob("plane/logs/*/*/1.BIN")
    live, file = logparsers.read(path), logparsers.read(io.BytesIO(dataflash_log(flight, PLANE)))
    for name in ("RCOU.C2", "CSRV[1].Pos", "CSRV[1].PosCmd", "ARSP[0].Airspeed"):
        rows = rows_of(live, name)
        assert rows <= rows_of(file, name)
        assert len(rows) > 0.8 * file[name].values.size


def rows_of(log: FlightLog, name: str) -> set[tuple[float, float]]:
    return set(zip(log[name].time_s.tolist(), log[name].values.tolist(), strict=True))
