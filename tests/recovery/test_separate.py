"""The manoeuvre that is named really tells two fitted servos apart."""

from __future__ import annotations

import numpy as np
import pytest

from servofd.aircraft.series import Series
from servofd.discrepancy.adequacy import Adequacy
from servofd.discrepancy.fit import Fit, Fitter
from servofd.discrepancy.ladder import Step
from servofd.discrepancy.record import Record, record_of
from servofd.discrepancy.select import Selection
from servofd.discrepancy.separate import MANOEUVRES, separations
from servofd.servo.catalogue import effects_named, installed
from servofd.servo.effect import Effect
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel

NOISE_DEG = 0.1


@pytest.fixture(scope="module")
def record() -> Record:
    time_s = np.arange(0.0, 10.0, 0.01)
    segment = Series("x", time_s, np.sin(time_s), time_s, np.sin(time_s))
    return record_of(segment, ServoModel.of(servo_named("hs225bb-eq31")))


def tied(record: Record, *fits: Fit) -> Selection:
    fitter = Fitter(record)
    names = tuple(fit.names[0] for fit in fits)
    steps, found = (Step(fits[0], ()),), Adequacy(NOISE_DEG, ())
    return Selection(
        fitter.nominal(),
        steps,
        {names[0]: dict(zip(names[1:], fits[1:], strict=True))},
        (),
        np.zeros((1, 1)),
        fitter,
        fits[0],
        found,
    )


def fit(record: Record, effect: type[Effect], *values: float) -> Fit:
    fitter = Fitter(record)
    return fitter.judged((effect,), installed(record.model.physics, (effect,), list(values)))


@pytest.mark.parametrize(
    ("one", "two", "words"),
    [
        (("rate_limit", 60.0), ("slow_dynamics", 0.5), "step"),
        (("airload", 4e-4, 0.8), ("gain", 0.9), "from 12 to 30 m/s"),
        (("voltage_rate", 16.0), ("rate_limit", 96.0), "supply sags"),
        (("backlash", 1.0), ("gain", 0.9), "deg"),
    ],
)
def test_what_tells_two_effects_apart(
    record: Record, one: tuple[str, float], two: tuple[str, float], words: str
) -> None:
    fits = [fit(record, effects_named(name)[0], *values) for name, *values in (one, two)]
    (found,) = separations(tied(record, *fits))
    assert found.effects == (one[0], two[0])
    assert found.manoeuvre is not None
    assert words in found.manoeuvre
    assert found.sigmas == pytest.approx(found.difference_deg / NOISE_DEG)
    assert found.sigmas >= 4.0
    first, second = (name.replace("_", " ") for name, *_ in (one, two))
    assert f"tells {first} from {second} (differs by {found.sigmas:.0f} sigma)" in found.sentence


def test_what_nothing_tells_apart_is_said(record: Record) -> None:
    fits = [fit(record, effects_named("delay")[0], 0.024), fit(record, effects_named("clock_offset")[0], 0.02)]
    (found,) = separations(tied(record, *fits))
    assert found.manoeuvre is None
    assert found.difference_deg < 1e-6
    assert "no manoeuvre tells delay from clock offset" in found.sentence


def test_manoeuvres_stay_within_what_a_surface_can_do() -> None:
    time_s = np.arange(0.0, 24.0, 0.01)
    assert len({manoeuvre.name for manoeuvre in MANOEUVRES}) == len(MANOEUVRES)
    for manoeuvre in MANOEUVRES:
        command_deg = manoeuvre.command(time_s)
        assert command_deg.shape == time_s.shape
        assert 0.9 < np.abs(command_deg).max() <= 20.0 + 1e-9
