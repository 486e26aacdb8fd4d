"""The good messages of a telemetry log: who sent how many, and their columns, copied out when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.channels import MOST_CHANNELS
from logparsers.mavlink import Layout
from logparsers.telemetry import frames
from logparsers.texts import distinct_texts, split_rows


class Sender(NamedTuple):
    """Who sent a message."""

    system: int
    component: int


class MessageTable:
    """Messages by type, each a list of positions in the file.

    `name`: what to call the file in messages. `data` (shape (n,)): the file; kept, not copied. `positions`: markers of
    the frames of each type, in the order of the file [bytes]. `layouts`: of every message of `positions`, at least.
    `unstamped`: markers of frames that have no arrival time.
    """

    def __init__(
        self,
        name: str,
        data: NDArray[np.uint8],
        positions: Mapping[str, NDArray[Any]],
        layouts: Mapping[str, Layout],
        unstamped: NDArray[np.int64],
    ) -> None:
        self.name, self._data, self._positions, self._layouts = name, data, positions, layouts
        self._unstamped = unstamped
        self._senders: dict[str, dict[Sender, NDArray[Any]]] = {}
        self._rows: dict[tuple[str, Sender | None], dict[Any, NDArray[np.intp]]] = {}

    @property
    def messages(self) -> tuple[str, ...]:
        """Names of the messages in the file, in the order of their ids."""
        return tuple(self._positions)

    def layout(self, message: str) -> Layout:
        """Fields of a message of this file."""
        return self._layouts[message]

    def count(self, message: str) -> int:
        """Good messages of a type; 0 if there are none."""
        found = self._positions.get(message)
        return 0 if found is None else int(found.size)

    def sources(self, message: str) -> tuple[Sender, ...]:
        """Systems and components that sent a message, sorted; empty if none did."""
        return tuple(self._by_sender(message)) if message in self._positions else ()

    def instances(self, message: str, source: Sender | None = None) -> tuple[Any, ...]:
        """Values of the instance field (texts or integers), sorted; empty if there is no such field."""
        return tuple(self._instances(message, source)) if self.layout(message).instance else ()

    def column(
        self,
        message: str,
        field: str,
        *,
        source: Sender | None = None,
        instance: object = None,
        element: int | None = None,
    ) -> NDArray[Any]:
        """Values of one field, in the order of the file.

        `message`, `field`: for example ``"SERVO_OUTPUT_RAW"``, ``"servo3_raw"``. `source`: only from this system and
        component; from all if None. `instance`: only with this value of the message's instance field; all if None.
        `element`: only this element of an array; all if None. Result (shape (n,)): of the field's own type, in the
        unit of the protocol; texts as ``str``, cut at the first NUL. Extension fields that were not sent are zero.
        """
        known = self.layout(message).fields[field]
        markers = self.stream(message, source)[self.pick(message, source, instance)]
        if element is not None:
            size = known.dtype.itemsize
            alone = frames.gather(self._data, markers, known.offset + element * size, size)
            return alone.view(known.dtype).reshape(-1)
        raw = frames.gather(self._data, markers, known.offset, known.width)
        if known.is_text:
            texts, codes = distinct_texts(raw)
            return np.array([*texts, ""])[codes]
        values = raw.view(known.dtype)
        return values if known.length else values.reshape(-1)

    def pick(self, message: str, source: Sender | None, instance: object) -> Any:  # noqa: ANN401 - an index
        """Rows of a message that belong to one instance: an index array, or a slice of all."""
        return slice(None) if instance is None else self._instances(message, source)[instance]

    def stream(self, message: str, source: Sender | None = None) -> NDArray[Any]:
        """Positions of a message's frames in the file [bytes], rising, shape (n,)."""
        found = self._positions[message]
        return found if source is None else self._by_sender(message).get(Sender(*source), found[:0])

    def _by_sender(self, message: str) -> dict[Sender, NDArray[Any]]:
        """Positions of each sender's frames, by one sort however many senders there are."""
        if message not in self._senders:
            found = self._positions[message]
            addresses, codes = np.unique(frames.origins(self._data, found), return_inverse=True)
            senders = [Sender(*divmod(int(address), 256)) for address in addresses]
            rows = split_rows(senders, codes) if len(senders) > 1 else dict.fromkeys(senders, slice(None))
            self._senders[message] = {sender: found[mine] for sender, mine in rows.items()}
        return self._senders[message]

    def _instances(self, message: str, source: Sender | None) -> dict[Any, NDArray[np.intp]]:
        """Rows of each instance."""
        key = (message, source)
        if key not in self._rows:
            layout = self.layout(message)
            known = layout.fields[layout.instance]
            raw = frames.gather(self._data, self.stream(message, source), known.offset, known.width)
            if known.is_text:
                values, codes = distinct_texts(raw, MOST_CHANNELS + 1)
            else:
                numbers, codes = np.unique(raw.view(known.dtype).reshape(-1), return_inverse=True)
                values = numbers.tolist()
            self._rows[key] = split_rows(values, codes)
        return self._rows[key]

    def arrivals_us(self, markers: NDArray[Any]) -> NDArray[np.uint64]:
        """Arrival times of frames at given positions [us since 1970], shape (n,); 0 where lost."""
        if not self._unstamped.size:
            return frames.arrivals_us(self._data, markers)
        lost = np.isin(markers, self._unstamped)
        arrivals = np.zeros(markers.size, dtype=np.uint64)
        arrivals[~lost] = frames.arrivals_us(self._data, markers[~lost])
        return arrivals
