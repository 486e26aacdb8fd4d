"""What a script on board needs to know of each surface: plain numbers, taken from the aircraft file.

The script simulates the linear servo with its delay, its rate limit and its stops. Effects of a servo beyond these it
does not know: those that leave the surface within a known width make its threshold higher by that width; a surface with
any other effect is left out, and `OnboardPlan.notes` says so.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.calibration import DegreeCalibration, PulseCalibration, RadianCalibration
from servofd.aircraft.names import short_names
from servofd.aircraft.outputs import COMMANDS_OF_SERVO, POSITIONS_FROM_0, POSITIONS_FROM_1, output_of
from servofd.core.errors import ConfigError, DesignError
from servofd.detection.residual import ResidualGenerator
from servofd.detection.threshold import Evaluation
from servofd.servo.physics import Physics

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft.schema import Aircraft, Surface
    from servofd.core.types import FloatArray
    from servofd.servo.servo_model import ServoModel

LONGEST_NAME = 21
"""With " not moved by sticks" it fills the 41 characters that ArduPilot keeps of a reason to refuse arming
(``AP_Arming::aux_auth_str_len`` less the end of the string, which it does not set itself)."""
_SAME_POLE = 4e-3
"""Poles closer than this share are moved that far apart: half the digits of a 32-bit number, as the error of moving
grows with the square of the distance and that of rounding with its inverse."""
_MOST_CANCELLATION = 400.0
"""Sum of the modes' weights, and of the filter's: 32-bit numbers then keep 1e-3 deg of a deflection of 40 deg."""
_CENTRE_US = 1500.0
"""Pulse width of a neutral servo, from which pulses are counted [us]."""
_WIDTHS = {"deadband_deg": 0.5, "insensitive_deg": 0.5, "backlash_deg": 0.5, "friction_deg": 1.0}
_WIDTHS |= {"command_step_deg": 0.5, "output_step_deg": 0.5}
_KNOWN = frozenset(
    {
        *("delay_s", "bandwidth_scale", "damping_scale", "torque_share", "rate_up_deg_s", "rate_down_deg_s"),
        *("follow_up_deg_s", "follow_down_deg_s", "lower_deg", "upper_deg", "gain", "bias_deg", "lag_s", "offset_s"),
        *("frame_s", "frame_phase", "resonance_damping"),
    }
)
"""What the script does as well, and what has no meaning without another effect."""
_SHORTEST_CALL_MS = 5
"""Between two calls; less is less than a main loop of 300 Hz leaves for scripts."""
_CALL_COST, _SURFACE_COST, _MODE_COST, _ORDER_COST = 270, 1150, 170, 200
"""Instructions of a call, and of each surface, mode and order of its servo in it (``benchmarks/onboard.py``)."""
_RATE_COST, _RATE_MODE_COST = 700, 190
"""Instructions more, and for each mode more, while the servo runs at its rate limit. All are the most that
``benchmarks/onboard.py`` counted, in calls in which a glitch is sorted out, for servos of one to three poles (within
60 of the sum)."""


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode of the linear servo, as `servofd.servo.transfer.Modes` has it."""

    decay_rad_s: float
    turn_rad_s: float
    weight: float
    weight_turn: float


@dataclass(frozen=True, slots=True)
class OnboardSurface:
    """One surface; angles in degrees of deflection."""

    name: str
    """As its texts show it."""
    surface: str
    """As the aircraft file names it."""
    output: int
    """Number of the autopilot's output, from 1."""
    from_servo: bool
    """Whether the command is the one that the servo repeats [deg], not the pulse on the output [us - 1500]."""
    command: tuple[float, float, float, float]
    """Polynomial that makes a deflection of it, lowest power first."""
    position: tuple[float, float]
    """Scale and offset of the position [deg]."""
    saturation_deg: tuple[float, float] | None
    stops_deg: tuple[float, float] | None
    delay_s: float
    modes: tuple[Mode, ...]
    dc_gain: float
    """Of the linear servo, before its linkage."""
    rates_deg_s: tuple[float, float] | None
    """Up and down; None without a limit."""
    weak_rate_deg_s: float
    """The same of the slowest servo that counts as healthy."""
    filter_pole_rad_s: float
    longest_gap_s: float
    threshold_deg: float | None
    """None: it follows the activity of the command, within the tolerances."""
    tolerances: tuple[float, float, float, float]
    """Of gain, delay [s], lags and bias [deg]."""
    noise_deg: float
    noise_gain: float
    sigmas: float
    persistence: int

    @property
    def instructions(self) -> int:
        """Of Lua's virtual machine in a call that judges this surface, at most."""
        modes = len(self.modes)
        order = sum(1 if mode.turn_rad_s == 0.0 else 2 for mode in self.modes)
        limited = _RATE_COST + modes * _RATE_MODE_COST if self.rates_deg_s else 0
        return _SURFACE_COST + modes * _MODE_COST + order * _ORDER_COST + limited


@dataclass(frozen=True, slots=True)
class OnboardPlan:
    """All surfaces of a script."""

    aircraft: str
    surfaces: tuple[OnboardSurface, ...]
    period_ms: int
    turns: int
    """In how many calls all surfaces are judged, some of them in each."""
    notes: tuple[str, ...] = ()
    """What the script will not do, for the user."""
    table_key: int = 161
    """Of the parameters; any number from 0 to 200 that no other script uses (those in ArduPilot 4.7 have some of
    7 to 117, 135 to 139, and 193: the example ``qnh_alt.lua`` has 93)."""

    @property
    def instructions(self) -> int:
        """Of the longest call, at most."""
        return _in_turns(self.surfaces, self.turns)


def plan_onboard(
    aircraft: Aircraft, surfaces: Sequence[str] = (), *, rate_hz: float = 50.0, instructions: int = 10_000
) -> OnboardPlan:
    """Take from an aircraft what a script on board needs.

    Parameters
    ----------
    surfaces : sequence of str
        Which to watch; all that can be if empty.
    instructions : int
        Of Lua's virtual machine, that the autopilot gives a call (``SCR_VM_I_COUNT``).

    Examples
    --------
    >>> from servofd.aircraft.schema import load_aircraft
    >>> [(surface.name, surface.output) for surface in plan_onboard(load_aircraft("simulated")).surfaces]
    [('AILERON', 1), ('ELEVATOR', 2), ('RUDDER', 4)]
    """
    aircraft.check_names(surfaces)
    if not 10.0 <= rate_hz <= 200.0:
        raise ConfigError(f"a script cannot look {rate_hz:g} times a second: 10 to 200 Hz work")
    period_ms = round(1e3 / rate_hz)
    wanted = surfaces or tuple(aircraft.surfaces)
    planned, notes = [], []
    for name, short in short_names(wanted, LONGEST_NAME).items():
        try:
            planned.append(_planned(aircraft, name, short, period_ms / 1e3))
        except (ConfigError, DesignError) as error:
            if surfaces:
                raise ConfigError(f"{name}: {error}") from None
            notes.append(f"{name} is not watched on board: {error}")
            continue
        notes += _losses(aircraft, name)
    if not planned:
        raise ConfigError("; ".join(notes))
    turns = _turns(planned, period_ms, instructions)
    if turns == 0:
        count = next((n for n in range(len(planned), 0, -1) if _turns(planned[:n], period_ms, instructions)), 0)
        raise ConfigError(
            f"{len(planned)} surfaces are more than a script has time for at {rate_hz:g} Hz and {instructions} "
            f"instructions a call: {count} are not; choose them with -s, or raise SCR_VM_I_COUNT and say so with "
            "--instructions"
        )
    taken = [one.output for one in planned]
    twice = {output for output in taken if taken.count(output) > 1}
    if twice:
        raise ConfigError(f"two surfaces on output {min(twice)}: choose one with -s")
    return OnboardPlan(aircraft.name, tuple(planned), period_ms, turns, tuple(notes))


def outputs_of(aircraft: Aircraft, surfaces: Sequence[str] = ()) -> list[int]:
    """Outputs of the surfaces that have a position, rising; of all surfaces if none is named."""
    found = set()
    aircraft.check_names(surfaces)
    for name in surfaces or aircraft.surfaces:
        if aircraft.surfaces[name].measured is not None:
            found.add(_output(aircraft.surfaces[name]))
    if not found:
        raise ConfigError("the aircraft file names no measured channel for any surface: there is nothing to send")
    return sorted(found)


def _planned(aircraft: Aircraft, name: str, short: str, period_s: float) -> OnboardSurface:
    surface, model = aircraft.surfaces[name], aircraft.model(name)
    if surface.measured is None:
        raise ConfigError("the aircraft file names no measured channel for it")
    output = _output(surface)
    physics = model.physics
    strange = _beyond(physics)
    if strange:
        raise ConfigError(f"its servo has {', '.join(strange)}, which the script cannot simulate")
    generator = ResidualGenerator.fitting_pace(model, period_s, surface.filter_pole_rad_s)
    evaluation = Evaluation(generator, surface.tolerances, period_s)
    gain = physics.gain
    modes = _modes(model, gain)
    if _cancellation(modes, generator, period_s) > _MOST_CANCELLATION:
        raise DesignError("its servo model loses all digits of a 32-bit number: use a model of lower order")
    limit = (
        min(physics.follow_up_deg_s, physics.rate_up_deg_s),
        min(physics.follow_down_deg_s, physics.rate_down_deg_s),
    )
    weak = (1.0 - surface.tolerances.rate) * min(limit)
    scale, offset_deg = _straight(surface)
    width_deg = sum(share * getattr(physics, field) for field, share in _WIDTHS.items())
    tolerated = [float(value) for value in evaluation.tolerated]
    return OnboardSurface(
        name=short,
        surface=name,
        output=output,
        from_servo=COMMANDS_OF_SERVO.fullmatch(surface.command.channel) is not None,
        command=_polynomial(surface),
        position=(scale, offset_deg - physics.bias_deg),
        saturation_deg=surface.command_saturation_deg,
        stops_deg=(physics.lower_deg, physics.upper_deg)
        if math.isfinite(physics.upper_deg - physics.lower_deg)
        else None,
        delay_s=physics.delay_s + physics.lag_s + physics.offset_s + 0.5 * physics.frame_s,
        modes=modes,
        dc_gain=model.transfer.dc_gain,
        rates_deg_s=(gain * limit[0], gain * limit[1]) if math.isfinite(min(limit)) else None,
        weak_rate_deg_s=gain * weak,
        filter_pole_rad_s=generator.pole_rad_s,
        longest_gap_s=generator.longest_gap_s_at(period_s),
        threshold_deg=surface.threshold_deg + width_deg if surface.threshold == "constant" else None,
        tolerances=(tolerated[0], tolerated[1], tolerated[2], tolerated[3] + width_deg),
        noise_deg=max(surface.tolerances.noise_deg, 1e-3),
        noise_gain=float(evaluation.noise_gain),
        sigmas=surface.threshold_sigmas,
        persistence=surface.persistence,
    )


def _output(surface: Surface) -> int:
    output = output_of(surface)
    if surface.command.channel.startswith("actuator_"):
        raise ConfigError("PX4 runs no scripts: watch it with `servofd monitor`")
    if output is None or not 1 <= output <= 32:
        raise ConfigError(
            f"command channel {surface.command.channel!r} names no output of an ArduPilot (RCOU.C1, "
            "SERVO_OUTPUT_RAW.servo1_raw or CSRV[0].PosCmd would)"
        )
    return output


def _beyond(physics: Physics) -> list[str]:
    """Effects of a servo that the script can neither simulate nor allow for."""
    return [field.removesuffix("_deg") for field, _ in physics if field not in _KNOWN and field not in _WIDTHS]


def _losses(aircraft: Aircraft, name: str) -> list[str]:
    """What of a surface's model the script leaves out."""
    surface, physics, lost = aircraft.surfaces[name], aircraft.model(name).physics, []
    if surface.tolerance is None:
        lost.append(
            f"{name} is not calibrated: the script alarms at a constant {surface.threshold_deg:g} deg; "
            "`servofd calibrate` of good flights makes that follow the command, down to the noise at rest"
            if surface.threshold == "constant"
            else f"{name} is not calibrated: its threshold is that of a fleet of HS-225BB"
        )
    widths = {field: share * getattr(physics, field) for field, share in _WIDTHS.items()}
    wide = [field.removesuffix("_deg").replace("_", " ") for field, width in widths.items() if width > 0.0]
    if wide:
        lost.append(f"{name}: threshold {sum(widths.values()):.2g} deg higher, for {' and '.join(wide)}")
    return lost


def _in_turns(surfaces: Sequence[OnboardSurface], turns: int) -> int:
    """Instructions of the longest call."""
    shares = [sum(surface.instructions for surface in surfaces[first::turns]) for first in range(turns)]
    return _CALL_COST + max(shares)


def _turns(surfaces: Sequence[OnboardSurface], period_ms: int, instructions: int) -> int:
    """Into how few calls the surfaces have to be shared out, 0 if no number will do."""
    possible = [n for n in (1, 2, 4, 5) if period_ms % n == 0 and (n == 1 or period_ms // n >= _SHORTEST_CALL_MS)]
    return next((n for n in possible if _in_turns(surfaces, n) <= instructions), 0)


def _straight(surface: Surface) -> tuple[float, float]:
    """Scale and offset that make a deflection of what `servo_telem` measures [deg]."""
    measured = surface.measured
    if not isinstance(measured, DegreeCalibration | RadianCalibration) or not (
        POSITIONS_FROM_0.fullmatch(measured.channel) or POSITIONS_FROM_1.fullmatch(measured.channel)
    ):
        raise ConfigError(
            f"position channel {measured.channel if measured else ''!r} is none that ArduPilot has on board "
            "(CSRV[0].Pos or NAMED_VALUE_FLOAT[SRVP1].value are)"
        )
    raw = np.array([0.0, 1.0])
    zero, one = measured.to_deg(raw if isinstance(measured, DegreeCalibration) else np.radians(raw)).tolist()
    return one - zero, zero


def _polynomial(surface: Surface) -> tuple[float, float, float, float]:
    """Deflection [deg] from the pulse less 1500 us, or from the command that the servo repeats [deg]."""
    command, centre = surface.command, _CENTRE_US
    if isinstance(command, DegreeCalibration) and COMMANDS_OF_SERVO.fullmatch(command.channel):
        centre = 0.0
    elif not isinstance(command, PulseCalibration):
        raise ConfigError(f'command channel {command.channel!r} is no pulse width of an output (unit = "us")')
    zero, one = command.to_deg(centre + np.array([0.0, 1.0])).tolist()
    if not isinstance(command, PulseCalibration) or command.cubic_deg is None:
        return zero, one - zero, 0.0, 0.0
    at = np.array([-600.0, -200.0, 200.0, 600.0])
    fitted = np.polynomial.polynomial.polyfit(at / 600.0, command.to_deg(centre + at), 3) / 600.0 ** np.arange(4)
    constant, slope, square, cubic = fitted.tolist()
    return constant, slope, square, cubic


def _modes(model: ServoModel, gain: float) -> tuple[Mode, ...]:
    """Modes of the linear servo times the gain of its linkage, none too close to another for 32-bit numbers."""
    from servofd.servo.transfer import TransferFunction

    transfer = model.transfer
    poles = transfer.poles_rad_s
    order = np.argsort(poles.real)
    for first, second in itertools.pairwise(order):
        size = abs(poles[first])
        if abs(poles[first] - poles[second]) <= _SAME_POLE * size:
            middle = float(0.5 * (poles[first] + poles[second]).real)
            poles[first], poles[second] = middle * (1.0 + _SAME_POLE), middle * (1.0 - _SAME_POLE)
    denominator = np.real(np.poly(poles))
    scale = transfer.dc_gain * denominator[-1] / transfer.numerator[-1]
    apart = TransferFunction(tuple(scale * c for c in transfer.numerator), tuple(denominator.tolist()))
    modes = apart.modes()
    return tuple(
        Mode(float(a.real), float(a.imag), gain * float(w.real), gain * float(w.imag))
        for a, w in zip(modes.decay_rad_s, modes.weight, strict=True)
    )


def _cancellation(modes: tuple[Mode, ...], generator: ResidualGenerator, period_s: float) -> float:
    """How many times larger than the result the terms are that it is the sum of."""
    from servofd.detection.residual import lag_weights

    weights: FloatArray = lag_weights(generator.filter_parameters(), period_s)
    total = sum(math.hypot(mode.weight, mode.weight_turn) for mode in modes) / abs(sum(mode.weight for mode in modes))
    return max(total, float(np.abs(weights).sum()) * abs(generator.model.transfer.dc_gain))
