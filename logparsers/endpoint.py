"""Where a live MAVLink stream is: sockets and serial devices, and nothing else."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal

from logparsers.errors import LinkError

_LOOPBACK: Final = "127.0.0.1"
_KINDS: Final = ("udpin", "udpout", "tcp", "tcpin")
_HELP: Final = (
    "give udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or a serial device such as "
    "/dev/ttyACM0,115200"
)
_NAME: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?")
_DEVICE: Final = re.compile(r"(/dev/(?!.*\.\.)[\w./-]+|COM\d+)")
_USUAL_BAUD: Final = 115_200
"""Rate of a serial device unless another is given [bit/s]."""


@dataclass(frozen=True, slots=True)
class Socket:
    """A network endpoint.

    `kind`: ``udpin`` waits for datagrams and answers whoever sent one, ``udpout`` sends them, ``tcp`` connects,
    ``tcpin`` waits for connections. `host`: address or name. `port`: from 1 to 65535.
    """

    kind: Literal["udpin", "udpout", "tcp", "tcpin"]
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.kind}:{self.host}:{self.port}"


@dataclass(frozen=True, slots=True)
class Serial:
    """A serial device.

    `device`: ``/dev/...`` or ``COMn``. `baud`: bits per second.
    """

    device: str
    baud: int = _USUAL_BAUD

    def __str__(self) -> str:
        return f"{self.device},{self.baud}"


Endpoint = Socket | Serial


def parse_endpoint(text: str) -> Endpoint:
    """Read what a user wrote; whatever is not one of these kinds is refused, and nothing is ever executed.

    `text`: ``udpin:``, ``udpout:``, ``tcp:`` or ``tcpin:`` with ``HOST:PORT``, or with ``PORT`` alone for this machine;
    or a serial device, ``DEVICE`` or ``DEVICE,BAUD``.
    """
    device, comma, baud = text.partition(",")
    if _DEVICE.fullmatch(device):
        if comma and not _is_whole(baud, 10_000_000):
            raise LinkError(f"{text}: {baud!r} is no rate in bits per second; write {device},{_USUAL_BAUD}")
        return Serial(device, int(baud) if comma else _USUAL_BAUD)
    kind, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    if kind not in _KINDS or not (not host or _NAME.fullmatch(host)):
        raise LinkError(f"{text}: not a MAVLink endpoint; {_HELP}")
    if not _is_whole(port, 65535):
        raise LinkError(f"{text}: {port!r} is no port; {_HELP}")
    return Socket(kind, host or _LOOPBACK, int(port))  # type: ignore[arg-type]


def _is_whole(text: str, most: int) -> bool:
    """Whether a text is a number from 1 on in digits; Python makes none of thousands of them."""
    return text.isascii() and text.isdigit() and len(text) < 20 and 0 < int(text) <= most
