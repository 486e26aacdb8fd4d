"""The fields of PX4 topics as channels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from logparsers.channels import Series
from logparsers.texts import distinct_texts, split_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from logparsers.ulog.file import UlogFile

_NAME_FIELDS = {"debug_key_value": "key", "debug_vect": "name", "debug_array": "name"}
"""Topics that several senders share, and the text that tells them apart."""

_UNITS = {
    "_m_s2": "m/s/s",
    "_m_s": "m/s",
    "_rad_s": "rad/s",
    "_celsius": "degC",
    "_celcius": "degC",
    "_rad": "rad",
    "_deg": "deg",
    "_rpm": "rpm",
    "_pa": "Pa",
    "_hz": "Hz",
    "_us": "us",
    "_ms": "ms",
    "_v": "V",
    "_a": "A",
}
"""Endings by which PX4 names units, longer ones first; the log itself has none."""


class Topic(NamedTuple):
    """Rows that share a clock: one topic, one instance, and one sender where the topic names them."""

    name: str
    instance: int
    label: str


def unit_of(field: str) -> str:
    """Read the unit off the end of a field's name; empty if there is none.

    Examples
    --------
    >>> unit_of("true_airspeed_m_s"), unit_of("voltage5v_v"), unit_of("control[3]")
    ('m/s', 'V', '')
    """
    stem = field.partition("[")[0]
    return next((unit for ending, unit in _UNITS.items() if stem.endswith(ending)), "")


class UlogRecording:
    """Every numeric series of a PX4 log.

    A name is ``topic[instance].field``, as in ``actuator_servos[0].control[3]``. Where a topic carries named
    values of several senders, the name follows: ``debug_array[0][SRVP].data[2]``.
    """

    def __init__(self, file: UlogFile) -> None:
        self._file = file
        self._rows: dict[tuple[str, int], dict[str, NDArray[np.intp]]] = {}

    def series(self) -> dict[str, Series]:
        """Every series by the name of its channel."""
        found: dict[str, Series] = {}
        for topic, instance in self._file.topics:
            labels = self._labels(topic, instance)
            for field, kind in self._file.fields(topic, instance).items():
                if field == "timestamp" or kind == "char":
                    continue
                for label in labels:
                    bracket = f"[{label}]" if label else ""
                    group, origin = Topic(topic, instance, label), f"{topic}.{field}"
                    found[f"{topic}[{instance}]{bracket}.{field}"] = Series(group, field, None, unit_of(field), origin)
        return found

    def stamps(self, group: Topic) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Time of each row [s since boot]; 0 was not filled in, unless the log begins at 0."""
        time_s = self._of(group, self._file.time_s(group.name, instance=group.instance))
        return time_s, time_s > 0.0 if self._file.begin_s > 0.0 else None

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file."""
        group: Topic = series.group  # type: ignore[assignment]
        return self._of(group, self._file.column(group.name, series.field, instance=group.instance))

    def _of(self, group: Topic, values: NDArray[Any]) -> NDArray[Any]:
        return values[self._labels(group.name, group.instance)[group.label]] if group.label else values

    def _labels(self, topic: str, instance: int) -> dict[str, NDArray[np.intp]]:
        """Names that share a topic, and whose each row is."""
        key = (topic, instance)
        if key not in self._rows:
            stem = _NAME_FIELDS.get(topic)
            fields = [f for f in self._file.fields(topic, instance) if stem and f.startswith(f"{stem}[")]
            if fields and self._file.count(topic, instance):
                raw = np.stack([self._file.column(topic, f, instance=instance) for f in fields], axis=1)
                self._rows[key] = split_rows(*distinct_texts(raw.astype(np.uint8)))
            else:
                self._rows[key] = {"": np.zeros(0, dtype=np.intp)}
        return self._rows[key]
