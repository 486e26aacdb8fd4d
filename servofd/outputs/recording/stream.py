"""A recording while it is written, by audit, explain or monitor: columns, styles, states, texts, on exact times."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from logparsers.units import US_PER_S
from servofd.core.files import whole_file
from servofd.core.types import FloatArray, IntArray
from servofd.outputs.palette import rgba

TIME_BOOT, TIME_UTC = "time_boot", "time_utc"


def microseconds(time_s: FloatArray) -> IntArray:
    """Seconds to the nearest microsecond."""
    return np.rint(np.asarray(time_s) * US_PER_S).astype(np.int64)


def seconds(time_us: IntArray) -> FloatArray:
    """Microseconds to seconds: the same number that a log's own microseconds give."""
    return np.asarray(time_us) / 1e6


CHUNK_ROWS = 65_536
"""Rows in one chunk: smaller ones cost space, larger ones memory (measured: 22.3 B/scalar at 65 536, 22.5 at 4 096)."""

STATES = {"OK": "ok", "SUSPECT": "suspect", "FAULT": "fault", "NO DATA": "no_data"}
"""Words of the state lanes, and their colours."""

PROPERTIES = "servofd"
"""Name of the recording's property that holds what was found."""


_UNDRAWN = re.compile(r"[^\t\n\x20-\x7e\xa0-\xff\u0391-\u03c9\u0400-\u045f\u2013-\u2026\u2190-\u2193\u2264\u2265]")
"""What the viewer's font (Inter) is not known to have."""


def shown(text: str) -> str:
    """Text that the viewer can draw: it crashes at a character that its font lacks."""
    return _UNDRAWN.sub(lambda found: f"U+{ord(found.group()):04X}", text)


def surface_place(surface: str, *parts: str) -> str:
    r"""Entity path of a surface, whatever characters its name has.

    Examples
    --------
    >>> surface_place("elevator", "residual"), surface_place("a/b"), surface_place("a" + chr(92))
    ('/surfaces/elevator/residual', '/surfaces/a\\/b', '/surfaces/aU\\+005C')
    """
    # Rerun takes a backslash at the end of a name, which it writes twice, for an escape of what follows.
    path: str = rr.new_entity_path(["surfaces", shown(surface).replace("\\", "U+005C"), *parts])
    return path


def colours(names: Sequence[str], opacity: float = 1.0) -> NDArray[np.uint32]:
    """Colours by name, as Rerun takes several of them."""
    return np.array([rgba(name, opacity) for name in names], dtype=np.uint32)


@dataclass(frozen=True, slots=True)
class Recorder:
    """A Rerun stream as servofd writes it."""

    stream: Any
    start_utc: datetime | None = None
    """When ``time_s`` was 0; None if the log does not say, and there is no time of the day then."""

    @property
    def _start_us(self) -> int:
        """Microseconds from 1970 to the start; 0 if it is not known."""
        known = self.start_utc and self.start_utc.replace(tzinfo=None)
        return 0 if known is None else int(np.datetime64(known, "us").astype(np.int64))

    def columns(self, place: str, time_s: FloatArray, columns: Any) -> None:  # noqa: ANN401 - rerun is untyped here
        """Send columns of one row per time [s]; nothing if there is no row.

        Floats of seconds would be off by a nanosecond here and there; whole microseconds are exact.
        """
        if not len(time_s):
            return
        time_us = microseconds(time_s)
        times = [rr.TimeColumn(TIME_BOOT, duration=time_us.astype("timedelta64[us]"))]
        if self.start_utc is not None:
            utc_us = time_us + self._start_us
            times.append(rr.TimeColumn(TIME_UTC, timestamp=utc_us.astype("datetime64[us]")))
        self.stream.send_columns(place, times, columns)

    def scalars(self, place: str, time_s: FloatArray, values: FloatArray) -> None:
        """Send curves of shape (n,) or (n, k), `CHUNK_ROWS` rows at a time."""
        for begin in range(0, time_s.size, CHUNK_ROWS):
            rows = slice(begin, begin + CHUNK_ROWS)
            self.columns(place, time_s[rows], rr.Scalars.columns(scalars=values[rows]))

    def lines(self, place: str, names: Sequence[str], tints: Sequence[str] = (), **style: Any) -> None:  # noqa: ANN401
        """Name and colour the curves of an entity, for all time; without colours they may change with time."""
        # The viewer's default draws a lone spike at half its height.
        style = {"aggregation_policy": "MinMax", "names": [shown(name) for name in names]} | style
        if tints:
            style["colors"] = colours(tints)
        self.stream.log(place, rr.SeriesLines(**style), static=True)

    def line_colours(self, place: str, changes: Sequence[tuple[float, Sequence[str]]]) -> None:
        """Recolour the curves of an entity from given times [s] on; the first must not be after the first sample."""
        rows = rr.SeriesLines.columns(colors=np.concatenate([colours(names) for _, names in changes]))
        times = np.array([time_s for time_s, _ in changes])
        self.columns(place, times, rows.partition([len(names) for _, names in changes]))

    def states(self, place: str, changes: Sequence[tuple[float, str]], tints: Mapping[str, str] = STATES) -> None:
        """Coloured lane: from each time [s] on, a word out of `tints`."""
        words = list(tints)
        style = rr.StateConfiguration(values=words, labels=words, colors=colours(list(tints.values())))
        self.stream.log(place, style, static=True)
        times = np.array([time_s for time_s, _ in changes])
        self.columns(place, times, rr.StateChange.columns(state=[state for _, state in changes]))

    def texts(self, place: str, texts: Sequence[tuple[float, str, str]]) -> None:
        """Lines of a text log: when [s], level (``ERROR``, ``WARN``, ``INFO``), words."""
        times = np.array([time_s for time_s, _, _ in texts])
        levels, words = [level for _, level, _ in texts], [shown(text) for _, _, text in texts]
        self.columns(place, times, rr.TextLog.columns(text=words, level=levels))

    def markers(self, place: str, time_s: FloatArray, heights: FloatArray, name: str, tint: str) -> None:
        """Triangles that point down at given times."""
        style = rr.SeriesPoints(markers="Down", marker_sizes=6.0, colors=colours([tint]), names=shown(name))
        self.stream.log(place, style, static=True)
        self.columns(place, time_s, rr.Scalars.columns(scalars=heights))

    def shade(self, place: str, spans: Sequence[tuple[float, float]], middle: float, half: float, tint: str) -> None:
        """Translucent band from the bottom to the top of a plot during each span (from, to) [s]."""
        style = rr.Measurements.from_fields(colors=colours([tint], 0.65), names=tint, widths=0.0)
        self.stream.log(place, style, static=True)
        # A value that is not a number parts one band from the next.
        times = np.array([t for begin, end in spans for t in (begin, end, end + 1e-6)])
        values = np.tile([middle, middle, np.nan], len(spans))
        variances = np.full(values.size, half**2)
        self.columns(place, times, rr.Measurements.columns(values=values, variances=variances))

    def document(self, place: str, markdown: str) -> None:
        """Text of the report, for all time."""
        self.stream.log(place, rr.TextDocument(shown(markdown), media_type="text/markdown"), static=True)

    def properties(self, name: str, values: Mapping[str, Any]) -> None:
        """Properties of the recording; send them first, so that a recording that was cut short has them."""
        self.stream.send_property(PROPERTIES, rr.AnyValues(**values))
        self.stream.send_recording_name(shown(name))
        if self.start_utc is not None:
            self.stream.send_recording_start_time_nanos(self._start_us * 1000)
        # Columns overtake what waits to be batched: a recording that was cut short would lack what it needs most.
        self.stream.flush()


def application_name(*parts: str) -> str:
    """Name under which the viewer keeps a layout, out of what tells it from others.

    Examples
    --------
    >>> application_name("Hangar 3/B", "", "flight")
    'servofd-Hangar 3-B-flight'
    """
    words = (re.sub(r"[^A-Za-z0-9_ -]", "-", part)[:50] for part in parts if part)
    return "-".join(("servofd", *words))


@contextmanager
def recording_file(
    path: str | Path,
    application: str,
    layout: Any,  # noqa: ANN401 - rerun is untyped here
    start_utc: datetime | None = None,
) -> Iterator[Recorder]:
    """Write a recording whole or not at all; those of one `application` share its layout in the viewer."""
    with whole_file(path) as temporary, rr.RecordingStream(application, send_properties=False) as stream:
        rr.set_log_time_enabled(False, recording=stream)
        stream.save(str(temporary), default_blueprint=layout)
        yield Recorder(stream, start_utc)
