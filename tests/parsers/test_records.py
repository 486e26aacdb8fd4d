from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from logparsers import Channel, Damage, FlightLog, MissingChannel
from logparsers.assemble import Column, from_columns
from logparsers.only import Only

LOG = FlightLog(
    Path("a.csv"),
    "table",
    {
        "tail_cmd_deg": Channel("tail_cmd_deg", np.array([1.0, 2.0]), np.array([0.0, 1.0]), "deg", "tail_cmd_deg"),
        "tail_pos_deg": Channel("tail_pos_deg", np.array([1.5, 4.0]), np.array([3.0, 3.0]), "deg", "tail_pos_deg"),
    },
    (Damage("gap", "no samples"), Damage("gap", "no samples"), Damage("truncated", "one row")),
    run="7",
)


def test_a_channel_that_is_not_there_names_its_neighbours() -> None:
    with pytest.raises(MissingChannel, match=r"a\.csv \(run 7\): no channel 'tail_pos'; .* among them tail_pos_deg"):
        LOG["tail_pos"]
    with pytest.raises(MissingChannel, match="among them tail_cmd_deg, tail_pos_deg"):
        LOG["???"]


def test_the_summary_counts_damage_and_spans_all_channels() -> None:
    assert repr(LOG) == "<FlightLog a.csv (run 7): table, 3.0 s, 2 channels, 2 gap, 1 truncated>"


def test_times_and_values_must_pair() -> None:
    with pytest.raises(ValueError, match="channel 'x'"):
        Channel("x", np.zeros(3), np.zeros(2), "", "x")


def test_a_channel_owns_its_arrays() -> None:
    values = np.zeros(2)
    channel = Channel("x", np.arange(2.0), values, "", "x")
    values[0] = 9.0
    assert channel.values[0] == 0.0
    assert channel.is_constant
    assert not LOG["tail_cmd_deg"].is_constant


@pytest.mark.slow
def test_a_table_joins_channels_on_their_own_time_stamps() -> None:
    table = LOG.to_pandas()
    assert table.index.name == "time_s"
    assert table.index.tolist() == [1.0, 1.5, 2.0, 4.0]
    np.testing.assert_array_equal(table["tail_cmd_deg"], [0.0, np.nan, 1.0, np.nan])
    assert table.attrs["units"] == {"tail_cmd_deg": "deg", "tail_pos_deg": "deg"}
    assert LOG.to_pandas("tail_pos_deg").index.tolist() == [1.5, 4.0]
    assert LOG.to_pandas(["*_cmd_*"]).columns.tolist() == ["tail_cmd_deg"]
    with pytest.raises(MissingChannel, match="no channel 'nose'"):
        LOG.to_pandas(["tail_cmd_deg", "nose"])


def test_a_table_that_would_fill_the_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("logparsers.records._MOST_CELLS", 7)
    with pytest.raises(ValueError, match=r"2 channels on 4 time stamps .* to_pandas\('tail_cmd_deg'\)"):
        LOG.to_pandas()
    assert LOG.to_pandas("tail_cmd_deg").size == 2


def test_a_choice_of_channels() -> None:
    names = ["RCOU.C1", "RCO2.C15", "1/1:ATTITUDE.roll", "a[0].x[3]", "a[0][SRVP].x"]
    for patterns, found in {
        ("RCOU",): names[:1],
        ("RCO?",): names[:2],
        ("RC",): [],
        ("ATTITUDE",): [names[2]],
        ("1/1:ATTITUDE.roll",): [names[2]],
        ("2/1:ATTITUDE",): [],
        ("a[0]",): names[3:],
        ("a[0].x",): [names[3]],
        ("*.x*", "RCOU"): [names[0], *names[3:]],
        (): [],
    }.items():
        assert Only.of(patterns).pick(names) == found, patterns
    assert Only.of(None).pick(names) == names
    assert Only.of("actuator_servos[0].control[3]").topics == Only(("actuator_servos",))


def test_a_lazy_mapping_of_channels_stays_lazy() -> None:
    class Never(Mapping[str, Channel]):
        def __getitem__(self, name: str) -> Channel:
            raise AssertionError(name)

        def __iter__(self) -> Iterator[str]:
            return iter(["a", "b"])

        def __len__(self) -> int:
            return 2

    log = FlightLog(Path("a.bin"), "dataflash", Never(), span_s=(1.0, 3.5))
    assert repr(log) == "<FlightLog a.bin: dataflash, 2.5 s, 2 channels, no damage>"
    assert (log.parameters, log.texts, log.vehicle, log.firmware, log.start_utc) == ({}, (), "", "", None)


def test_repeated_damage_is_one_line_with_a_count() -> None:
    bad = [
        Damage("bad_checksum", f"a message with a wrong check-sum: {k} bytes", k, k / 1.0, k / 1.0)
        for k in range(1, 1001)
    ]
    gap = Damage("gap", "nothing logged for 2.0 s", 1, 3.0, 5.0)
    log = FlightLog(Path("a.tlog"), "tlog", {}, (*bad, gap))
    (one, other) = log.damage_summary
    assert (one.kind, one.count, one.start_s, one.end_s) == ("bad_checksum", 500_500, 1.0, 1000.0)
    assert one.note.startswith("1000 times, as in: a message with a wrong check-sum")
    assert other == gap


def test_the_same_disorder_of_many_messages_is_one_line() -> None:
    late = [Damage("out_of_order", f"{name}: 1 row sorted in that came late", 1) for name in ("A", "B[1]", "C", "D")]
    (one,) = FlightLog(Path("a.tlog"), "tlog", {}, tuple(late)).damage_summary
    assert (one.count, one.note) == (4, "4 times, as in: A: 1 row sorted in that came late")


def test_a_signalling_nan_of_a_damaged_file_is_a_nan() -> None:
    values = np.array([0x3F800000, 0x7FA00000], dtype=np.uint32).view(np.float32)
    columns = from_columns(np.array([0.0, 1.0]), None, {"x": Column("x", values, "deg", "file")})
    assert columns["x"].values.tolist()[0] == 1.0
    assert np.isnan(columns["x"].values[1])
