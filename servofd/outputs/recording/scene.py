"""The aircraft with its moving surfaces, and its track."""

from __future__ import annotations

import itertools
import re
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.core.series import tenths
from servofd.outputs.recording.states import states
from servofd.outputs.recording.stream import STATES, colours, shown
from servofd.outputs.recording.surface import send_seconds
from servofd.servo.context import NO_CONTEXT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.core.types import FloatArray
    from servofd.outputs.recording.content import Recording, Trace
    from servofd.outputs.recording.stream import Recorder
    from servofd.servo.context import Context

ATTITUDE, LOCAL, GEO = "/flight/attitude", "/flight/position", "/flight/geo"
AIRSPEED, SUPPLY = "/flight/airspeed", "/flight/supply"
"""Where attitude, local and geographic position, airspeed and supply are kept as numbers."""

_BODY_RGBA = 0xB0B0B0FF
"""Colour of the aircraft's body: light grey."""
_GHOST_OPACITY = 0.6
"""Opacity of the simulated surface beside the measured one."""


def send_scene(recorder: Recorder, recording: Recording) -> None:
    """Draw the aircraft; each surface as it was measured, in the colour of its state, and as it should have been."""
    import rerun as rr
    from scipy.spatial.transform import Rotation

    recorder.stream.log("/aircraft", rr.ViewCoordinates.FRD, static=True)
    centres, half_sizes = zip(*BODY, strict=True)
    body = rr.Boxes3D(centers=centres, half_sizes=half_sizes, colors=_BODY_RGBA, fill_mode="solid")
    recorder.stream.log("/aircraft/frame/body", body, static=True)
    if recording.attitude is not None:
        recorder.scalars(ATTITUDE, recording.attitude[:, 0], recording.attitude[:, 1:])
        recorder.lines(ATTITUDE, ["roll", "pitch", "yaw"], ["simulated", "measured", "command"])
        turned = Rotation.from_euler("ZYX", recording.attitude[:, :0:-1], degrees=True)  # yaw first, roll last
        recorder.columns(
            "/aircraft/frame", recording.attitude[:, 0], rr.Transform3D.columns(quaternion=turned.as_quat())
        )
    for name, hinge in hinges(list(recording.traces)).items():
        surface = next(s for s in recording.audit.surfaces if s.surface == name)
        trace = recording.traces[name]
        changes = states(trace, surface)
        _send_surface(recorder, rr.new_entity_path(["aircraft", "frame", shown(name)]), trace, hinge, changes)
    # All surfaces of a log share it.
    send_context(recorder, next((t.context for t in recording.traces.values()), NO_CONTEXT))
    _send_track(recorder, recording)


def send_context(recorder: Recorder, context: Context) -> None:
    """Airspeed and supply, on their own time stamps."""
    for place, name, time_s, values in (
        (AIRSPEED, "airspeed [m/s]", context.airspeed_s, context.airspeed_m_s),
        (SUPPLY, "servo supply [V]", context.voltage_s, context.voltage_v),
    ):
        if time_s.size:
            recorder.lines(place, [name], ["simulated"])
            recorder.scalars(place, time_s, values)
            send_seconds(recorder, f"{place}/seconds", time_s)


def _send_surface(recorder: Recorder, place: str, trace: Trace, hinge: Hinge, changes: list[tuple[float, str]]) -> None:
    import rerun as rr
    from scipy.spatial.transform import Rotation

    recorder.stream.log(place, rr.Transform3D(translation=hinge.at), static=True)
    behind = {"centers": [(-hinge.half_size[0], 0.0, 0.0)], "half_sizes": [hinge.half_size]}
    tint = colours(["simulated"], _GHOST_OPACITY)
    ghost = rr.Boxes3D(**behind, colors=tint, fill_mode="transparentfillmajorwireframe")
    recorder.stream.log(f"{place}/simulated", ghost, static=True)
    recorder.stream.log(f"{place}/measured", rr.Boxes3D(**behind, fill_mode="solid"), static=True)
    for which, angle_deg in (("simulated", trace.simulated_deg), ("measured", trace.measured_deg)):
        known = np.flatnonzero(np.isfinite(angle_deg))
        kept = known[tenths(trace.time_s[known])]
        turned = Rotation.from_rotvec(np.outer(angle_deg[kept], hinge.axis), degrees=True)
        recorder.columns(f"{place}/{which}", trace.time_s[kept], rr.Transform3D.columns(quaternion=turned.as_quat()))
    times = np.array([time_s for time_s, _ in changes])
    tints = colours([STATES[word] for _, word in changes])
    recorder.columns(f"{place}/measured", times, rr.Boxes3D.columns(colors=tints))


def _send_track(recorder: Recorder, recording: Recording) -> None:
    """Where it flew, red where a surface was at fault: in metres from the start, and on the map."""
    import rerun as rr

    if recording.position is not None:
        recorder.scalars(LOCAL, recording.position[:, 0], recording.position[:, 1:])
        recorder.stream.log("/flight/local", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        strips, tints = _strips(recording, recording.position)
        recorder.stream.log("/flight/local/track", rr.LineStrips3D(strips, colors=tints), static=True)
        here = rr.Points3D.columns(positions=recording.position[:, 1:])
        recorder.columns("/flight/local/aircraft", recording.position[:, 0], here)
        style: Any = rr.Points3D.from_fields(radii=rr.Radius.ui_points(6.0), colors=colours(["measured"]))
        recorder.stream.log("/flight/local/aircraft", style, static=True)
    if recording.geo is not None:
        recorder.scalars(GEO, recording.geo[:, 0], recording.geo[:, 1:])
        strips, tints = _strips(recording, recording.geo)
        lines = rr.GeoLineStrings(lat_lon=[strip[:, :2] for strip in strips], colors=tints)
        recorder.stream.log(f"{GEO}/track", lines, static=True)


def _strips(recording: Recording, rows: FloatArray) -> tuple[list[FloatArray], Any]:
    """Pieces of a track of shape (n, 4), and the colour of each."""
    faults = [f for s in recording.audit.surfaces for f in s.faults]
    end_s = recording.end_s
    time_s = rows[:, 0]
    bad = np.zeros(time_s.size, dtype=bool)
    for fault in faults:
        bad |= (time_s >= fault.start_s) & (time_s <= (end_s if fault.end_s is None else fault.end_s))
    cuts = [0, *(np.flatnonzero(np.diff(bad)) + 1).tolist(), time_s.size]
    pieces = [(rows[a : b + 1, 1:], "fault" if bad[a] else "ok") for a, b in itertools.pairwise(cuts)]
    return [piece for piece, _ in pieces], colours([tint for _, tint in pieces])


@dataclass(frozen=True, slots=True)
class Hinge:
    """Axis that a surface turns about; its trailing edge is behind (forward, right, down)."""

    at: tuple[float, float, float]
    axis: tuple[float, float, float]
    half_size: tuple[float, float, float]
    """Of the surface: half its chord, span and thickness, in the same axes."""


_DRAWN = tomllib.loads((Path(__file__).parent / "aircraft.toml").read_text(encoding="utf-8"))
BODY = tuple((part["at"], part["half_size"]) for part in _DRAWN["body"])
"""Fuselage, wing, tail and fin: centre and half size in the axes forward, right, down, in drawn metres."""
_AXES = {"right": (0.0, 1.0, 0.0), "down": (0.0, 0.0, 1.0)}


def _hinge(place: Mapping[str, Any]) -> Hinge:
    return Hinge(tuple(place["at"]), _AXES[place["axis"]], tuple(place["half_size"]))


def hinges(names: list[str]) -> dict[str, Hinge]:
    """A place for each surface; those whose names say nothing stand in a row behind the aircraft.

    Examples
    --------
    >>> [round(h.at[0], 2) for h in hinges(["elevator", "servo_7"]).values()]
    [-0.82, -1.3]
    """
    known = [(place["words"], _hinge(place)) for place in _DRAWN["surfaces"]]
    other, apart_m = _hinge(_DRAWN["unnamed"]), _DRAWN["unnamed"]["apart"]
    placed: dict[str, Hinge] = {}
    row = 0
    for name in names:
        guess = next((hinge for words, hinge in known if re.search(words, name.lower())), None)
        if guess is None or guess in placed.values():
            sideways = (row + 1) // 2 * (apart_m if row % 2 else -apart_m)
            guess = replace(other, at=(other.at[0], sideways, other.at[2]))
            row += 1
        placed[name] = guess
    return placed
