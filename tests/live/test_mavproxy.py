"""The simulated vehicle and MAVProxy, which routes between it and a monitor as it does at the field."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import servofd
from servofd.models.faults import Stuck
from tests.live.ground import mavproxy, pymavlink_station, received
from tests.live.vehicles import flown, flying, free_port, until

if TYPE_CHECKING:
    from pathlib import Path

COMPANION = (1, 191)


@pytest.mark.slow
def test_through_mavproxy_as_a_router(tmp_path: Path) -> None:
    """Heartbeat, parameters and commands pass; an alert shows on the console; the log that it writes is audited."""
    vehicle, alerts, out = free_port(), free_port(), free_port()
    flight = flown(duration_s=40.0, faults={"elevator": Stuck(20.0)})
    with (
        mavproxy(
            tmp_path,
            f"--master=udpin:127.0.0.1:{vehicle}",
            f"--master=udpin:127.0.0.1:{alerts}",
            f"--out=udpout:127.0.0.1:{out}",
            "--streamrate=-1",
            "--target-system=1",
            "--target-component=0",
            "--cmd=watch STATUSTEXT",
        ) as console,
        pymavlink_station(f"udpin:127.0.0.1:{out}", source=COMPANION) as monitor,
        pymavlink_station(f"udpout:127.0.0.1:{alerts}", source=COMPANION) as announcer,
    ):
        console.wait_for("Waiting for heartbeat")
        with flying(f"udpout:127.0.0.1:{vehicle}", flight, speed=4.0) as counted:
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
    assert fault.start_s == pytest.approx(20.0, abs=0.5)
