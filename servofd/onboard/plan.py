"""What a script on board needs to know of each surface: plain numbers, taken from the aircraft file.

The script simulates the linear servo with its delay, its rate limit and its stops, and compares what is left with what
good servos leave: the covariance by which the audit judges, as far as it shows in six signals that the script has
(an offset, the deflection, its rate, two high passes of it, and what a slower motor leaves). What the script's servo
does otherwise than the audit's adds to that; a surface with an effect that the script can neither simulate nor allow
for is left out, and `OnboardPlan.notes` says so.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from logparsers.units import US_PER_S
from servofd.aircraft.calibrated import CalibratedServo
from servofd.aircraft.calibration import DegreeCalibration, PulseCalibration, RadianCalibration
from servofd.aircraft.names import short_names
from servofd.aircraft.outputs import COMMANDS_OF_SERVO, POSITIONS_FROM_0, POSITIONS_FROM_1, output_of
from servofd.aircraft.schema import Aircraft, Surface
from servofd.core.errors import ConfigError, DesignError
from servofd.core.types import FloatArray
from servofd.detection.changes import thresholds_of
from servofd.detection.named import named_servo
from servofd.estimate.family import REACH_DEG, new_state, sensitivities, simulated, variants
from servofd.estimate.record import load_at
from servofd.servo.physics import Physics
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction

Setting = float | tuple[float, ...] | None
"""Of a surface in the script; None is left out."""
LONGEST_NAME = 21
"""With " not moved by sticks" it fills the 41 characters that ArduPilot keeps of a reason to refuse arming
(``AP_Arming::aux_auth_str_len`` less the end of the string, which it does not set itself)."""
_SAME_POLE = 4e-3
"""Poles closer than this share are moved that far apart: half the digits of a 32-bit number, as the error of moving
grows with the square of the distance and that of rounding with its inverse."""
_MOST_CANCELLATION = 400.0
"""Sum of the modes' weights: 32-bit numbers then keep 1e-3 deg of a deflection of 40 deg."""
_SLOWER = 0.1
"""Share by which the motor is slower of which the script tells what a lower rate limit would leave."""
_TRIED_S, _TRIED_HZ = 40.0, 3.0
"""Length of the commands on which a servo's covariance is worked out, and the highest frequency of their chirp [Hz]."""
_TRIED_STEP_S = 0.02
"""Between two samples of them."""
_ALIKE = 1e-6
"""Share below which signals are the same one."""
_SIGNALS = 6
"""Onto which the covariance of a servo is laid."""
_MODE_NUMBERS = 4
"""Of a mode, in the script."""
_PERSISTENCE = 3
"""Residuals in a row on one side of an alarm at least: a glitch lasts for two."""
_NEVER = 1e9
"""Limit of an energy that none reaches."""
_CENTRE_US = 1500.0
"""Pulse of a surface in its middle, by ArduPilot's convention, from which pulses are counted [us]."""
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
_CALL_COST, _SURFACE_COST, _MODE_COST = 310, 850, 100
"""Instructions of a call, and of each surface and mode of its servo in it (``benchmarks/onboard.py``)."""
_RATE_COST, _RATE_MODE_COST = 170, 130
"""Instructions more, and for each mode more, of a servo with a rate limit: 4 to 20 % above what
``benchmarks/onboard.py`` counted."""
_OWN_BYTES: Final = 15_000
"""Memory of ArduPilot's own tables: half of the 27 kB that a script of one line needs in the loop, with 64 bits."""
_READ_BYTES, _READ_SURFACE_BYTES = 47_200, 600
"""Memory that a script takes while it is read, with numbers and pointers of 32 bits, and each of its surfaces;"""
_BEGUN_BYTES, _BEGUN_SURFACE_BYTES = 36_000, 3_400
"""and while it begins (``benchmarks/onboard.py SOURCES``: 47.7, 48.8, 56.0 and 76.0 kB for 1, 3, 6 and 12 surfaces of
different servos of three poles)."""


@dataclass(frozen=True, slots=True)
class OnboardSurface:
    """One surface; angles in degrees of deflection."""

    name: str
    """As its texts show it."""
    surface: str
    """As the aircraft file names it."""
    output: int
    """Number of the autopilot's output, from 1."""
    settings: tuple[dict[str, Setting], ...]
    """What the script knows of how it is wired, of its servo, and of how far good ones differ; a line each."""

    @property
    def instructions(self) -> int:
        """Of Lua's virtual machine in a call that judges this surface, at most."""
        servo = self.settings[1]
        modes = len(servo["modes"]) // _MODE_NUMBERS  # type: ignore[arg-type]
        limited = _RATE_COST + modes * _RATE_MODE_COST if servo["rates"] else 0
        return _SURFACE_COST + modes * _MODE_COST + limited


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

    @property
    def heap_bytes(self) -> int:
        """``SCR_HEAP_SIZE`` that an autopilot needs for this script alone."""
        count = len(self.surfaces)
        script = max(_READ_BYTES + count * _READ_SURFACE_BYTES, _BEGUN_BYTES + count * _BEGUN_SURFACE_BYTES)
        return 1_000 * math.ceil((_OWN_BYTES + script) / 1_000)


def plan_onboard(
    aircraft: Aircraft, surfaces: Sequence[str] = (), *, rate_hz: float = 50.0, instructions: int = 10_000
) -> OnboardPlan:
    """Take from an aircraft what a script on board needs.

    `surfaces`: which to watch; all that can be if empty. `instructions`: of Lua's virtual machine, that the autopilot
    gives a call (``SCR_VM_I_COUNT``).

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
    """Outputs of the surfaces that have a position or a known current, rising; of all surfaces if none is named."""
    found = set()
    aircraft.check_names(surfaces)
    for name in surfaces or aircraft.surfaces:
        if aircraft.surfaces[name].measured is not None or aircraft.surfaces[name].is_told_by_current:
            found.add(_output(aircraft.surfaces[name]))
    if not found:
        raise ConfigError("the aircraft file names no measured channel for any surface: there is nothing to send")
    return sorted(found)


def _planned(aircraft: Aircraft, name: str, short: str, period_s: float) -> OnboardSurface:
    surface = aircraft.surfaces[name]
    if surface.is_told_by_current:
        raise ConfigError(
            "it has a current and no position: --stream-only sends that, and 'servofd monitor' watches it"
        )
    model = aircraft.model(name)
    if surface.measured is None:
        raise ConfigError("the aircraft file names no measured channel for it")
    output = _output(surface)
    physics = model.physics
    strange = [field.removesuffix("_deg") for field, _ in physics if field not in _KNOWN and field not in _WIDTHS]
    if strange:
        raise ConfigError(f"its servo has {', '.join(strange)}, which the script cannot simulate")
    known, named = surface.calibrated, None
    gain, bias_deg = physics.gain, physics.bias_deg
    if known is None:
        known = named_servo(model, surface.tolerances, period_s)
        named = model.with_physics(physics._replace(bias_deg=0.0))
    else:
        gain, bias_deg = gain * known.parameters["gain"], bias_deg + known.offset_deg
    modes = _modes(model, gain)
    if sum(map(math.hypot, modes[2::_MODE_NUMBERS], modes[3::_MODE_NUMBERS])) > _MOST_CANCELLATION * abs(gain):
        raise DesignError("its servo model loses all digits of a 32-bit number: use a model of lower order")
    limit, slowest = model.rates_deg_s, min(model.rates_deg_s)
    scale, offset_deg = _straight(surface)
    delay_s = physics.delay_s + physics.lag_s + physics.offset_s + 0.5 * physics.frame_s
    on_board = ServoModel(
        model.transfer, Physics(gain=gain, delay_s=delay_s, follow_up_deg_s=limit[0], follow_down_deg_s=limit[1])
    )
    stops, constant = model.stops_deg, surface.threshold == "constant"
    limits = thresholds_of(known)
    zero, slope, square, cubic = _polynomial(surface)
    width_deg = _width_deg(physics)
    wired: dict[str, Setting] = {
        "gain": slope,
        "offset": zero,
        "curve": (square, cubic) if square or cubic else None,
        "bounds": surface.command_saturation_deg,
        "sense": scale,
        "zero": offset_deg - bias_deg,
        "telemetry": 1 if COMMANDS_OF_SERVO.fullmatch(surface.command.channel) else None,
    }
    servo: dict[str, Setting] = {
        "delay_us": round(US_PER_S * delay_s),
        "dc_gain": gain * model.transfer.dc_gain,
        "lag": -float(np.sum(1.0 / model.transfer.poles_rad_s).real),
        "rates": tuple(gain * one for one in (*limit, (1.0 - _SLOWER) * slowest)) if math.isfinite(slowest) else None,
        "stops": stops if math.isfinite(stops[1] - stops[0]) else None,
        "modes": modes,
    }
    doubt: dict[str, Setting] = {
        "noise": known.noise.still_deg,
        "jitter": 0.0 if constant else known.noise.lag_s,
        "limit": 1.0 if constant else float(limits[0]),
        "energies": (_NEVER, _NEVER) if constant else (float(limits[1]), float(limits[2])),
        "persistence": max(surface.persistence, _PERSISTENCE),
        "doubt": _constant_doubt(surface.threshold_deg + width_deg) if constant else _doubt(known, on_board, named),
    }
    return OnboardSurface(short, name, output, (wired, servo, doubt))


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


def _losses(aircraft: Aircraft, name: str) -> list[str]:
    """What of a surface's model the script leaves out."""
    surface = aircraft.surfaces[name]
    if surface.threshold == "constant":
        width_deg = _width_deg(aircraft.model(name).physics)
        wider = f", and {width_deg:.2g} deg more for its play, friction and coarse steps" if width_deg else ""
        return [
            f"{name} is not calibrated: the script alarms at a constant {surface.threshold_deg:g} deg{wider}; "
            "`servofd calibrate` of good flights makes that follow the command, down to the noise at rest"
        ]
    if surface.calibrated and surface.measured and POSITIONS_FROM_1.fullmatch(surface.measured.channel):
        return [f"{name} is calibrated on a link, which is later than the autopilot: calibrate a log of its card"]
    known = surface.tolerance is not None
    return [] if known else [f"{name} is not calibrated: it may differ as much as a fleet of HS-225BB does"]


def _width_deg(physics: Physics) -> float:
    """How far a servo may stand from where the script's servo does."""
    return float(sum(share * getattr(physics, field) for field, share in _WIDTHS.items()))


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


def _modes(model: ServoModel, gain: float) -> tuple[float, ...]:
    """Modes of the linear servo times the gain of its linkage, none too close to another for 32-bit numbers.

    Each has four numbers: its decay and turn [rad/s], its weight, and that of its turning part.
    """
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
    rows = np.stack(
        [modes.decay_rad_s.real, modes.decay_rad_s.imag, gain * modes.weight.real, gain * modes.weight.imag]
    )
    return tuple(rows.T.ravel().tolist())


def _constant_doubt(level_deg: float) -> tuple[float, ...]:
    """Root of the variance that makes a constant level of one standard deviation, and all that a slow motor leaves."""
    root = np.zeros((_SIGNALS, _SIGNALS))
    root[0, 0], root[-1, -1] = level_deg, 1.0
    return tuple(root[np.triu_indices(_SIGNALS)].tolist())


def _doubt(known: CalibratedServo, on_board: ServoModel, named: ServoModel | None) -> tuple[float, ...]:
    """Root of the covariance of what good servos leave, by the signals that the script has of its own servo.

    Sensitivities are those of the servo of the audit, on commands that reach all of its travel; what of them these
    signals do not show, and what the script's servo does otherwise, grows with the square of each.
    """
    from scipy.optimize import nnls

    low_deg, high_deg = np.clip(known.reach_deg, -REACH_DEG, REACH_DEG).tolist()
    time_s = np.arange(0.0, _TRIED_S, _TRIED_STEP_S)
    chirp = np.sin(np.pi * _TRIED_HZ / _TRIED_S * time_s**2)
    steps = np.sign(np.sin(2.0 * time_s)) * np.ceil(4.0 * time_s / _TRIED_S) / 4.0
    share = np.where(time_s % 10.0 < 5.0, chirp, steps)
    command_deg = 0.5 * (low_deg + high_deg) + 0.5 * (high_deg - low_deg) * share
    moved_deg, slow_deg = (each.simulate(time_s, command_deg, time_s) for each in (on_board, on_board.weaker(_SLOWER)))
    theta, one = known.theta, np.ones(time_s.size)
    table, start_deg = variants(theta, patterns=False, middle_deg=known.middle_deg), np.full(time_s.size, np.nan)
    start_deg[0] = moved_deg[0]
    load = load_at(known.airspeed_m_s) if known.airspeed_m_s else 1.0
    position_deg, speed_deg_s = simulated(
        table, new_state(len(table)), (time_s, command_deg, 0.0 * one), time_s, load * one, one, start_deg
    )
    reading_deg, slopes = sensitivities(position_deg, speed_deg_s, theta, known.reach_deg)
    reading_deg -= known.offset_deg
    if named is not None:
        reading_deg = named.simulate(time_s, command_deg, time_s)
    left_deg = np.column_stack([slopes @ np.linalg.cholesky(known.covariance), reading_deg - moved_deg])
    signals = _signals(on_board, moved_deg, slow_deg)
    shown = np.linalg.lstsq(signals, left_deg, rcond=_ALIKE)[0]
    rest = np.sum((left_deg - signals @ shown) ** 2, axis=1)
    covariance = shown @ shown.T + np.diag(_ALIKE + nnls(signals**2, rest)[0])
    return tuple(np.linalg.cholesky(covariance).T[np.triu_indices(_SIGNALS)].tolist())


def _signals(servo: ServoModel, moved_deg: FloatArray, slow_deg: FloatArray) -> FloatArray:
    """What the script knows of its servo at each instant, shape (n, 6): one, its deflection, rate, and so on."""
    from scipy.signal import lfilter

    quick, turned = np.zeros_like(moved_deg), np.zeros_like(moved_deg)
    for k, decay in enumerate(servo.transfer.modes().decay_rad_s):
        half = 0.5 * _TRIED_STEP_S * decay
        passed = lfilter([half, half], [1.0 + half, half - 1.0], moved_deg - moved_deg[0])
        quick += (1.0 if decay.imag == 0.0 else 2.0) * (moved_deg - moved_deg[0] - passed.real)
        if decay.imag != 0.0:
            turned = passed.imag
        elif k == 0:
            turned = quick.copy()
    rate_deg_s = np.diff(moved_deg, prepend=moved_deg[0]) / _TRIED_STEP_S
    return np.column_stack([np.ones_like(moved_deg), moved_deg, rate_deg_s, quick, turned, moved_deg - slow_deg])
