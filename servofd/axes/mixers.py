"""What an autopilot's outputs ask of each axis: ailerons, flaperons, elevons, V-tails, and those in parallel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from servofd.aircraft.outputs import named_outputs

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.aircraft.outputs import LoggedOutput

_SHARES: Mapping[int, tuple[tuple[str, float], ...]] = {
    4: (("roll", 1.0),),
    19: (("pitch", 1.0),),
    21: (("yaw", 1.0),),
    24: (("roll", -1.0),),
    25: (("roll", 1.0),),
    77: (("pitch", 1.0), ("roll", -1.0)),
    78: (("pitch", 1.0), ("roll", 1.0)),
    79: (("pitch", 1.0), ("yaw", -1.0)),
    80: (("pitch", 1.0), ("yaw", 1.0)),
}
"""SERVOn_FUNCTION to what a surface does, with the signs of ArduPlane's mixers (left is the difference)."""

_THROTTLES = frozenset({70, 73, 74})
LIFT_MOTORS = frozenset({*range(33, 41), *range(82, 86), 160})
_AXES = {"roll": "roll", "pitch": "pitch", "yaw": "side"}


@dataclass(frozen=True, slots=True)
class Share:
    """What one output adds to the command of an axis."""

    output: LoggedOutput
    weight: float


@dataclass(frozen=True, slots=True)
class Airframe:
    """Outputs by what they serve.

    Parameters
    ----------
    commands : mapping of str to tuple of Share
        For ``"roll"``, ``"pitch"``, ``"yaw"``.
    throttles, lift_motors : tuple of LoggedOutput
        Engines that pull forward, and motors that lift.
    members : mapping of str to tuple of str
        Surfaces of each axis; one that serves two axes stands in both.
    """

    commands: Mapping[str, tuple[Share, ...]]
    throttles: tuple[LoggedOutput, ...]
    lift_motors: tuple[LoggedOutput, ...]
    members: Mapping[str, tuple[str, ...]]

    @property
    def has_surfaces(self) -> bool:
        """False for a multirotor or a helicopter."""
        return bool(self.commands)


def airframe_of(outputs: Mapping[int, LoggedOutput]) -> Airframe:
    """Sort outputs by what they serve.

    Examples
    --------
    >>> from servofd.aircraft.outputs import LoggedOutput
    >>> wing = airframe_of({1: LoggedOutput(1, 77), 2: LoggedOutput(2, 78), 3: LoggedOutput(3, 70)})
    >>> wing.members["roll"], [share.weight for share in wing.commands["roll"]]
    (('elevon_left', 'elevon_right'), [-0.5, 0.5])
    """
    served: dict[str, list[tuple[LoggedOutput, float]]] = {}
    for output in outputs.values():
        for axis, sign in _SHARES.get(output.function or 0, ()):
            served.setdefault(axis, []).append((output, sign))
    surfaces = sorted({output.number for parts in served.values() for output, _ in parts})
    names = named_outputs(outputs, surfaces)
    return Airframe(
        commands={
            axis: tuple(Share(output, sign / len(parts)) for output, sign in parts) for axis, parts in served.items()
        },
        throttles=tuple(output for output in outputs.values() if output.function in _THROTTLES),
        lift_motors=tuple(output for output in outputs.values() if output.function in LIFT_MOTORS),
        members={
            _AXES[axis]: tuple(names[output.number] for output, _ in sorted(parts, key=lambda p: p[0].number))
            for axis, parts in served.items()
        }
        | {"thrust": ("engine",)},
    )
