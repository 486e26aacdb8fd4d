"""Simulated flights: an aircraft's servos under a command sequence, healthy or with faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from servofd.aircraft.schema import Aircraft
from servofd.core.errors import ConfigError, UnknownName, suggest
from servofd.core.series import latest
from servofd.core.types import FloatArray, IntArray
from servofd.servo.context import NO_CONTEXT, Context
from servofd.servo.effect import Effect
from servofd.servo.faults import Failure, as_received, failing_deflection, in_order
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import COMMANDS, FORMER_NAMES
from servofd.simulation.pulses import Output
from servofd.simulation.surroundings import acting, current_a


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFlight:
    """What a log of the flight would hold, in degrees of surface deflection."""

    surfaces: tuple[str, ...]
    time_s: FloatArray
    """Of shape (n,)."""
    command_deg: FloatArray
    """Of shape (n, s)."""
    measured_deg: FloatArray
    """Of shape (n, s)."""
    received_deg: FloatArray
    """What the servos made of the commands, an offset or a loss for instance, of shape (n, s)."""
    outputs: tuple[Output, ...] = ()
    """Of an autopilot, one for each surface; empty if the servos were commanded in degrees."""
    pulse_us: IntArray = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int64))
    """Pulses that were sent [us], of shape (n, s); `command_deg` is what they asked for. Empty without outputs."""
    seed: int = 0
    """What the flight was drawn from; whatever a log adds to it is drawn from that too."""
    context: Context = NO_CONTEXT
    """What its servos felt of the air and their supply; empty if none depends on it."""


def simulate_flight(
    aircraft: Aircraft,
    *,
    command: str = "flight",
    duration_s: float = 60.0,
    rate_hz: float = 100.0,
    seed: int = 0,
    faults: Mapping[str, Failure | Sequence[Failure]] | None = None,
    effects: Mapping[str, Sequence[Effect]] | None = None,
    noise_deg: float = 0.1,
    outputs: Sequence[Output] = (),
) -> SimulatedFlight:
    """Fly all surfaces of an aircraft.

    Parameters
    ----------
    aircraft : Aircraft
        Its surfaces and servos.
    command : str
        One of `servofd.simulation.commands.COMMANDS`; each surface gets its own variation.
    duration_s, rate_hz : float
        Length [s] and sample rate [Hz].
    seed : int
        The same seed gives the same flight.
    faults : mapping of surface to one or several Faults, optional
        What fails; on one surface one after the other.
    effects : mapping of surface to effects, optional
        What the servo has beyond its description.
    noise_deg : float
        Standard deviation of white noise on the measured deflection [deg].
    outputs : sequence of Output
        Of the autopilot that commands the servos, in the order of the surfaces: what a servo receives is the pulse,
        a whole number of microseconds, and times are whole microseconds too, from one period after 0 s. Without them
        a servo receives degrees, and saturates them after they were logged.

    Raises
    ------
    UnknownName
        If a surface or the command does not exist.
    ConfigError
        If duration, rate or noise make no sense, faults of one surface overlap, or the outputs are not those of the
        surfaces.

    Examples
    --------
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> from servofd.servo.faults import Stuck
    >>> flown = simulate_flight(plain_aircraft(["rudder"], "hs225bb-eq31"), duration_s=20.0, noise_deg=0.0,
    ...                         faults={"rudder": Stuck(10.0)})
    >>> bool(np.ptp(flown.measured_deg[1001:, 0]) == 0.0)
    True
    """
    command = FORMER_NAMES.get(command, command)
    if command not in COMMANDS:
        raise UnknownName(suggest("command", command, COMMANDS))
    aircraft.check_names([*(faults or {}), *(effects or {})])
    if not (0.0 < rate_hz <= 10_000.0 and 2.0 <= duration_s * rate_hz <= 1e8 and 0.0 <= noise_deg < 1e3):
        raise ConfigError(
            f"cannot simulate {duration_s} s at {rate_hz} Hz with {noise_deg} deg of noise: "
            "give a positive duration, a rate of at most 10000 Hz and a noise of zero or more"
        )
    if outputs and [output.surface for output in outputs] != list(aircraft.surfaces):
        raise ConfigError(f"outputs of {', '.join(o.surface for o in outputs)}: give one for each surface, in order")
    failing = {name: in_order([what] if isinstance(what, Failure) else what) for name, what in (faults or {}).items()}
    samples = np.arange(round(duration_s * rate_hz))
    # An autopilot stamps with 0 what it does not know the time of: its first sample is one period after it booted.
    time_s = np.round((samples + 1) / rate_hz, 6) if outputs else np.round(samples / rate_hz, 9)
    models = {name: aircraft.model(name) for name in aircraft.surfaces}
    for name, further in (effects or {}).items():
        for effect in further:
            models[name] = models[name] + effect
    needs = frozenset().union(*(model.physics.needs for model in models.values()))
    context = acting(time_s, pushed="servo_load" in needs) if needs else NO_CONTEXT
    commanded, received, moved, noise, pulses = [], [], [], [], []
    for index, (name, surface) in enumerate(aircraft.surfaces.items()):
        rng = np.random.default_rng([seed, index])
        asked_deg = COMMANDS[command](time_s, rng)
        received_deg = np.clip(asked_deg, *(surface.command_saturation_deg or (-np.inf, np.inf)))
        if outputs:
            pulses.append(outputs[index].pulse_us(received_deg))
            asked_deg = received_deg = outputs[index].deflection_deg(pulses[-1])
        what = failing.get(name, ())
        moved.append(failing_deflection(models[name], what, time_s, received_deg, time_s, context))
        received.append(_meant_deg(what, time_s, received_deg, moved[-1]))
        commanded.append(asked_deg)
        noise.append(noise_deg * rng.standard_normal(time_s.size))
    deflection_deg = np.column_stack(moved)
    context = _with_current(context, models, time_s, deflection_deg, seed)
    read_deg = np.column_stack([context.drawn_a(time_s) * model.physics.deg_per_a for model in models.values()])
    return SimulatedFlight(
        tuple(aircraft.surfaces),
        time_s,
        np.column_stack(commanded),
        deflection_deg + read_deg + np.column_stack(noise),
        np.column_stack(received),
        tuple(outputs),
        np.column_stack(pulses) if pulses else np.zeros((0, 0), dtype=np.int64),
        seed,
        context,
    )


def _meant_deg(
    faults: Sequence[Failure], time_s: FloatArray, received_deg: FloatArray, moved_deg: FloatArray
) -> FloatArray:
    """Where the motor of a servo wants to be: as it takes its command, or wherever it is where nothing holds it."""
    meant_deg = latest(*as_received(faults, time_s, received_deg), time_s)
    for fault in (each for each in faults if not each.pushes):
        loose = (time_s >= fault.start_s) & (time_s < fault.end_s)
        meant_deg[loose] = moved_deg[loose]
    return meant_deg


def _with_current(
    context: Context, models: Mapping[str, ServoModel], time_s: FloatArray, deflection_deg: FloatArray, seed: int
) -> Context:
    """With what all servos draw together, if a reading depends on it: they share one supply."""
    if not any("servo_current_a" in model.physics.needs for model in models.values()):
        return context
    rng = np.random.default_rng([seed, 1002])
    drawn_a = [current_a(np.gradient(each, time_s), rng) for each in deflection_deg.T]
    return replace(context, current_s=time_s, current_a=np.sum(drawn_a, axis=0))
