"""A flight with known truth, as the verb and its function ask for it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from servofd.aircraft.schema import UNKNOWN_SERVO, Aircraft, load_aircraft, plain_aircraft
from servofd.core.errors import ConfigError
from servofd.feedback.flown import known_aircraft
from servofd.servo.library import servo_named
from servofd.simulation.flight import SimulatedFlight, simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.words import effects_of, faults_of
from servofd.simulation.writers import write_flight, writer_for

_SURFACES = ("elevator", "aileron", "rudder")
_USUAL_HZ, _USUAL_S = 100.0, 60.0
"""Rate [Hz] and duration [s] of a simulated flight, unless others are asked for."""


def aircraft_to_fly(
    aircraft: Aircraft | str | Path | None = None, servo: str | None = None, output: str | Path | None = None
) -> Aircraft:
    """An aircraft, its file, or the usual one of a format; all its surfaces with `servo` if that is named."""
    known = known_aircraft(aircraft)
    if known is None and output is not None and Path(output).suffix.lower() == ".mat":
        known = load_aircraft("faser")
    if known is None:
        known = plain_aircraft(_SURFACES, next(iter(load_aircraft("simulated").surfaces.values())).servo)
    if servo in (None, UNKNOWN_SERVO):
        return known
    servo_named(servo)
    return known.with_servo(servo)


def simulate(
    output: str | Path | None = None,
    aircraft: Aircraft | str | Path | None = None,
    *,
    servo: str | None = None,
    command: str = "flight",
    duration_s: float = _USUAL_S,
    rate_hz: float | None = None,
    seed: int = 0,
    fault: str | Sequence[str] = (),
    effect: str | Sequence[str] = (),
    noise_deg: float = 0.1,
    generation: str | None = None,
    pulses: bool = False,
) -> SimulatedFlight:
    """Fly an aircraft, and write its log if `output` names a file.

    Parameters
    ----------
    output : str or Path, optional
        Log to write, in the format of its suffix.
    aircraft : Aircraft, str or Path, optional
        An aircraft, its file, or the name of one that comes with servofd; three surfaces of one servo if left out.
    servo : str, optional
        Of all surfaces: a name of the library; that of the aircraft if left out.
    command : str
        One of `servofd.simulation.commands.COMMANDS`.
    duration_s, rate_hz : float
        Length [s], and sample rate [Hz]; the usual one of the format if None.
    seed : int
        The same seed gives the same flight.
    fault, effect : str or sequence of str
        Such as ``"elevator:stuck@30"``, ``"elevator:delay:delay_s=0.02"``.
    noise_deg : float
        Standard deviation of white noise on the measured deflection [deg].
    generation : str, optional
        Of the servo telemetry in a ``.bin``.
    pulses : bool
        Whether an autopilot commands the servos also where no file is written.

    Raises
    ------
    ConfigError, UnknownName
        If something asked for does not exist, or makes no sense.

    Examples
    --------
    >>> made = simulate(duration_s=2.0, fault="rudder:stuck@1")
    >>> made.surfaces, made.time_s.size
    (('elevator', 'aileron', 'rudder'), 200)
    """
    writer = None if output is None else writer_for(output, generation)
    if seed < 0:
        raise ConfigError(f"--seed {seed}: give a whole number of zero or more")
    known = aircraft_to_fly(aircraft, servo, output)
    faults, effects = ((texts,) if isinstance(texts, str) else texts for texts in (fault, effect))
    if rate_hz is None:
        rate_hz = writer.rate_hz if writer else _USUAL_HZ
    flown = simulate_flight(
        known,
        command=command,
        duration_s=duration_s,
        rate_hz=rate_hz,
        seed=seed,
        faults=faults_of(faults, duration_s),
        effects=effects_of(effects),
        noise_deg=noise_deg,
        outputs=outputs_of(known) if pulses or (writer is not None and writer.pulses) else (),
    )
    if output is not None:
        write_flight(output, flown, known, generation=generation)
    return flown
