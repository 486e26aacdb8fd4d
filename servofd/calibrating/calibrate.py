"""From known-good flights to a calibrated aircraft."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from servofd.aircraft.schema import Aircraft
from servofd.calibrating.refusals import hardly_moved
from servofd.calibrating.result import Calibration
from servofd.calibrating.surface import calibrate_surface
from servofd.core.errors import CalibrationError
from servofd.core.evidence import ModelOrigin
from servofd.detection.cleared import is_blind

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from servofd.aircraft.schema import Surface
    from servofd.calibrating.flights import Flight
    from servofd.calibrating.result import CalibratedSurface


def calibrate_aircraft(
    aircraft: Aircraft,
    flights: Mapping[str, Sequence[Flight]],
    *,
    force: bool = False,
    progress: Callable[[str], None] = lambda _surface: None,
) -> Calibration:
    """Fit every surface of an aircraft to flights that are known to be good.

    Parameters
    ----------
    aircraft : Aircraft
        What is known so far; its servos may be rough drafts.
    flights : mapping of surface to Flights
        Surfaces without any stay as they are.
    force : bool
        Calibrate also where the loss of a third of travel and of two thirds of speed would not show.

    Examples
    --------
    >>> import numpy as np
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> from servofd.calibrating.flights import Flight
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.simulation.flight import simulate_flight
    >>> flown = simulate_flight(plain_aircraft(["rudder"], "s9254"), duration_s=30.0, seed=1, noise_deg=0.05)
    >>> segment = Segment("rudder", flown.time_s, flown.command_deg[:, 0], flown.time_s, flown.measured_deg[:, 0])
    >>> rough = plain_aircraft(["rudder"], "s9256")
    >>> calibrated = calibrate_aircraft(rough, {"rudder": [Flight("good.csv", segment)]})
    >>> calibrated.surfaces[0].held_out_rms_deg < 0.1
    True
    """
    kept = {name: "not asked for" for name in aircraft.surfaces if name not in flights}
    kept |= {name: "no measured deflection" for name, those in flights.items() if not those}
    for name, those in flights.items():
        reason = hardly_moved(those) if those else ""
        if reason:
            kept[name] = reason
    wanted = [name for name in aircraft.surfaces if name not in kept]
    if not wanted:
        raise CalibrationError("; ".join(f"{name}: {reason}" for name, reason in kept.items()))

    def one(name: str) -> CalibratedSurface | CalibrationError:
        try:
            return calibrate_surface(flights[name], aircraft)
        except CalibrationError as error:
            return error
        finally:
            progress(name)

    # The kernel runs without the interpreter's lock.
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        results = list(pool.map(one, wanted))
    wrong = [str(result) for result in results if isinstance(result, CalibrationError)]
    if wrong:
        raise CalibrationError("; ".join(wrong))
    found = [result for result in results if not isinstance(result, CalibrationError)]
    blind = {one.surface: _blind(one) for one in found if not force and is_blind(one.detectable)}
    kept |= blind
    found = [one for one in found if one.surface not in blind]
    if not found:
        raise CalibrationError("; ".join(f"{name}: {reason}" for name, reason in kept.items()))
    return Calibration(_with(aircraft, found), tuple(found), kept)


def _blind(one: CalibratedSurface) -> str:
    lost = one.detectable.loss_share
    least = "no loss of travel" if lost is None else f"no less than the loss of {lost:.0%} of its travel"
    return (
        f"would show {least}, and no servo at a third of its speed (threshold {one.threshold_deg:.2g} deg): move it "
        f"several times by ±{3.0 * one.threshold_deg:.0f} deg or more, fast, or mend its play or friction; --force "
        "calibrates it all the same"
    )


def _with(aircraft: Aircraft, found: Sequence[CalibratedSurface]) -> Aircraft:
    """The aircraft with new entries for what was calibrated."""
    surfaces = dict(aircraft.surfaces)
    servos = {}
    for one in found:
        name = f"{one.surface}-calibrated"
        surfaces[one.surface] = _entry(surfaces[one.surface], one, name)
        servos[name] = one.servo
    used = {surface.servo for surface in surfaces.values()}
    servos |= {name: servo for name, servo in aircraft.servos.items() if name in used and name not in servos}
    return Aircraft.model_validate(
        {"name": aircraft.name, "table": aircraft.table, "surfaces": surfaces, "servos": servos}
    )


def _entry(surface: Surface, one: CalibratedSurface, servo: str) -> Surface:
    return surface.model_copy(
        update={
            "servo": servo,
            "measured": one.measured,
            "threshold": "interval",
            "threshold_deg": one.threshold_deg,
            "tolerance": one.tolerance,
            "suspicions": True,
            "effects": {},
            "filter_pole_rad_s": None,
            "model": ModelOrigin(
                origin="calibrated",
                held_out_rms_deg=float(f"{one.held_out_rms_deg:.3g}"),
                explained_share=round(one.explained_share, 4),
            ),
            "calibrated": one.known,
        }
    )
