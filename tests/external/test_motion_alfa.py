"""A real aeroplane without position feedback, faults injected in flight; every day judged by a model of the others."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.external.test_bench_tables import DATA

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from motion_alfa import AXIS, flights_of, told

ALFA = DATA / "alfa"

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(
        not ALFA.is_dir(), reason="no ALFA tables: set SERVOFD_EXTERNAL_DATA to the folder that holds alfa/"
    ),
]


def test_surface_faults_are_found_on_days_the_model_has_not_seen() -> None:
    results = told(flights_of(ALFA))
    faulty = [one for one in results if one.kind in AXIS]
    assert sum(len(one.before) for one in results) <= 1
    assert sum(bool(one.after) for one in faulty) >= len(faulty) - 2
    assert all(one.after[0][0] == AXIS[one.kind] for one in faulty if one.after)
    assert sum(bool(one.after) for one in results if one.kind == "engine") <= 3
    assert all(one.delay_s is not None and one.delay_s <= 1.5 for one in faulty if one.kind == "rudder")
