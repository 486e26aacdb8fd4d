"""The vehicle's parameters, as they are asked for one by one or all together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from servofd.simulation.vehicle.messages import Send

if TYPE_CHECKING:
    from collections.abc import Mapping

_PER_TURN: Final = 5
_NO_PLACE: Final = 65_535
_INT8, _INT16, _INT32, _REAL32 = 2, 4, 6, 9  # MAV_PARAM_TYPE
_WHOLE: Final = (
    (("_REVERSED", "_DISARMED", "_REPLAY", "_TYPE", "_ENABLE", "_TRIM_AUTO", "_PROTOCOL", "_DRIVER"), _INT8),
    (("_FUNCTION", "_MIN", "_MAX", "_TRIM", "_RATE", "_RANGE", "_THISMAV"), _INT16),
    (("_MASK", "_BITMASK", "_BM"), _INT32),
)


class Parameters:
    """Answers what a ground station asks about parameters; it can change none.

    Examples
    --------
    >>> answered = Parameters({"SERVO2_MIN": 1000.0}).read("SERVO2_MIN", -1)[0].fields
    >>> answered["param_value"], answered["param_type"], answered["param_count"], answered["param_index"]
    (1000.0, 4, 1, 0)
    """

    def __init__(self, known: Mapping[str, float]) -> None:
        self._known = dict(known)
        self._names = list(known)
        self._listed = len(known)

    def list_all(self) -> None:
        """Begin to send them all, from the first."""
        self._listed = 0

    def due(self) -> list[Send]:
        """Next few of a list that was asked for."""
        found = [self._value(n) for n in range(self._listed, min(self._listed + _PER_TURN, len(self._names)))]
        self._listed += len(found)
        return found

    def read(self, name: str, index: int) -> list[Send]:
        """One of them, by its index, or by its name if the index is -1; nothing if there is none."""
        if index < 0:
            index = self._names.index(name) if name in self._known else -1
        return [self._value(index)] if 0 <= index < len(self._names) else []

    def set(self, name: str, value: float) -> list[Send]:
        """Set one, as somebody with other means did; every ground station is told, without its place in the list."""
        if name not in self._known:
            return []
        self._known[name] = value
        told = self._value(self._names.index(name))
        return [Send(told.name, {**told.fields, "param_index": _NO_PLACE})]

    def _value(self, index: int) -> Send:
        name = self._names[index]
        kind = next((kind for endings, kind in _WHOLE if name.endswith(endings)), _REAL32)
        count = len(self._names)
        fields: dict[str, Any] = {"param_id": name, "param_value": self._known[name], "param_type": kind}
        return Send("PARAM_VALUE", {**fields, "param_count": count, "param_index": index})
