"""Simulated vehicles for tests, on links and without."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from logparsers.codec import Codec, Received
from logparsers.endpoint import parse_endpoint
from logparsers.errors import LinkError
from logparsers.link import open_link
from servofd.aircraft.schema import plain_aircraft
from servofd.simulation.flight import SimulatedFlight, simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.vehicle.fly import Flown, fly, legs
from servofd.simulation.vehicle.troubles import Air
from servofd.simulation.vehicle.vehicle import Settings, Vehicle

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from logparsers.link import Link
    from servofd.simulation.vehicle.remote_log import Send

PLANE = plain_aircraft(["elevator", "aileron", "rudder"], "hs225bb-eq31")
DEADLINE_S = 20.0
GROUND = (255, 190)


def flown(*, rate_hz: float = 50.0, duration_s: float = 10.0, **options: Any) -> SimulatedFlight:
    options = {"seed": 3} | options
    return simulate_flight(PLANE, rate_hz=rate_hz, duration_s=duration_s, outputs=outputs_of(PLANE), **options)


def plane_file(names: Sequence[str] = ("elevator", "aileron", "rudder")) -> str:
    """Aircraft file of `PLANE`, or of some of its surfaces, as its user would write it."""
    surfaces = [
        f'[surfaces.{name}]\nservo = "hs225bb-eq31"\nthreshold_deg = 1.5\n'
        f'command = {{ channel = "SERVO_OUTPUT_RAW.servo{n}_raw", unit = "us", trim_us = 1500, '
        f"slope_deg_per_us = 0.09 }}\n"
        f'measured = {{ channel = "NAMED_VALUE_FLOAT[SRVP{n}].value", unit = "deg" }}\n'
        for name, n in (("elevator", 2), ("aileron", 1), ("rudder", 4))
        if name in names
    ]
    return 'name = "plane"\n' + "".join(surfaces)


def vehicle(flight: SimulatedFlight | None = None, **settings: Any) -> Vehicle:
    return Vehicle(flight or flown(), PLANE, Settings(**settings))


def said(name: str, *, sender: tuple[int, int] = GROUND, **fields: Any) -> Received:
    """A message of a ground station, with the fields that its frame would have."""
    ground = Codec(*sender)
    (message,) = ground.decode(ground.encode(name, {"target_system": 1, "target_component": 1} | fields))
    return message


def command(number: int, param1: float = 0.0, param2: float = 0.0, **fields: Any) -> Received:
    return said("COMMAND_LONG", command=number, param1=param1, param2=param2, **fields)


def ask(of: Vehicle, message: int, interval_us: int) -> int:
    """Ask for an interval; gives the MAV_RESULT."""
    answers = of.receive(command(511, message, interval_us), 0)
    (result,) = [answer.fields["result"] for answer in answers if answer.name == "COMMAND_ACK"]
    return int(result)


def everything(of: Vehicle) -> list[Send]:
    """All messages of the flight."""
    return [message for index in range(of.time_us.size) for message in of.turn(index)]


def fields(messages: list[Send], name: str) -> list[Any]:
    return [message.fields for message in messages if message.name == name]


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def until(happened: Callable[[], Any], what: str, *, deadline_s: float = DEADLINE_S) -> Any:
    """Poll until a condition holds; the polling itself must wait on something."""
    end_s = time.monotonic() + deadline_s
    while time.monotonic() < end_s:
        found = happened()
        if found:
            return found
    raise AssertionError(f"{what} did not happen within {deadline_s:g} s")


def _opened(endpoint: str) -> Link | None:
    """A link; none while the other end does not listen yet."""
    try:
        return open_link(parse_endpoint(endpoint))
    except LinkError:
        time.sleep(0.05)  # a refused connection is all there is to wait on
        return None


@contextmanager
def flying(
    endpoint: str,
    flight: SimulatedFlight | None = None,
    *,
    codec: Codec | None = None,
    wait: bool = True,
    record: bytearray | None = None,
    **settings: Any,
) -> Iterator[list[Flown]]:
    """A vehicle in a thread that takes off when somebody speaks; what it counted is there after it has landed.

    `record` gets every byte that it hears.
    """
    counted: list[Flown] = []
    received = bytearray() if record is None else record
    link = until(lambda: _opened(endpoint), f"{endpoint} could be opened")
    known = Settings(**settings)
    made, air = legs(flight or flown(), PLANE, known), Air(known.troubles)
    stop = threading.Event()

    class Stoppable:
        """The link, until the test ends."""

        def send(self, data: bytes) -> None:
            link.send(data)

        def receive(self, timeout_s: float) -> bytes:
            if stop.is_set():
                raise KeyboardInterrupt
            data: bytes = link.receive(timeout_s)
            received.extend(data)
            return data

        def close(self) -> None:
            link.close()

    def run() -> None:
        counted.append(fly(made, Stoppable(), codec or Codec(1, 1), wait=wait, air=air))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield counted
    finally:
        stop.set()
        thread.join(DEADLINE_S)
        link.close()
        assert not thread.is_alive()
