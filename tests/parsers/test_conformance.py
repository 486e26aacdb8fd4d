"""What every format promises: the same tests for all of them."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import ClassVar, Generic, TypeVar, cast

import numpy as np
import pytest

import logparsers
from logparsers import FlightLog, LogError, TableLayout
from logparsers.dataflash.encode import encode
from tests.parsers import dataflash_writer, reference, tlog_writer, ulog_writer, writers
from tests.parsers.writers import COMMAND, FLIGHT, POSITION, TIME_S, Floats

MICROSECOND = 1e-6


T = TypeVar("T")


class _Later(Generic[T]):
    def __init__(self, make: Callable[[], T]) -> None:
        self.make = make

    def __get__(self, _: object, owner: type) -> T:
        return self.make()


def later(make: Callable[[], T]) -> T:
    """An attribute that is made when a test asks for it, and not in every run that merely finds its tests."""
    return cast("T", _Later(cache(make)))


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

    @pytest.mark.slow
    def test_path_whatever_its_name(self, tmp_path: Path) -> None:
        for name in ("flight.mat", "flight.csv", "flight.bin", "flight.tlog", "flight"):
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

    def test_truncated(self) -> None:
        for share in (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97):
            self.check_part(self.content[: int(len(self.content) * share)])

    def check_part(self, part: bytes) -> None:
        log = self.outcome(part)
        if isinstance(log, LogError):
            assert "\n" not in str(log)
            return
        assert self.prefixes_are_logs
        for name, values in self.expected.items():
            size = log[name].values.size
            # A row that happens to be cut inside its last cell still has all its cells: nobody can tell.
            np.testing.assert_array_equal(log[name].values[:-1], values[: size - 1])

    @pytest.mark.slow
    def test_flipped_bytes_are_never_another_error(self) -> None:
        for at in range(0, len(self.content), max(len(self.content) // 20, 1)):
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


class Autopilot(Conformance):
    """A log of an autopilot: expected is what the reference decoder reads; a cut file is still a log."""

    prefixes_are_logs = True

    @staticmethod
    def decoder(content: bytes) -> reference.Series:
        """Read it by other software."""
        raise NotImplementedError

    about: ClassVar[tuple[str, str]]
    last_is_unsure: ClassVar[bool] = False
    """A text that is cut inside its last cell still has all its cells."""

    def check(self, log: FlightLog) -> None:
        assert log.format == self.kind
        expected = self.decoder(self.content)
        assert set(log.channels) == set(expected)
        for name, (time_s, values) in expected.items():
            np.testing.assert_array_equal(log[name].values, values, err_msg=name)
            np.testing.assert_allclose(log[name].time_s, time_s, rtol=0.0, atol=MICROSECOND, err_msg=name)
        assert {name: log[name].unit for name in self.units} == self.units
        assert {name: log[name].origin for name in self.origins} == self.origins
        assert log.damage == ()
        assert (log.vehicle, log.firmware) == self.about
        assert log.parameters
        assert log.texts

    def test_truncated(self) -> None:
        for share in (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97):
            self.check_share(share)

    def check_share(self, share: float) -> None:
        whole = self.read(self.content)
        log = self.outcome(self.content[: int(len(self.content) * share)])
        if isinstance(log, LogError):
            assert "\n" not in str(log)
            assert share < 0.5  # what defines the messages was cut off
            return
        assert set(log.channels) <= set(whole.channels)
        for name in log.channels:
            size = log[name].values.size
            sure = max(size - self.last_is_unsure, 0)
            np.testing.assert_array_equal(log[name].values[:sure], whole[name].values[:sure])
            np.testing.assert_allclose(log[name].time_s, whole[name].time_s[:size], rtol=0.0, atol=MICROSECOND)

    def test_only_some_channels(self) -> None:
        name = next(iter(self.units))
        whole = self.read(self.content)
        stem = name.rpartition(".")[0]
        some = logparsers.read(io.BytesIO(self.content), only=[stem])
        assert list(some.channels) == [known for known in whole.channels if known.rpartition(".")[0] == stem]
        (one,) = logparsers.read(io.BytesIO(self.content), only=name).channels.values()
        np.testing.assert_array_equal(one.values, whole[name].values)
        assert (some.parameters, some.texts, some.firmware) == (whole.parameters, whole.texts, whole.firmware)
        with pytest.raises(logparsers.MissingChannel, match="no channel FLUX"):
            logparsers.read(io.BytesIO(self.content), only=["FLUX"])

    def test_its_length_and_summary_decode_no_channel(self, monkeypatch: pytest.MonkeyPatch) -> None:
        log = self.read(self.content)
        ends = [(c.time_s[0], c.time_s[-1]) for c in log.channels.values()]
        monkeypatch.setattr("logparsers.channels.Channel", None)
        assert log.duration_s == max(end for _, end in ends) - min(start for start, _ in ends)
        assert f"{len(ends)} channels, no damage" in repr(log)

    def test_channels_of_a_message_share_their_time_stamps(self) -> None:
        log = self.read(self.content)
        name = next(iter(self.units))
        group = [known for known in log.channels if known.rpartition(".")[0] == name.rpartition(".")[0]]
        assert len({id(log[known].time_s) for known in group}) == 1


class TestDataFlash(Autopilot):
    kind = "dataflash"
    content = encode(dataflash_writer.servo_flight(2.5))

    @staticmethod
    def decoder(content: bytes) -> reference.Series:
        return reference.dataflash(content)

    units: ClassVar[Mapping[str, str]] = {"RCOU.C1": "us", "CSRV[0].Pos": "deg"}
    origins: ClassVar[Mapping[str, str]] = {"CSRV[8].Pos": "CSRV.Pos"}
    about = ("fixed wing", "ArduPlane V4.5.1 (1a2b3c4d)")


class TestDataFlashText(TestDataFlash):
    last_is_unsure = True
    content = dataflash_writer.as_text(dataflash_writer.servo_flight(2.5))

    @staticmethod
    def decoder(content: bytes) -> reference.Series:
        return reference.dataflash_text(content)


class TestTextWithoutStamps(Conformance):
    """Of 2013: values are those of the lines; times are spread, which is on record."""

    kind = "dataflash"
    content = dataflash_writer.before_stamps(100)
    expected = reference.without_stamps(content)
    prefixes_are_logs = True

    def check(self, log: FlightLog) -> None:
        assert log.format == self.kind
        assert set(log.channels) == set(self.expected)
        for name, values in self.expected.items():
            times_s = log[name].time_s
            np.testing.assert_array_equal(log[name].values, values)
            np.testing.assert_allclose(times_s - times_s[0], np.arange(values.size) * 10.0 / values.size, atol=0.06)
        assert ["no time stamps" in damage.note for damage in log.damage] == [True]

    def test_truncated(self) -> None:
        for share in (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97):
            log = self.outcome(self.content[: int(len(self.content) * share)])
            if isinstance(log, LogError):
                assert share < 0.1
                continue
            for name in set(self.expected) & set(log.channels):
                found = log[name].values[:-1]
                np.testing.assert_array_equal(found, self.expected[name][: found.size])


class TestTelemetry(Autopilot):
    kind = "tlog"
    content = tlog_writer.flight(4.0)

    @staticmethod
    def decoder(content: bytes) -> reference.Series:
        return reference.tlog(content)

    units: ClassVar[Mapping[str, str]] = {"SERVO_OUTPUT_RAW.servo3_raw": "us", "ATTITUDE.roll": "rad"}
    origins: ClassVar[Mapping[str, str]] = {"NAMED_VALUE_FLOAT[SRVP1].value": "NAMED_VALUE_FLOAT.value"}
    about = ("fixed wing", "ArduPlane V4.6.0 (abc)")


class TestOneFrame(Conformance):
    """Telemetry of a single message."""

    kind = "tlog"
    content = tlog_writer.log([(0.0, tlog_writer.frame("ATTITUDE", {"time_boot_ms": 5000, "roll": 0.5}))])
    expected = later(lambda: {name: values for name, (_, values) in reference.tlog(TestOneFrame.content).items()})
    units: ClassVar[Mapping[str, str]] = {"ATTITUDE.roll": "rad"}
    origins: ClassVar[Mapping[str, str]] = {"ATTITUDE.roll": "ATTITUDE.roll"}

    def check(self, log: FlightLog) -> None:
        assert (log.format, list(log.channels)) == (self.kind, list(self.expected))
        assert {name: channel.values.tolist() for name, channel in log.channels.items()} == {
            name: values.tolist() for name, values in self.expected.items()
        }
        assert log["ATTITUDE.roll"].time_s.tolist() == [5.0]


class TestUlog(Autopilot):
    kind = "ulog"
    content = ulog_writer.flight(20, dropout=False)

    @staticmethod
    def decoder(content: bytes) -> reference.Series:
        return reference.ulog(content)

    units: ClassVar[Mapping[str, str]] = {"actuator_servos[0].control[3]": "", "sensor_baro[0].pressure": ""}
    origins: ClassVar[Mapping[str, str]] = {"actuator_servos[0].control[3]": "actuator_servos.control[3]"}
    about = ("fixed wing", "PX4 1.15.1")


class TestGzippedDataFlash(TestDataFlash):
    content = gzip.compress(TestDataFlash.content, mtime=0)

    @staticmethod
    def decoder(content: bytes) -> reference.Series:
        return reference.dataflash(gzip.decompress(content))


class TestZippedTable(TestPlainTable):
    content = writers.zipped({"flight.csv": TestPlainTable.content})
    prefixes_are_logs = False


class TestNamesOfOnesOwn(Conformance):
    """A structure of MATLAB with other names than FASER's."""

    kind = "table"
    content = writers.matlab({"t": TIME_S, "q_cmd": COMMAND, "q_meas": POSITION})
    layout = TableLayout(time="t")
    expected: ClassVar[Mapping[str, Floats]] = {"q_cmd": COMMAND, "q_meas": POSITION}
    units: ClassVar[Mapping[str, str]] = {"q_cmd": ""}
    origins: ClassVar[Mapping[str, str]] = {"q_cmd": "q_cmd"}


class TestNamesOfOnesOwnInHdf5(TestNamesOfOnesOwn):
    content = writers.hdf5({"log/t": TIME_S, "log/q_cmd": COMMAND, "log/q_meas": POSITION})
    layout = TableLayout(time="t")
    origins: ClassVar[Mapping[str, str]] = {"q_cmd": "/log/q_cmd"}
