"""Strangers' aircraft: motor-level servos, a closed loop, a log; from physics, sharing no code with servofd's models.

``stranger(seed)`` draws an aircraft, ``fly(...)`` one of its flights, healthy or with a `Failure`; a `Flight` writes
itself as a plain table, as an ArduPilot log or as telemetry. Everything is drawn from the seeds and nothing else.
**Constants of servofd are chosen on aircraft of even seed, figures are reported on odd ones.**

What is in it, and in no model of servofd as such:

* a motor with torque proportional to what the driver leaves of the supply after its back-EMF, limited in current;
  Stribeck friction that can stick; a hinge moment that grows with dynamic pressure; the supply sags with the currents;
* electronics: pulses in whole microseconds, latched at frames of 20 or 3.3 ms that are not locked to the autopilot, a
  proportional loop with velocity feedback, saturation and a dead band of its own;
* a linkage with play, which the air pushes to one side, and a surface that buffets in turbulence;
* a sensor on the surface: non-linearity, hysteresis, bias that drifts, white and 1/f noise, steps of 0.02 to 0.5 deg,
  2 to 80 ms late at 10, 25 or 50 Hz, with jitter, on a clock that is some ppm off; rows lost one by one and in bursts;
* an airframe flown by an autopilot that sees what its surfaces do, from taxi with control checks to aerobatics.

From one flight to the next of the same aircraft change: supply, friction (temperature), zero and slope of the sensor,
phase of the frames, latency, wind.

Examples
--------
>>> aircraft = stranger(2)
>>> good = fly(aircraft, 1, "mixed", duration_s=30.0)
>>> good.position_deg.shape[1] == len(good.surfaces) == 4
True
>>> bad = fly(aircraft, 1, "mixed", duration_s=30.0, failure=Failure("stuck", "elevator", 12.0))
>>> float(abs(good.position_deg[:50] - bad.position_deg[:50])[0].max()) < 1e-9
True
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]

__all__ = [
    "ALL",
    "SIZES",
    "STYLES",
    "SURFACES",
    "Failure",
    "Flight",
    "Servo",
    "Stranger",
    "draw_failure",
    "fly",
    "stranger",
]

SURFACES: Final = ("aileron_left", "aileron_right", "elevator", "rudder")
ALL: Final = "all"
"""Of a failure: every surface at once, as a supply that gives way breaks them."""
_OUTPUTS: Final = (1, 5, 2, 4)
STYLES: Final = ("mixed", "taxi", "cruise", "loiter", "turbulence", "aerobatics")

SIZES: Final[Mapping[str, tuple[float, float, float]]] = {
    "loss_of_effectiveness": (0.85, 0.7, 0.4),
    "bias": (0.6, 1.5, 4.0),
    "slow": (0.7, 0.5, 0.3),
    "deadband": (1.0, 2.0, 4.0),
    "oscillation": (0.7, 1.5, 3.0),
    "intermittent": (0.3, 0.6, 1.2),
    "stuck": (1.0, 1.0, 1.0),
    "hardover": (1.0, 1.0, 1.0),
    "floating": (1.0, 1.0, 1.0),
}
"""Small, medium and large of each kind: share of travel left, deg, share of speed left, deg of play, deg of amplitude,
seconds of each dropout; the last three have no size."""
_KINDS: Final = tuple(SIZES)

_STEP_S: Final = 0.0005
_KEEP: Final = 2
"""Every so manieth step is kept, and the electronics look as often."""
_TICK_S: Final = 0.02
_PA_AT_CRUISE: Final = 300.0
_EPOCH_US: Final = 1_700_000_000_000_000
"""When telemetry was received [us since 1970]."""


@dataclass(frozen=True, slots=True)
class Servo:
    """A servo, its linkage and its sensor; degrees of the surface unless said."""

    speed_deg_s: float
    """Without load, at 6 V."""
    motor_s: float
    """Mechanical time constant."""
    band_deg: float
    """Error at which the driver gives all it has."""
    damping: float
    """Velocity feedback, in units of the back-EMF."""
    current_share: float
    """Largest torque, as a share of the one at standstill."""
    deadband_deg: float
    """Full width, in the electronics."""
    coulomb: float
    """Share of the torque at standstill."""
    stribeck: float
    stribeck_deg_s: float
    frame_s: float
    hinge: float
    """Torque per 20 deg and 300 Pa, as a share of the one at standstill."""
    hinge_offset: float
    play_deg: float
    push_per_s: float
    """How fast the air moves the surface through its play at 300 Pa."""
    gain: float
    bow: float
    """Quadratic part of the linkage, at 25 deg [deg]."""
    travel_deg: float
    nonlinear_deg: float
    waves: float
    hysteresis_deg: float
    bias_deg: float
    drift_deg: float
    white_deg: float
    pink_deg: float
    step_deg: float
    late_s: float


@dataclass(frozen=True, slots=True)
class Stranger:
    """An aircraft."""

    seed: int
    grade: str
    servos: tuple[Servo, ...]
    position_hz: float
    command_hz: float
    cruise_m_s: float
    supply_ohm: float
    ppm: float
    lost: float
    """Share of single rows that are lost."""
    deg_per_us: float
    airframe: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Failure:
    """What breaks, where and when; `size` as in `SIZES`, `position_deg` for hardover, `hz` for oscillation."""

    kind: str
    surface: str
    start_s: float
    size: float = 1.0
    hz: float = 3.0
    sign: float = 1.0
    end_s: float = np.inf


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """What the log of one flight holds; n commands and m positions of s surfaces, each with its own time stamps."""

    aircraft: Stranger
    number: int
    style: str
    failure: Failure | None
    command_s: Floats
    command_deg: Floats
    """Shape (n, s): what the pulses ask for."""
    position_s: Floats
    position_deg: Floats
    """Shape (m, s); NaN where a servo's answer was lost."""
    airspeed_m_s: Floats
    """Shape (n,)."""
    supply_v: Floats
    """Shape (n,)."""
    phases: tuple[tuple[str, float, float], ...]
    surfaces: tuple[str, ...] = SURFACES
    true_s: Floats = field(default_factory=lambda: np.zeros(0))
    true_deg: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Where the surfaces really were, each millisecond."""

    def phase(self, time_s: float) -> str:
        """What the aircraft does at a time."""
        return next((name for name, start_s, end_s in self.phases if start_s <= time_s < end_s), "")

    def only(self, *names: str) -> Flight:
        """The log of some surfaces alone; in that of an autopilot they are on the first outputs."""
        places = [self.surfaces.index(name) for name in names]
        return replace(
            self, surfaces=names, command_deg=self.command_deg[:, places], position_deg=self.position_deg[:, places]
        )

    def table(self) -> bytes:
        """As plain table: commands and positions in rows of their own, empty where there is none."""
        n, m, s = self.command_s.size, self.position_s.size, len(self.surfaces)
        rows = np.full((n + m, 2 * s + 3), np.nan)
        rows[:n, 0], rows[n:, 0] = self.command_s, self.position_s
        rows[:n, 1 : 2 * s : 2], rows[n:, 2 : 2 * s + 1 : 2] = self.command_deg, self.position_deg
        rows[:n, 2 * s + 1], rows[:n, 2 * s + 2] = self.airspeed_m_s, self.supply_v
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        names = [f"{name}_{what}_deg" for name in self.surfaces for what in ("cmd", "pos")]
        sink = io.StringIO()
        sink.write(",".join(["time_s", *names, "airspeed_m_s", "servo_voltage_v"]) + "\n")
        np.savetxt(sink, rows, fmt=["%.6f", *["%.4f"] * (2 * s), "%.2f", "%.2f"], delimiter=",")
        return sink.getvalue().replace("nan", "").encode()

    def dataflash(self) -> bytes:
        """As ArduPilot's log: RCOU, CSRV, ARSP and the parameters of the outputs."""
        from logparsers.dataflash.encode import Message, encode

        def micros(time_s: Floats) -> NDArray[np.int64]:
            return np.round(1e6 * (time_s + 5.0)).astype(np.int64)

        scale = self.aircraft.deg_per_us
        n = self.command_s.size
        rcou = {"TimeUS": micros(self.command_s)} | {f"C{k}": np.zeros(n, np.int64) for k in range(1, 15)}
        rcou["C3"] = np.full(n, 1500, np.int64)
        parameters = {"SERVO3_FUNCTION": 70.0}
        for i, output in enumerate(_OUTPUTS[: len(self.surfaces)]):
            rcou[f"C{output}"] = np.round(1500.0 + self.command_deg[:, i] / scale).astype(np.int64)
            parameters |= {f"SERVO{output}_FUNCTION": (4.0, 4.0, 19.0, 21.0)[i], f"SERVO{output}_TRIM": 1500.0}
            parameters |= {f"SERVO{output}_MIN": 1100.0, f"SERVO{output}_MAX": 1900.0, f"SERVO{output}_REVERSED": 0.0}
        time_s = np.concatenate([self.position_s[np.isfinite(d)] for d in self.position_deg.T])
        ids = np.concatenate(
            [np.full(np.isfinite(d).sum(), o - 1) for o, d in zip(_OUTPUTS, self.position_deg.T, strict=False)]
        )
        deg = np.concatenate([d[np.isfinite(d)] for d in self.position_deg.T])
        order = np.argsort(time_s, kind="stable")
        csrv = {"TimeUS": micros(time_s[order]), "Id": ids[order], "Pos": deg[order], "Err": np.zeros(deg.size)}
        air = slice(None, None, max(1, round(self.aircraft.command_hz / 10.0)))
        start = np.full(len(parameters), micros(np.zeros(1))[0])
        said: dict[str, ArrayLike] = {"TimeUS": start[:1], "Message": ["ArduPlane V4.7.0-dev (00000000)"]}
        parm: dict[str, ArrayLike] = {"TimeUS": start, "Name": list(parameters), "Value": list(parameters.values())}
        arsp = {"TimeUS": micros(self.command_s[air]), "I": np.zeros(self.command_s[air].size)}
        arsp |= {"Airspeed": self.airspeed_m_s[air], "U": np.ones(self.command_s[air].size)}
        return encode(
            [
                Message("PARM", "QNf", parm, "s--", "F--"),
                Message("MSG", "QZ", said, "s-", "F-"),
                Message("RCOU", "Q" + "H" * 14, rcou, "s" + "Y" * 14, "F" + "-" * 14),
                Message("CSRV", "QBfB", csrv, "s#d-", "F-0-"),
                Message("ARSP", "QBfB", arsp, "s#n-", "F-0-"),
            ]
        )

    def telemetry(self) -> bytes:
        """As a ground station's log: SERVO_OUTPUT_RAW, NAMED_VALUE_FLOAT ``SRVP<n>``, VFR_HUD and the parameters."""
        from logparsers.telemetry.encode import Message, encode

        def micros(time_s: Floats) -> NDArray[np.int64]:
            return np.round(1e6 * (time_s + 5.0)).astype(np.int64)

        sent_us = micros(self.command_s)
        pulses: dict[str, ArrayLike] = {"time_usec": sent_us, "servo3_raw": np.full(sent_us.size, 1500)}
        parameters = {"SERVO3_FUNCTION": 70.0}
        told: list[tuple[str, NDArray[np.int64], dict[str, ArrayLike]]] = []
        for i, output in enumerate(_OUTPUTS[: len(self.surfaces)]):
            us = 1500.0 + self.command_deg[:, i] / self.aircraft.deg_per_us
            pulses[f"servo{output}_raw"] = np.round(us).astype(np.int64)
            parameters |= {f"SERVO{output}_FUNCTION": (4.0, 4.0, 19.0, 21.0)[i], f"SERVO{output}_TRIM": 1500.0}
            parameters |= {f"SERVO{output}_MIN": 1100.0, f"SERVO{output}_MAX": 1900.0, f"SERVO{output}_REVERSED": 0.0}
            known = np.isfinite(self.position_deg[:, i])
            at_us = micros(self.position_s[known])
            name = [f"SRVP{output}"] * at_us.size
            position = {"time_boot_ms": at_us // 1000, "name": name, "value": self.position_deg[known, i]}
            told.append(("NAMED_VALUE_FLOAT", at_us, position))
        start_us, count = micros(np.zeros(1)), len(parameters)
        param: dict[str, ArrayLike] = {"param_id": list(parameters), "param_value": list(parameters.values())}
        param |= {"param_type": [9] * count, "param_count": [count] * count, "param_index": np.arange(count)}
        second_us = sent_us[:: round(self.aircraft.command_hz)]
        beat = {"type": 1, "autopilot": 3, "base_mode": 128 | 16 | 8 | 4 | 1, "custom_mode": 10, "system_status": 4}
        air = slice(None, None, max(1, round(self.aircraft.command_hz / 5.0)))
        told += [
            ("HEARTBEAT", second_us, {name: np.full(second_us.size, value) for name, value in beat.items()}),
            ("STATUSTEXT", start_us, {"severity": [6], "text": ["ArduPlane V4.7.0-dev (00000000)"]}),
            ("PARAM_VALUE", np.repeat(start_us, count), param),
            ("SERVO_OUTPUT_RAW", sent_us, pulses),
            ("VFR_HUD", sent_us[air], {"airspeed": self.airspeed_m_s[air], "groundspeed": self.airspeed_m_s[air]}),
        ]
        link = np.random.default_rng([74, self.aircraft.seed, self.number])
        made_us = np.concatenate([at_us for _, at_us, _ in told])
        order = np.argsort(made_us, kind="stable")
        heard_us = np.empty_like(made_us)
        late_us = 12_000 + np.rint(link.exponential(3_000.0, made_us.size)).astype(np.int64)
        heard_us[order] = np.maximum.accumulate(_EPOCH_US + made_us[order] + late_us)
        parts = np.split(heard_us, np.cumsum([at_us.size for _, at_us, _ in told])[:-1])
        return encode([Message(name, at_us, columns) for (name, _, columns), at_us in zip(told, parts, strict=True)])

    def until(self, time_s: float) -> Flight:
        """The beginning of this flight, as if the log ended there."""
        sent, seen = self.command_s < time_s, self.position_s < time_s
        return replace(
            self, command_s=self.command_s[sent], command_deg=self.command_deg[sent], position_s=self.position_s[seen],
            position_deg=self.position_deg[seen], airspeed_m_s=self.airspeed_m_s[sent], supply_v=self.supply_v[sent],
        )  # fmt: skip

    def write(self, path: Path) -> Path:
        """Write the log; ``.csv``, ``.bin`` or ``.tlog``."""
        forms = {".bin": self.dataflash, ".tlog": self.telemetry}
        path.write_bytes(forms.get(path.suffix, self.table)())
        return path


def stranger(seed: int, *, grade: str | None = None, position_hz: float | None = None) -> Stranger:
    """Draw an aircraft.

    Parameters
    ----------
    seed : int
        Everything is drawn from it.
    grade : str, optional
        ``good`` or ``cheap`` servos; by turns of two seeds if None.
    position_hz : float, optional
        Rate of the feedback [Hz]; one of 10, 25, 25, 50, 50 if None.
    """
    rng = np.random.default_rng([71, seed])
    chosen = grade or ("good", "cheap")[(seed // 2) % 2]
    late_s, step_deg = (
        float(np.exp(rng.uniform(*np.log([0.002, 0.08])))),
        float(rng.choice([0.02, 0.05, 0.1, 0.2, 0.5])),
    )
    if chosen == "good":
        step_deg = min(step_deg, 0.1)
    frame_s = float(rng.choice([0.02, 0.0033] if chosen == "good" else [0.02, 0.02, 0.0033]))
    kind = _draw_servo(rng, chosen, frame_s, late_s, step_deg)
    return Stranger(
        seed,
        chosen,
        tuple(_individual(rng, kind) for _ in SURFACES),
        position_hz or float(rng.choice([10.0, 25.0, 25.0, 50.0, 50.0])),
        float(rng.choice([25.0, 50.0, 50.0])),
        float(rng.uniform(16.0, 28.0)),
        float(rng.uniform(0.05, 0.25)),
        float(rng.normal(0.0, 40.0)),
        float(rng.choice([0.0, 0.002, 0.01])),
        float(rng.uniform(0.06, 0.12)),
        tuple(rng.uniform(0.75, 1.3, 12)),
    )


def _draw_servo(rng: np.random.Generator, grade: str, frame_s: float, late_s: float, step_deg: float) -> Servo:
    """A type of servo."""
    u = rng.uniform
    good = grade == "good"
    return Servo(
        speed_deg_s=u(300.0, 600.0) if good else u(200.0, 420.0),
        motor_s=u(0.012, 0.025) if good else u(0.018, 0.04),
        band_deg=u(5.0, 9.0) if good else u(6.0, 12.0),
        damping=u(0.2, 1.0),
        current_share=u(0.6, 1.2),
        deadband_deg=u(0.03, 0.15) if good else u(0.1, 0.5),
        coulomb=u(0.004, 0.015) if good else u(0.015, 0.05),
        stribeck=u(1.1, 1.7),
        stribeck_deg_s=u(3.0, 20.0),
        frame_s=frame_s,
        hinge=u(0.01, 0.05) if good else u(0.03, 0.15),
        hinge_offset=u(-0.02, 0.02),
        play_deg=u(0.02, 0.1) if good else u(0.1, 0.4),
        push_per_s=u(8.0, 60.0),
        gain=u(0.97, 1.03),
        bow=u(-0.4, 0.4),
        travel_deg=u(24.0, 30.0),
        nonlinear_deg=u(0.02, 0.08) if good else u(0.05, 0.3),
        waves=u(0.5, 2.5),
        hysteresis_deg=u(0.0, 0.03) if good else u(0.02, 0.12),
        bias_deg=u(-0.3, 0.3),
        drift_deg=u(0.01, 0.05) if good else u(0.03, 0.12),
        white_deg=u(0.01, 0.05) if good else u(0.03, 0.15),
        pink_deg=u(0.01, 0.03) if good else u(0.02, 0.08),
        step_deg=step_deg,
        late_s=late_s,
    )


def _individual(rng: np.random.Generator, kind: Servo) -> Servo:
    """One servo of a type: everything that is not a rate, a frame or a step differs by some percent."""
    fixed = {"frame_s", "step_deg", "late_s"}
    values = {name: getattr(kind, name) for name in kind.__slots__}
    drawn = {name: v if name in fixed else v * float(np.exp(rng.normal(0.0, 0.06))) for name, v in values.items()}
    drawn |= {"gain": kind.gain + float(rng.normal(0.0, 0.01)), "bias_deg": float(rng.uniform(-0.4, 0.4))}
    return Servo(**drawn)


def draw_failure(seed: int, flight_s: float, kind: str, size: str, surfaces: tuple[str, ...] = SURFACES) -> Failure:
    """Draw surface, onset (in the middle half), frequency and sign of a failure; `size` small, medium or large."""
    rng = np.random.default_rng([72, seed])
    value = SIZES[kind][("small", "medium", "large").index(size)]
    onset_s = float(rng.uniform(0.25, 0.6) * flight_s)
    surface, sign = str(rng.choice(surfaces)), float(rng.choice([-1.0, 1.0]))
    return Failure(kind, surface, onset_s, value, float(rng.uniform(1.5, 7.0)), sign)


def fly(
    aircraft: Stranger, number: int, style: str, *, duration_s: float = 240.0, failure: Failure | None = None
) -> Flight:
    """Simulate a flight.

    Parameters
    ----------
    aircraft : Stranger
        Who flies.
    number : int
        Which flight of this aircraft; weather, pilot and condition are drawn from it.
    style : str
        One of `STYLES`; ``mixed`` holds all the others, from taxi to landing.
    duration_s : float
        Length [s].
    failure : Failure, optional
        What breaks.

    Returns
    -------
    Flight
        Its log. The same flight without failure is the same to the last bit up to the onset.
    """
    rng = np.random.default_rng([73, aircraft.seed, number, STYLES.index(style)])
    servos = tuple(_today(rng, servo) for servo in aircraft.servos)
    plan, phases = _plan(rng, aircraft, style, duration_s)
    table = np.array([[getattr(s, name) for name in _PHYSICS] for s in servos])
    supply_v = rng.uniform(5.6, 6.3)
    frame_phase = rng.uniform(0.0, 1.0, len(servos))
    gusts = rng.normal(size=(plan.shape[0], 4))
    kind = _KINDS.index(failure.kind) if failure else -1
    broken = -1 if failure is None else len(SURFACES) if failure.surface == ALL else SURFACES.index(failure.surface)
    broken_at = (failure.start_s, failure.end_s, failure.size, failure.hz, failure.sign) if failure else (np.inf,) * 5
    drops = _dropouts(np.random.default_rng([74, aircraft.seed, number]), failure, duration_s)
    true_deg, pulses, air = _simulate(
        plan, table, np.array(aircraft.airframe), aircraft.cruise_m_s, gusts, frame_phase,
        np.array([supply_v, aircraft.supply_ohm, aircraft.deg_per_us]),
        kind, broken, np.array(broken_at), drops, int(rng.integers(2**31)),
    )  # fmt: skip
    return _logged(rng, aircraft, servos, number, style, failure, phases, true_deg, pulses, air)


_PHYSICS: Final = (
    "speed_deg_s", "motor_s", "band_deg", "damping", "current_share", "deadband_deg", "coulomb", "stribeck",
    "stribeck_deg_s", "frame_s", "hinge", "hinge_offset", "play_deg", "push_per_s", "gain", "bow", "travel_deg",
)  # fmt: skip


def _today(rng: np.random.Generator, servo: Servo) -> Servo:
    """The servo on one day: temperature, zero and slope of the sensor, latency."""
    n = rng.normal(size=6)
    return replace(
        servo,
        coulomb=servo.coulomb * float(np.exp(0.15 * n[0])),
        bias_deg=servo.bias_deg + 0.07 * float(n[1]),
        gain=servo.gain * (1.0 + 0.005 * float(n[2])),
        late_s=max(0.001, servo.late_s + 0.003 * float(n[3])),
        hinge_offset=servo.hinge_offset + 0.005 * float(n[4]),
        play_deg=servo.play_deg * float(np.exp(0.1 * n[5])),
    )


def _dropouts(rng: np.random.Generator, failure: Failure | None, duration_s: float) -> Floats:
    """Starts and ends of the dropouts of an intermittent contact [s], of shape (k, 2)."""
    if failure is None or failure.kind != "intermittent":
        return np.zeros((0, 2))
    starts_s = failure.start_s + np.cumsum(rng.exponential(5.0, 200) + 0.5)
    lengths_s = failure.size * rng.uniform(0.6, 1.6, 200)
    starts_s[0] = failure.start_s
    keep = (starts_s < min(failure.end_s, duration_s)) & (np.diff(starts_s, append=np.inf) > lengths_s)
    return np.column_stack([starts_s, starts_s + lengths_s])[keep]


def _plan(
    rng: np.random.Generator, aircraft: Stranger, style: str, duration_s: float
) -> tuple[Floats, tuple[tuple[str, float, float], ...]]:
    """What pilot and mission ask for, each tick: airspeed, ground, turbulence, bank, pitch, sticks, who flies."""
    shares: tuple[tuple[str, float], ...] = ((style, 1.0),)
    if style == "mixed":
        air = [("cruise", 0.2), ("loiter", 0.15), ("turbulence", 0.2), ("aerobatics", 0.15)]
        air = [air[i] for i in rng.permutation(4)]
        shares = (("taxi", 0.17), ("take-off", 0.06), *air, ("landing", 0.07))
    ticks = round(duration_s / _TICK_S)
    plan = np.zeros((ticks, 9))
    phases, first = [], 0
    for k, (phase, share) in enumerate(shares):
        last = ticks if k == len(shares) - 1 else min(ticks, first + round(share * ticks))
        part = plan[first:last]
        if part.shape[0]:
            _phase(rng, part, phase, aircraft.cruise_m_s)
            phases.append((phase, first * _TICK_S, last * _TICK_S))
        first = last
    speed = plan[:, 0]
    for k in range(1, ticks):  # neither thrust nor drag changes the speed at once
        speed[k] = speed[k - 1] + np.clip(speed[k] - speed[k - 1], -4.0 * _TICK_S, 4.0 * _TICK_S)
    return plan, tuple(phases)


def _held(rng: np.random.Generator, size: int, mean_s: float, values: Floats) -> Floats:
    """A staircase of values drawn at random times."""
    out, k = np.zeros(size), 0
    while k < size:
        run = max(1, round(rng.exponential(mean_s) / _TICK_S))
        out[k : k + run] = rng.choice(values)
        k += run
    return out


def _eased(values: Floats, time_s: float) -> Floats:
    """First-order lag."""
    out, share = np.empty_like(values), 1.0 - np.exp(-_TICK_S / time_s)
    state = values[0]
    for k, value in enumerate(values):
        state += share * (value - state)
        out[k] = state
    return out


def _phase(rng: np.random.Generator, part: Floats, phase: str, cruise_m_s: float) -> None:
    """Fill the rows of one phase: 0 airspeed, 1 ground, 2 turbulence, 3 bank, 4 pitch, 5-7 sticks, 8 autopilot on."""
    n = part.shape[0]
    time_s = np.arange(n) * _TICK_S
    if phase == "taxi":
        part[:, 0], part[:, 1] = _eased(_held(rng, n, 8.0, np.array([0.0, 2.0, 4.0, 6.0])), 2.0), 1.0
        part[:, 7] = _eased(_held(rng, n, 3.0, np.linspace(-0.7, 0.7, 9)), 0.3)
        for check_s in np.arange(rng.uniform(2.0, 6.0), max(time_s[-1], 1.0), 25.0):  # full and free, axis by axis
            for axis in (5, 6, 7):
                at = (time_s >= check_s + 3.0 * (axis - 5)) & (time_s < check_s + 3.0 * (axis - 4))
                turn = np.interp(
                    (time_s[at] - time_s[at][0]) if at.any() else [], [0, 0.3, 0.9, 1.3, 2.1, 2.5], [0, 1, 1, -1, -1, 0]
                )
                part[at, axis] = turn * rng.uniform(0.6, 1.0)
        return
    part[:, 0], part[:, 2], part[:, 8] = cruise_m_s, rng.uniform(0.2, 0.6), 1.0
    if phase == "take-off":
        part[:, 0] = np.minimum(cruise_m_s, 4.0 * time_s)
        part[:, 1] = part[:, 0] < 0.6 * cruise_m_s
        part[:, 4] = np.radians(12.0)
    elif phase == "cruise":
        part[:, 3] = _eased(_held(rng, n, 15.0, np.radians([0.0, 0.0, 0.0, 15.0, -15.0])), 0.7)
        part[:, 4] = _eased(_held(rng, n, 20.0, np.radians([0.0, 2.0, -2.0])), 1.0)
    elif phase == "loiter":
        part[:, 3] = rng.choice([-1.0, 1.0]) * np.radians(rng.uniform(20.0, 35.0))
        part[:, 4] = np.radians(3.0)
    elif phase == "turbulence":
        part[:, 2] = rng.uniform(1.5, 3.5)
        part[:, 3] = _eased(_held(rng, n, 10.0, np.radians([0.0, 25.0, -25.0])), 0.5)
    elif phase == "aerobatics":
        part[:, 0] = cruise_m_s * (1.15 + 0.2 * np.sin(0.3 * time_s + rng.uniform(0.0, 6.0)))
        part[:, 8] = _held(rng, n, 4.0, np.array([0.0, 0.0, 1.0]))
        part[:, 3] = _held(rng, n, 3.0, np.radians([-60.0, -30.0, 0.0, 30.0, 60.0]))
        for axis, mean_s in ((5, 0.8), (6, 1.0), (7, 1.5)):
            part[:, axis] = _eased(_held(rng, n, mean_s, np.array([-1.0, -0.5, -0.2, 0.0, 0.0, 0.2, 0.5, 1.0])), 0.08)
    elif phase == "landing":
        part[:, 0] = np.interp(time_s, [0.0, 0.5 * time_s[-1], time_s[-1]], [cruise_m_s, 0.7 * cruise_m_s, 2.0])
        part[:, 1] = part[:, 0] < 0.45 * cruise_m_s
        part[:, 4] = _eased(_held(rng, n, 3.0, np.radians([-3.0, 0.0, 4.0])), 0.5)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _simulate(  # noqa: C901, PLR0912, PLR0915 - one loop over time
    plan: Floats, servos: Floats, airframe: Floats, cruise: float, gusts: Floats, frame_phase: Floats, supply: Floats,
    kind: int, broken: int, fault: Floats, drops: Floats, seed: int,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Airframe and autopilot each 20 ms, motors each 0.5 ms."""
    np.random.seed(seed)  # noqa: NPY002 - the generator of compiled code
    ticks, count = plan.shape[0], servos.shape[0]
    inner = round(_TICK_S / _STEP_S)
    kept = inner // _KEEP
    true_deg = np.zeros((ticks * kept, count))
    pulses = np.zeros((ticks, count))
    air = np.zeros((ticks, 2))
    angle, rate, surface = np.zeros(count), np.zeros(count), np.zeros(count)
    target, drive = np.zeros(count), np.zeros(count)
    next_frame = frame_phase * servos[:, 9]
    sent, previous = np.zeros(count), np.zeros(count)
    buffet = np.zeros(count)
    p = q = r = phi = theta = alpha = beta = 0.0
    gust_p = gust_w = gust_v = 0.0
    integral = np.zeros(3)
    throttle_v = 0.0
    jammed, drop = False, 0
    a = airframe
    amps = 0.0
    volts = supply[0]
    for tick in range(ticks):
        t0 = tick * _TICK_S
        speed, ground, turbulence = plan[tick, 0], plan[tick, 1], plan[tick, 2]
        ratio = max(speed, 0.1) / cruise
        pressure = ratio * ratio
        # the autopilot sees noisy rates
        pm, qm, rm = p + 0.012 * gusts[tick, 0], q + 0.012 * gusts[tick, 1], r + 0.012 * gusts[tick, 2]
        scaler = 1.0 / max(pressure, 0.35)
        if plan[tick, 8] > 0.5 and ground < 0.5:
            wish = np.array(
                (2.5 * (plan[tick, 3] - phi), 2.0 * (plan[tick, 4] - theta), 9.81 / max(speed, 5.0) * np.tan(phi))
            )
            error = wish - np.array((pm, qm, rm))
            for k in range(3):
                integral[k] = min(0.4, max(-0.4, integral[k] + 0.6 * error[k] * _TICK_S))
            roll = scaler * (9.0 * error[0] + 9.0 * integral[0])
            pitch = scaler * (14.0 * error[1] + 20.0 * integral[1]) + 1.5
            yaw = scaler * (8.0 * error[2] + 4.0 * integral[2])
        elif ground > 0.5:
            roll, pitch, yaw = 25.0 * plan[tick, 5], 25.0 * plan[tick, 6], 25.0 * plan[tick, 7]
        else:
            roll = 22.0 * plan[tick, 5] - 2.0 * pm
            pitch = 18.0 * plan[tick, 6] + 1.5 - 3.0 * qm - 4.0 * theta
            yaw = 18.0 * plan[tick, 7] - 3.0 * rm
        for i in range(count):
            wanted = (roll, -roll, pitch, yaw)[i] if count == 4 else 0.0
            wanted = min(25.0, max(-25.0, wanted))
            sent[i] = np.round(wanted / supply[2]) * supply[2]
            pulses[tick, i] = sent[i]
        throttle_v += 0.02 * (0.25 * (speed > 0.5) + 0.05 * gusts[tick, 3] - throttle_v)
        for step in range(inner):
            t = t0 + step * _STEP_S
            failing = fault[0] <= t < fault[1]
            total = 0.0
            while drop < drops.shape[0] and drops[drop, 1] <= t:
                drop += 1
            for i in range(count):
                s = servos[i]
                asked = sent[i] if t - t0 > 0.002 else previous[i]
                while t >= next_frame[i]:
                    next_frame[i] += s[9]
                    gap = kind == 5 and i == broken and drop < drops.shape[0] and drops[drop, 0] <= t
                    if not gap:
                        target[i] = asked
                q_pa = _PA_AT_CRUISE * pressure
                here = failing and broken in (i, count)
                goal = min(s[16], max(-s[16], s[14] * target[i]))
                weak, power = 1.0, True
                if here:
                    if kind == 0:
                        goal *= fault[2]
                    elif kind == 1:
                        goal += fault[2] * fault[4]
                    elif kind == 2:
                        weak = fault[2]
                    elif kind == 4:
                        w = 2.0 * np.pi * fault[3]
                        k1 = s[0] / s[2] / s[1]
                        reply = np.sqrt((k1 - w * w) ** 2 + (w * (1.0 + s[3]) / s[1]) ** 2) / k1
                        goal += fault[2] * min(reply, 3.0) * np.sin(w * (t - fault[0]))
                    elif kind == 7:
                        goal = s[16] * fault[4]
                    elif kind == 8:
                        power = False
                if step % _KEEP == 0:
                    error = goal - angle[i]
                    error -= min(0.5 * s[5], max(-0.5 * s[5], error))
                    drive[i] = min(1.0, max(-1.0, error / s[2] - s[3] * rate[i] / s[0]))
                left = weak * drive[i] * volts / 6.0 - rate[i] / s[0]
                torque = min(s[4], max(-s[4], left)) if power else -0.15 * rate[i] / s[0]
                hinge = q_pa / 300.0 * (s[10] * angle[i] / 20.0 + s[11])
                total += abs(torque)
                jammed = kind == 6 and here
                if jammed:
                    rate[i] = 0.0
                else:
                    pull = s[0] / s[1] * (torque - hinge)
                    free = rate[i] + _STEP_S * pull
                    grip = s[6] * (1.0 + (s[7] - 1.0) * np.exp(-((rate[i] / s[8]) ** 2)))
                    if not power:
                        grip *= 0.4
                    most = _STEP_S * s[0] / s[1] * grip
                    rate[i] = free - min(most, max(-most, free))
                    angle[i] += _STEP_S * rate[i]
                # through the linkage; inside its play the surface goes where the air pushes it
                play = s[12] + (fault[2] if here and kind == 3 else 0.0)
                arm = angle[i] + s[15] * (angle[i] / 25.0) ** 2
                if step % _KEEP == 0:
                    buffet[i] += -0.02 * buffet[i] + 0.2 * turbulence * 0.1 * np.random.normal()  # noqa: NPY002
                push = -np.sign(hinge) * min(1.0, abs(hinge) / 0.01) * s[13] * q_pa / 300.0 * play
                surface[i] += _STEP_S * (push + s[13] * pressure * 0.3 * play * buffet[i])
                surface[i] = min(arm + 0.5 * play, max(arm - 0.5 * play, surface[i]))
                if step % _KEEP == 0:
                    true_deg[tick * kept + step // _KEEP, i] = surface[i]
            amps += 0.1 * (total - amps)
            volts = supply[0] - throttle_v - supply[1] * amps * 1.5 - 0.0006 * t
        for i in range(count):
            previous[i] = sent[i]
        # the airframe
        if ground > 0.5:
            p = q = r = 0.0
            phi *= 0.9
            theta *= 0.9
            alpha = beta = 0.0
        else:
            fade = np.exp(-_TICK_S / 0.4)
            gust_p = fade * gust_p + 0.35 * turbulence * gusts[tick, 0]
            gust_w = fade * gust_w + 0.020 * turbulence * gusts[tick, 1]
            gust_v = fade * gust_v + 0.020 * turbulence * gusts[tick, 2]
            roll_deg, pitch_deg, yaw_deg = 0.5 * (surface[0] - surface[1]), surface[2], surface[3]
            for _ in range(2):
                h = 0.5 * _TICK_S
                p += h * (a[0] * ratio * -9.0 * p + a[1] * pressure * 1.6 * roll_deg + gust_p - 3.0 * pressure * beta)
                q += h * (
                    a[2] * ratio * -5.0 * q
                    - a[3] * pressure * 25.0 * (alpha + gust_w)
                    + a[4] * pressure * 0.9 * (pitch_deg - 1.5)
                )
                alpha += h * (q - a[5] * ratio * 4.0 * (alpha + gust_w))
                r += h * (
                    a[6] * ratio * -2.0 * r + a[7] * pressure * 12.0 * (beta + gust_v) + a[8] * pressure * 0.4 * yaw_deg
                )
                beta += h * (-r - a[9] * ratio * 1.0 * (beta + gust_v) + 0.3 * phi * a[10] - 0.3 * beta)
                phi += h * p
                theta += h * (q * np.cos(phi) - 0.25 * theta)
            if phi > np.pi:
                phi -= 2.0 * np.pi
            elif phi < -np.pi:
                phi += 2.0 * np.pi
            p, q, r = min(8.0, max(-8.0, p)), min(4.0, max(-4.0, q)), min(3.0, max(-3.0, r))
            alpha, beta = min(0.4, max(-0.4, alpha)), min(0.4, max(-0.4, beta))
        air[tick, 0] = max(0.0, speed * (1.0 + 0.03 * gust_w * 50.0) + 0.3 * gusts[tick, 3])
        air[tick, 1] = volts
    return true_deg, pulses, air


def _logged(
    rng: np.random.Generator, aircraft: Stranger, servos: tuple[Servo, ...], number: int, style: str,
    failure: Failure | None, phases: tuple[tuple[str, float, float], ...],
    true_deg: Floats, pulses: Floats, air: Floats,
) -> Flight:  # fmt: skip
    """What of it reaches the log."""
    duration_s = pulses.shape[0] * _TICK_S
    true_s: Floats = np.arange(true_deg.shape[0], dtype=np.float64) * _STEP_S * _KEEP
    every = max(1, round(1.0 / aircraft.command_hz / _TICK_S))
    command_s = np.arange(0, pulses.shape[0], every, dtype=np.float64) * _TICK_S
    period_s = 1.0 / aircraft.position_hz
    position_s: Floats = np.arange(rng.uniform(0.0, period_s), duration_s, period_s)
    jitter_s = 0.08 * period_s * np.abs(rng.normal(size=position_s.size))
    skewed_s = position_s + jitter_s
    measured_deg = np.empty((position_s.size, len(servos)))
    late_jitter_s = 0.002 * rng.normal(size=position_s.size)
    for i, servo in enumerate(servos):
        deg: Floats = np.interp(skewed_s - servo.late_s + late_jitter_s, true_s, true_deg[:, i])
        deg = _hysteresis(deg, servo.hysteresis_deg)
        deg = deg + servo.nonlinear_deg * np.sin(servo.waves * deg * np.pi / 25.0 + i)
        drift = np.cumsum(rng.normal(size=deg.size)) * servo.drift_deg * np.sqrt(period_s / 240.0)
        pink = _pink(rng, deg.size, period_s) * servo.pink_deg
        deg = deg + servo.bias_deg + drift + pink + servo.white_deg * rng.normal(size=deg.size)
        measured_deg[:, i] = np.round(deg / servo.step_deg) * servo.step_deg
    # feedback stamped by another clock
    stamped_s: Floats = skewed_s * (1.0 + 1e-6 * aircraft.ppm)
    lost = rng.uniform(size=measured_deg.shape) < aircraft.lost
    measured_deg[lost] = np.nan
    keep_p, keep_c = np.ones(position_s.size, np.bool_), np.ones(command_s.size, np.bool_)
    for burst_s in np.cumsum(rng.exponential(60.0, 40)):
        length_s, which = rng.exponential(0.25) + 0.05, rng.uniform()
        if which < 0.7:
            keep_p &= (position_s < burst_s) | (position_s > burst_s + length_s)
        if which > 0.4:
            keep_c &= (command_s < burst_s) | (command_s > burst_s + length_s)
    rows = slice(None, None, every)
    return Flight(
        aircraft, number, style, failure,
        command_s[keep_c], pulses[rows][keep_c], stamped_s[keep_p], measured_deg[keep_p],
        air[rows, 0][keep_c], air[rows, 1][keep_c], phases, true_s=true_s, true_deg=true_deg,
    )  # fmt: skip


def _hysteresis(values: Floats, width: float) -> Floats:
    out, state = np.empty_like(values), values[0]
    for k, value in enumerate(values):
        state = min(value + 0.5 * width, max(value - 0.5 * width, state))
        out[k] = state
    return out


def _pink(rng: np.random.Generator, size: int, period_s: float) -> Floats:
    """1/f noise of unit variance an octave: first-order noises, each twice as slow as the one before."""
    from scipy.signal import lfilter

    total = np.zeros(size)
    for octave in range(8):
        pole = np.exp(-period_s / (0.2 * 2.0**octave))
        total += lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.normal(size=size))
    return total / 2.0
