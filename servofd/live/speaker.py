"""What the monitor sends, and as whom."""

from __future__ import annotations

import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from logparsers.codec import Codec, Signature, signing_key
from logparsers.protocol import Command
from servofd.core.errors import ConfigError
from servofd.live.threads import Worker

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from logparsers.link import Link

ALLOWED = frozenset(
    {
        "HEARTBEAT",
        "STATUSTEXT",
        "NAMED_VALUE_FLOAT",
        "COMMAND_LONG",
        "TIMESYNC",
        "PARAM_REQUEST_READ",
        "REMOTE_LOG_BLOCK_STATUS",
    }
)
"""COMMAND_LONG for message intervals alone: nothing that moves the vehicle or changes a setting of it."""
_ROOM = 256


class Speaker:
    """Sends a few kinds of messages in the name of an onboard component.

    Parameters
    ----------
    system : int
        System id to speak as; 0 to speak as the vehicle that is spoken of.
    component : int
        Component id.
    signature : Signature, optional
        Signs what is sent.
    """

    def __init__(self, system: int, component: int, signature: Signature | None = None) -> None:
        self._system, self._component, self._signature = system, component, signature

    @contextmanager
    def to(self, link: Link) -> Iterator[Callable[[int, str, dict[str, Any]], None]]:
        """Sender of messages on a link, which works in a thread of its own."""

        def write(data: bytes) -> None:
            link.send(data)

        worker = Worker(write, lambda: None, _ROOM)
        codecs: dict[int, Codec] = {}

        def send(vehicle: int, name: str, fields: dict[str, Any]) -> None:
            if name not in ALLOWED or (name == "COMMAND_LONG" and fields["command"] != Command.SET_MESSAGE_INTERVAL):
                raise ValueError(f"the monitor never sends {name}")
            system = self._system or vehicle or 1
            if system not in codecs:
                codecs[system] = Codec(system, self._component, signature=self._signature)
            worker.put(codecs[system].encode(name, fields))

        try:
            yield send
        finally:
            worker.close()


def signature_of(name: str | None) -> Signature | None:
    """Signature with the key in a file, from now on; none without a file."""
    if name is None:
        return None
    try:
        content = Path(name).read_bytes()
    except OSError as error:
        raise ConfigError(f"--signing-key {name}: cannot read it ({error.strerror or error})") from None
    if not content.strip():
        raise ConfigError(f"--signing-key {name}: holds no key; give 32 bytes, 64 hex digits, or a passphrase")
    return Signature(signing_key(content), time.time())
