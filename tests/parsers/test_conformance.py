"""What every format promises: the same tests for all of them."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import logparsers
from logparsers import FlightLog, LogError, TableLayout
from tests.parsers import writers
from tests.parsers.writers import COMMAND, FLIGHT, POSITION, TIME_S, Floats

MICROSECOND = 1e-6


class Conformance:
    """A subclass names a file, and what must be found in it."""

    kind: ClassVar[str] = "faser"
    content: ClassVar[bytes]
    layout: ClassVar[TableLayout | None] = None
    expected: ClassVar[Mapping[str, Floats]] = {"de": COMMAND, "de_pos": POSITION}
    units: ClassVar[Mapping[str, str]] = {"de": "rad", "de_pos": "rad_or_count"}
    origins: ClassVar[Mapping[str, str]] = {"de": "de"}
    prefixes_are_logs: ClassVar[bool] = False
    """A text table is one at every line: what is left of it is read, and the cut row is on record."""

    def read(self, content: bytes) -> FlightLog:
        return logparsers.read(io.BytesIO(content), self.layout)

    def outcome(self, content: bytes) -> FlightLog | LogError:
        try:
            return self.read(content)
        except LogError as error:
            return error

    def check(self, log: FlightLog) -> None:
        assert log.format == self.kind
        assert list(log.channels) == list(self.expected)
        for name, values in self.expected.items():
            np.testing.assert_array_equal(log[name].values, values)
            np.testing.assert_allclose(log[name].time_s, TIME_S, rtol=0.0, atol=MICROSECOND)
            assert log[name].values.dtype.isnative
        assert {name: log[name].unit for name in self.units} == self.units
        assert {name: log[name].origin for name in self.origins} == self.origins
        assert log.damage == ()

    @pytest.mark.parametrize("name", ["flight.mat", "flight.csv", "flight"])
    def test_path_whatever_its_name(self, tmp_path: Path, name: str) -> None:
        path = tmp_path / name
        path.write_bytes(self.content)
        log = logparsers.read(path, self.layout)
        self.check(log)
        assert log.source == path

    def test_text_path(self, tmp_path: Path) -> None:
        path = tmp_path / "flight.log"
        path.write_bytes(self.content)
        self.check(logparsers.read(str(path), self.layout))

    def test_file_object_is_read_from_its_beginning_and_stays_open(self) -> None:
        file = io.BytesIO(self.content)
        file.seek(7)
        self.check(logparsers.read(file, self.layout))
        assert not file.closed
        self.check(logparsers.read(file, self.layout))

    def test_read_all_holds_the_same_log(self) -> None:
        (log,) = logparsers.read_all(io.BytesIO(self.content), self.layout)
        self.check(log)

    @pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97])
    def test_truncated(self, share: float) -> None:
        part = self.content[: int(len(self.content) * share)]
        log = self.outcome(part)
        if isinstance(log, LogError):
            assert "\n" not in str(log)
            return
        assert self.prefixes_are_logs
        for name, values in self.expected.items():
            size = log[name].values.size
            # A row that happens to be cut inside its last cell still has all its cells: nobody can tell.
            np.testing.assert_array_equal(log[name].values[:-1], values[: size - 1])

    def test_flipped_bytes_are_never_another_error(self) -> None:
        for at in range(0, len(self.content), max(len(self.content) // 150, 1)):
            broken = bytearray(self.content)
            broken[at] ^= 0x55
            assert "\n" not in str(self.outcome(bytes(broken)))

    def test_empty(self) -> None:
        with pytest.raises(logparsers.EmptyLog, match="empty"):
            self.read(b"")

    def test_arrays_are_read_only(self) -> None:
        log = self.read(self.content)
        with pytest.raises(ValueError, match="read-only"):
            next(iter(log.channels.values())).values[0] = 1.0


class TestLevel4(Conformance):
    content = writers.flight_level4()


class TestLevel4LittleEndian(Conformance):
    content = writers.flight_level4("<")


class TestLevel4ByScipy(Conformance):
    content = writers.matlab({name: values[:, np.newaxis] for name, values in FLIGHT.items()}, level="4")


class TestLevel5(Conformance):
    content = writers.matlab({**FLIGHT, "pilot": "text", "notes": np.array([["a", "b"]], dtype=object), "rate": 50})


class TestLevel7InStructures(Conformance):
    content = writers.matlab({"sortie": {"data": {n: v[:, np.newaxis] for n, v in FLIGHT.items()}}}, compressed=True)
    origins: ClassVar[Mapping[str, str]] = {"de": "sortie/data/de", "de_pos": "sortie/data/de_pos"}


class TestMatlab73(Conformance):
    content = writers.matlab73(FLIGHT)
    origins: ClassVar[Mapping[str, str]] = {"de": "/flight/de"}


class TestRaptrs(Conformance):
    content = writers.raptrs()
    expected: ClassVar[Mapping[str, Floats]] = {"cmdElev_rad": COMMAND, "cmdMotor_nd": POSITION, "Input_V": POSITION}
    units: ClassVar[Mapping[str, str]] = {"cmdElev_rad": "rad", "cmdMotor_nd": "", "Input_V": "V"}
    origins: ClassVar[Mapping[str, str]] = {"Input_V": "/Sensors/Fmu/Voltage/Input_V"}


class TestFaserTable(Conformance):
    content = writers.table(FLIGHT)
    prefixes_are_logs = True


class TestPlainTable(Conformance):
    kind = "table"
    content = writers.table({"time_s": TIME_S, "rudder_cmd_deg": COMMAND, "rudder_pos_deg": POSITION})
    expected: ClassVar[Mapping[str, Floats]] = {"rudder_cmd_deg": COMMAND, "rudder_pos_deg": POSITION}
    units: ClassVar[Mapping[str, str]] = {"rudder_cmd_deg": "deg", "rudder_pos_deg": "deg"}
    origins: ClassVar[Mapping[str, str]] = {"rudder_pos_deg": "rudder_pos_deg"}
    prefixes_are_logs = True


class TestTableWithLayout(Conformance):
    kind = "table"
    content = writers.table({"t": TIME_S * 1e3, "meas": POSITION, "cmd": COMMAND}, "\t", header=False)
    layout = TableLayout(columns=("t", "meas", "cmd"), time="t", time_unit="ms", units={"meas": "count"})
    expected: ClassVar[Mapping[str, Floats]] = {"meas": POSITION, "cmd": COMMAND}
    units: ClassVar[Mapping[str, str]] = {"meas": "count", "cmd": ""}
    origins: ClassVar[Mapping[str, str]] = {"cmd": "cmd"}
    prefixes_are_logs = True
