from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from logparsers import clock
from logparsers.errors import ClockError
from logparsers.records import FloatArray

GRID: FloatArray = np.arange(1000.0) * 0.02


def kinds(time_s: FloatArray) -> list[tuple[str, int]]:
    return [(damage.kind, damage.count) for damage in clock.order(time_s, "log")[2]]


def test_sound_stamps_pass_untouched() -> None:
    kept, time_s, damage = clock.order(GRID + 1.7e9, "log")
    assert kept.all()
    assert damage == ()
    np.testing.assert_array_equal(time_s, GRID + 1.7e9)


def test_rows_without_a_stamp_are_dropped_and_counted() -> None:
    stamps = GRID.copy()
    stamps[[4, 5, 900]] = np.nan, np.inf, np.nan
    kept, _, (damage,) = clock.order(stamps, "log")
    assert np.flatnonzero(~kept).tolist() == [4, 5, 900]
    assert (damage.kind, damage.count) == ("non_finite", 3)
    assert "first row 5" in damage.note


def test_no_row_with_a_stamp_is_for_the_caller_to_judge() -> None:
    assert clock.order(np.full(3, np.nan), "log")[1].size == 0


def test_a_late_row_and_a_duplicate_are_dropped() -> None:
    stamps = GRID.copy()
    stamps[100] = stamps[50]
    stamps[200] = stamps[199]
    kept, time_s, (damage,) = clock.order(stamps, "log")
    assert np.flatnonzero(~kept).tolist() == [100, 200]
    assert np.all(np.diff(time_s) > 0.0)
    assert (damage.kind, damage.count, damage.start_s, damage.end_s) == ("out_of_order", 2, GRID[99], GRID[201])


def test_one_stamp_far_ahead_costs_one_row() -> None:
    stamps = GRID.copy()
    stamps[100] = 1e9
    kept, _, _ = clock.order(stamps, "log")
    assert np.flatnonzero(~kept).tolist() == [100]


@pytest.mark.parametrize(("rows", "fatal"), [(10, False), (11, True)])
def test_one_percent_may_be_out_of_order(rows: int, *, fatal: bool) -> None:
    stamps = GRID.copy()
    stamps[500 : 500 + rows] -= 5.0
    if fatal:
        with pytest.raises(ClockError):
            clock.order(stamps, "log")
    else:
        assert kinds(stamps) == [("out_of_order", rows)]


def test_five_rows_of_a_short_log_may_be_out_of_order_but_never_half_of_it() -> None:
    assert kinds(np.r_[GRID[:95], GRID[:5]]) == [("out_of_order", 5)]
    with pytest.raises(ClockError):
        clock.order(np.array([0.0, 0.0, 0.0, 0.0]), "log")
    with pytest.raises(ClockError):
        clock.order(np.array([1.0, 0.0]), "log")


def test_two_flights_in_one_file() -> None:
    with pytest.raises(
        ClockError, match=r"a.csv: time runs backwards at row 1001 \(19.98 s -> 0 s\).*split the log there"
    ):
        clock.order(np.r_[GRID, GRID], "a.csv")


def test_the_row_of_a_clock_error_counts_rows_without_a_stamp() -> None:
    with pytest.raises(ClockError, match="at row 1002"):
        clock.order(np.r_[np.nan, GRID, GRID], "log")


def test_a_clock_that_stands_still() -> None:
    with pytest.raises(ClockError, match="time stands still at row 2"):
        clock.order(np.zeros(100), "log")


@pytest.mark.slow
@given(st.lists(st.integers(0, 50), min_size=1, max_size=60))
def test_what_is_kept_rises_and_no_more_than_needed_is_dropped(stamps: list[int]) -> None:
    time_s = np.array(stamps, dtype=float)
    try:
        kept, rising, _ = clock.order(time_s, "log")
    except ClockError:
        return
    assert np.all(np.diff(rising) > 0.0)
    np.testing.assert_array_equal(time_s[kept], rising)
    lengths: list[int] = []  # the same, in quadratic time
    for row, stamp in enumerate(stamps):
        lengths.append(1 + max((lengths[k] for k in range(row) if stamps[k] < stamp), default=0))
    assert rising.size == max(lengths)


def test_gaps_have_places_and_missing_samples() -> None:
    stamps = np.r_[GRID[:100], GRID[150:400], GRID[420:] + 7200.0]
    gap, jump = clock.gaps(stamps)
    assert (gap.kind, gap.start_s, gap.end_s, gap.count) == ("gap", GRID[99], GRID[150], 50)
    assert (jump.kind, jump.start_s) == ("clock_jump", GRID[399])


@pytest.mark.parametrize(
    ("period_s", "pause_s", "found"), [(0.001, 0.09, 0), (0.001, 0.11, 1), (0.1, 0.45, 0), (0.1, 0.6, 1)]
)
def test_a_gap_is_long_in_periods_and_in_time(period_s: float, pause_s: float, found: int) -> None:
    before = np.arange(50) * period_s
    assert len(clock.gaps(np.r_[before, before[-1] + pause_s + before])) == found


@pytest.mark.parametrize("size", [0, 1, 2])
def test_too_few_stamps_have_no_gap(size: int) -> None:
    assert clock.gaps(np.arange(100.0 * size, step=100.0)) == ()


def test_a_log_in_tatters_is_summed_up() -> None:
    stamps: FloatArray = np.arange(1500.0) * 0.02 + np.repeat(np.arange(150.0), 10)
    damage = clock.gaps(stamps)
    assert len(damage) == clock.MOST_GAPS
    assert damage[-1].note.startswith("50 shorter gaps")
    assert sum(d.count for d in damage) == 149 * 50


def test_forged_stamps_are_no_overflow() -> None:
    with np.errstate(all="ignore"):
        assert [d.kind for d in clock.gaps(np.array([-1e308, 0.0, 1e-320, 2e-320, 3e-320, 1e308]))] == [
            "clock_jump"
        ] * 2


@pytest.mark.slow
@given(st.lists(st.integers(0, 400), max_size=60), st.integers(0, 2**32))
def test_rise_loses_no_row_in_silence(ticks: list[int], seed: int) -> None:
    stamps = np.array(ticks, dtype=np.float64) * 0.1
    stamps[np.random.default_rng(seed).random(stamps.size) < 0.1] = np.nan
    rows, damage = clock.rise(stamps)
    chosen = stamps[rows]
    risen = clock.apart(chosen)
    assert (np.diff(risen) > 0.0).all()
    np.testing.assert_allclose(risen, chosen, rtol=0.0, atol=60e-9)
    lost = stamps.size - rows.size
    assert lost == np.count_nonzero(np.isnan(stamps)) or np.nanmax(stamps) - np.nanmin(stamps) > clock.LATE_S
    assert (damage.count if damage else 0) >= lost
    if damage is None:
        np.testing.assert_array_equal(rows, np.arange(stamps.size))


def test_rise_sorts_late_rows_in_and_keeps_those_of_one_stamp() -> None:
    late = np.concatenate([GRID[:500], GRID[501:600], GRID[500:501], GRID[600:], GRID[-1:]])
    rows, damage = clock.rise(late)
    np.testing.assert_array_equal(late[rows], np.append(GRID, GRID[-1]))
    assert damage is not None
    assert (damage.kind, damage.count, damage.note) == ("out_of_order", 1, "1 row sorted in that came late")
    assert clock.rise(np.repeat(GRID, 3))[1] is None


@pytest.mark.parametrize("begin_s", [-1e-6, 0.0, 1e4, 1.7e9, -1.7e9])
def test_rows_of_one_stamp_are_set_apart_and_pass_no_other(begin_s: float) -> None:
    stamps = begin_s + np.repeat([0.0, 1e-6, 2.0], [16, 1, 30])
    risen = clock.apart(stamps)
    assert (np.diff(risen) > 0.0).all()
    np.testing.assert_allclose(risen, stamps, rtol=0.0, atol=1e-6 if abs(begin_s) < 1e6 else 2e-5)


@pytest.mark.parametrize("wrong", [-1e9, 0.0, 1e9, 19.0 + 86400.0])
def test_rise_drops_the_one_wrong_stamp_and_not_all_that_follow(wrong: float) -> None:
    stamps = GRID + 20.0
    stamps[500] = wrong
    rows, damage = clock.rise(stamps)
    np.testing.assert_array_equal(rows, np.delete(np.arange(GRID.size), 500))
    assert damage is not None
    assert damage.count == 1


def test_rise_leaves_out_rows_that_are_known_to_be_wrong() -> None:
    sound = np.ones(GRID.size, dtype=np.bool_)
    sound[3:5] = False
    rows, damage = clock.rise(GRID, sound)
    assert rows.size == GRID.size - 2
    assert damage is not None
    assert damage.count == 2


def test_a_date_that_no_clock_shows_is_none() -> None:
    assert [clock.utc_date(unix_s) for unix_s in (0.0, -1e9, 1e12, 1e300, np.nan, np.inf)] == [None] * 6
