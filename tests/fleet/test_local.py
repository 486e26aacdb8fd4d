"""Processes side by side: none is missed, and one that dies takes nobody with it."""

from __future__ import annotations

import os

import pytest

from servofd.batch.local import WorkerDied, run_local

# Spawned processes import what they are to do: builtins are everywhere.
KILL = "__import__('os').kill(__import__('os').getpid(), 9)"
ABORT = "__import__('os').abort()"


def test_every_item_is_done_once_and_errors_stay_with_their_item() -> None:
    results = dict(run_local(eval, ["1 + 1", "1 / 0", "3 * 3"], workers=2))
    assert results["1 + 1"] == 2
    assert results["3 * 3"] == 9
    assert isinstance(results["1 / 0"], ZeroDivisionError)


@pytest.mark.slow
@pytest.mark.parametrize("death", [KILL, ABORT])
def test_only_the_item_that_kills_its_process_is_given_up(death: str) -> None:
    items = [str(k) for k in range(6)] + [death] + [str(k) for k in range(6, 12)]
    outcomes = list(run_local(eval, items, workers=2))
    assert sorted(item for item, _ in outcomes) == sorted(items)
    results = dict(outcomes)
    assert isinstance(results.pop(death), WorkerDied)
    assert results == {str(k): k for k in range(12)}


def test_processes_have_one_thread_for_linear_algebra_and_this_one_keeps_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    asked = "[__import__('os').environ[n] for n in ('OMP_NUM_THREADS', 'NUMBA_NUM_THREADS')]"
    assert list(run_local(eval, [asked], workers=1)) == [(asked, ["1", "1"])]
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "NUMBA_NUM_THREADS" not in os.environ


def test_nothing_to_do_needs_no_process() -> None:
    assert list(run_local(eval, [])) == []
