"""Aeroplanes of JSBSim: airframes, air and engine by others, DC motors at 2 kHz; judged with and without a file.

``python benchmarks/jsbsim_flights.py [--first SEED] [--aircraft N] [--healthy N] [--faulty N]`` flies N aeroplanes of
every second seed, calibrates each on one good flight, and audits its other flights with that file and with none.
JSBSim has to be installed: ``pip install jsbsim``. Nothing here is shared with servofd or with `strangers`.

A fault counts as visible by what it does: the 95th percentile, after its onset, of the distance between the surface
and a sound servo that gets the same commands. **Even seeds may be looked at, odd ones are reported.**
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import jsbsim
import numpy as np
from numba import njit
from numpy.typing import NDArray

import servofd
from servofd import ServofdError

if TYPE_CHECKING:
    from collections.abc import Sequence

Floats = NDArray[np.float64]

SURFACES: Final = ("aileron_left", "aileron_right", "elevator", "rudder")
KINDS: Final = (
    "stuck", "hardover", "bias", "loss_of_effectiveness", "slow", "deadband", "floating", "oscillation", "intermittent",
)  # fmt: skip
STYLES: Final = ("calm", "ordinary", "brisk")
_ALIKE: Final = {("floating", "stuck"), ("stuck", "floating"), ("floating", "hardover"), ("stuck", "hardover")}
"""A geared servo without power stays where it is, and where it stopped may be as far as it ever was."""
_MODELS: Final = (("c172p", 95.0), ("c172r", 95.0), ("c182", 110.0), ("T37", 210.0))
"""Aeroplanes of JSBSim, and calibrated airspeeds that they are flown at [kt]."""
_TRAVEL_DEG: Final = np.array([20.0, 20.0, 25.0, 25.0])
_STEP_S, _TICKS, _STEPS = 0.0005, 4, 10
"""Step of the servos; steps of the airframe from one command to the next; of the servos from one such to the next."""
_FLIGHT_S: Final = 165.0
_SHOWN_DEG: Final = (5.0, 2.0, 1.0)
_M_S_PER_KT, _PULSE_DEG = 0.5144, 0.05


@dataclass(frozen=True)
class Aeroplane:
    """What stays the same from flight to flight; arrays have a row for each surface."""

    seed: int
    model: str
    airspeed_kt: float
    servos: Floats
    """Speed without load [deg/s], mechanical time constant [s], error at full drive [deg], velocity feedback, Coulomb
    friction and hinge moment at full deflection (over the stall torque), dead band and backlash [deg]; shape (4, 8)."""
    position_hz: float
    command_hz: float
    step_deg: float
    late_s: float
    noise_deg: float
    freezes: bool
    """Whether its bus stands still for half a second now and then."""
    repeats: bool
    """Whether its logger repeats the last value where none arrived."""


class Fault(NamedTuple):
    """What breaks."""

    kind: str
    surface: int
    start_s: float
    size: float


class Flown(NamedTuple):
    """A flight: a table of its log, and how far the surface stood from a sound one [deg]."""

    table: str
    apart_deg: float


def aeroplane(seed: int) -> Aeroplane:
    """Draw an aeroplane."""
    rng = np.random.default_rng([seed, 7])
    model, airspeed_kt = _MODELS[seed // 2 % len(_MODELS)]
    kind = np.array(
        [
            rng.uniform(150.0, 420.0), rng.uniform(0.02, 0.07), rng.uniform(4.0, 9.0), rng.uniform(0.6, 1.2),
            rng.uniform(0.02, 0.08), rng.uniform(0.05, 0.25), rng.uniform(0.05, 0.4), rng.uniform(0.05, 0.5),
        ]
    )  # fmt: skip
    servos = kind * np.exp(0.06 * rng.standard_normal((4, kind.size)))
    return Aeroplane(
        seed, model, airspeed_kt, servos, float(rng.choice([10.0, 25.0, 50.0])), float(rng.choice([25.0, 50.0])),
        float(rng.choice([0.05, 0.1, 0.25])), float(rng.uniform(0.005, 0.06)), float(rng.uniform(0.02, 0.15)),
        bool(rng.random() < 0.25), bool(rng.random() < 0.25),
    )  # fmt: skip


@njit(cache=True)  # type: ignore[untyped-decorator]
def _moved(
    state: Floats,
    target_deg: Floats,
    servos: Floats,
    volts: float,
    load: float,
    torque: Floats,
    held: NDArray[np.bool_],
) -> None:
    """Move all servos by one step of the airframe; `state` holds shaft, its speed, and surface, shape (n, 3)."""
    for k in range(state.shape[0]):
        speed, time_s, band, damping, friction, hinge, dead, play = servos[k]
        shaft, rate, surface = state[k]
        most = speed / time_s
        for _ in range(_STEPS):
            error = target_deg[k] - shaft
            error = 0.0 if abs(error) < dead else error
            drive = max(-1.0, min(1.0, error / band - damping * rate / speed * 0.5))
            push = torque[k] * (volts * drive - rate / speed) if torque[k] > 0.0 else -0.2 * rate / speed
            push -= hinge * load * surface / 20.0
            rub = friction * (1.0 if torque[k] > 0.0 else 1.5)
            if abs(rate) < most * _STEP_S and abs(push) < 1.4 * rub:  # stiction
                rate = 0.0
            else:
                way = 1.0 if rate > 0.0 or (rate == 0.0 and push > 0.0) else -1.0
                after = rate + most * _STEP_S * (push - way * rub)
                rate = 0.0 if rate != 0.0 and after * rate < 0.0 and abs(push) < 1.4 * rub else after
            if held[k]:
                rate = 0.0
            shaft += rate * _STEP_S
            low, high = shaft - 0.5 * play, shaft + 0.5 * play
            surface += -0.5 * load * np.sign(surface) * _STEP_S  # the air takes up the play
            surface = max(low, min(high, surface))
        state[k, 0], state[k, 1], state[k, 2] = shaft, rate, surface


def _wishes(rng: np.random.Generator, style: str) -> Floats:
    """Bank, pitch, stick (four surfaces) at each tenth of a second, shape (n, 6) [deg]."""
    n = int(_FLIGHT_S * 10.0) + 2
    out = np.zeros((n, 6))
    bank, pitch = {"calm": (12.0, 2.0), "ordinary": (30.0, 5.0), "brisk": (45.0, 8.0)}[style]
    edges = np.cumsum(rng.uniform(3.0, {"calm": 20.0, "ordinary": 12.0, "brisk": 7.0}[style], 120) * 10.0).astype(int)
    for begin, end in pairwise([0, *edges[edges < n].tolist(), n]):
        out[begin:end, 0] = rng.choice([0.0, -1.0, 1.0]) * bank * rng.uniform(0.4, 1.0)
        out[begin:end, 1] = rng.uniform(-pitch, pitch)
        if style != "calm" and rng.random() < 0.6:  # a doublet of one control
            stick, length = int(rng.integers(2, 6)), int(rng.integers(4, 15))
            size = rng.uniform(4.0, 12.0) * (1.0 if style == "ordinary" else 1.4)
            out[begin : begin + length, stick] = size
            out[begin + length : begin + 2 * length, stick] = -size
    return out


class _Servos:
    """The servos of one flight; behind the four, the one that fails as it would be if it were sound."""

    def __init__(self, rng: np.random.Generator, plane: Aeroplane, fault: Fault | None) -> None:
        self.fault, self.volts = fault, float(rng.uniform(0.92, 1.05))
        self.sizes = plane.servos * np.exp(0.04 * rng.standard_normal((4, 1)) * (np.arange(8) == 4))
        if fault is not None:
            self.sizes = np.vstack([self.sizes, self.sizes[fault.surface]])
        count = self.sizes.shape[0]
        self.state, self.target, self.held = np.zeros((count, 3)), np.zeros(count), np.zeros(count, dtype=bool)
        self.torque, self.gain, self.offset = np.ones(count), np.ones(count), np.zeros(count)
        self.last_deg = 0.0

    def ask(self, asked_deg: Floats, time_s: float) -> None:  # noqa: C901 - one case for each kind
        """Take the commands of one instant, in the state in which the servos are then."""
        self.target[:4] = asked_deg
        if self.fault is None:
            return
        kind, k, start_s, size = self.fault
        self.target[4] = asked_deg[k]
        since_s = time_s - start_s
        if since_s < 0.0:
            return
        match kind:
            case "stuck":
                self.held[k] = True
            case "hardover":
                self.target[k] = size * _TRAVEL_DEG[k]
            case "bias":
                self.offset[k] = size
            case "loss_of_effectiveness":
                self.gain[k] = size
            case "slow":
                self.torque[k], self.sizes[k, 0] = size, self.sizes[4, 0] * size
            case "deadband":
                self.sizes[k, 7] = self.sizes[4, 7] + size
            case "floating":
                self.torque[k] = 0.0
            case "oscillation":
                self.target[k] += size * np.sin(2.0 * np.pi * 3.0 * since_s)
            case "intermittent":
                if since_s % 6.0 < size:
                    self.target[k] = self.last_deg
                self.last_deg = self.target[k]

    def moved(self, load: float) -> Floats:
        """Where the surfaces stand a step of the airframe later, shape (4 or 5,) [deg]."""
        _moved(self.state, self.target, self.sizes, self.volts, load, self.torque, self.held)
        stood: Floats = self.gain * self.state[:, 2] + self.offset
        return stood


def _airframe(rng: np.random.Generator, plane: Aeroplane, style: str) -> Any:  # noqa: ANN401 - JSBSim has no types
    """The aeroplane of JSBSim in straight flight, in turbulent air."""
    model = jsbsim.FGFDMExec(None)
    model.set_debug_level(0)
    model.load_model(plane.model)
    model.set_dt(_STEPS * _STEP_S)
    model["ic/h-sl-ft"], model["ic/vc-kts"], model["ic/gamma-deg"] = 3000.0, plane.airspeed_kt, 0.0
    model["simulation/randomseed"] = float(rng.integers(1, 10_000))
    model.run_ic()
    model["propulsion/set-running"] = -1.0
    model["fcs/mixture-cmd-norm"], model["gear/gear-cmd-norm"] = 0.9, 0.0
    model["atmosphere/turb-type"] = 3.0  # Milspec
    model["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = float(rng.uniform(5.0, 40.0))
    model["atmosphere/turbulence/milspec/severity"] = float(rng.integers(2, 5 if style != "calm" else 3))
    return model


class _Autopilot:
    """Holds bank and pitch, and damps yaw; gains go with the inverse of the dynamic pressure."""

    def __init__(self) -> None:
        self.integral = np.zeros(2)

    def commands(self, model: Any, wish: Floats, airspeed_m_s: float, load: float) -> Floats:  # noqa: ANN401
        """Commands of the four surfaces, in steps of a pulse's microsecond [deg]."""
        bank, pitch = model["attitude/phi-rad"], model["attitude/theta-rad"]
        p, q, r = (model[f"velocities/{axis}-rad_sec"] for axis in "pqr")
        scale = 1.0 / max(load, 0.4)
        error = np.deg2rad(wish[:2] + np.array([0.0, 2.0])) - np.array([bank, pitch])
        self.integral = np.clip(self.integral + 0.02 * error, -0.5, 0.5)
        roll = np.rad2deg(0.7 * error[0] - 0.2 * p) * scale + 3.0 * self.integral[0]
        nose = -np.rad2deg(1.0 * error[1] - 0.4 * q) * scale - 10.0 * self.integral[1]
        yaw = np.rad2deg(0.5 * (r - 9.81 / max(airspeed_m_s, 20.0) * np.sin(bank))) * scale
        asked = np.array([roll, roll, nose, yaw]) + wish[2:]
        out: Floats = np.clip(np.round(asked / _PULSE_DEG) * _PULSE_DEG, -_TRAVEL_DEG, _TRAVEL_DEG)
        return out


def fly(plane: Aeroplane, number: int, style: str, fault: Fault | None = None) -> Flown:
    """Fly one flight of `_FLIGHT_S` from straight flight at 3000 ft on."""
    rng = np.random.default_rng([plane.seed, number])
    model, wishes = _airframe(rng, plane, style), _wishes(rng, style)
    servos, autopilot = _Servos(rng, plane, fault), _Autopilot()
    ticks = int(_FLIGHT_S / (_TICKS * _STEPS * _STEP_S))
    command, surface = np.zeros((ticks, 4)), np.zeros((ticks * _TICKS, servos.gain.size))
    airspeed_m_s = np.zeros(ticks)
    for tick in range(ticks):
        time_s = tick * _TICKS * _STEPS * _STEP_S
        airspeed_m_s[tick] = model["velocities/vtrue-kts"] * _M_S_PER_KT
        load = (airspeed_m_s[tick] / (plane.airspeed_kt * _M_S_PER_KT)) ** 2
        command[tick] = autopilot.commands(model, wishes[int(10.0 * time_s)], airspeed_m_s[tick], load)
        servos.ask(command[tick], time_s)
        faster_kt = plane.airspeed_kt - model["velocities/vc-kts"]
        model["fcs/throttle-cmd-norm"] = float(np.clip(0.6 + 0.03 * faster_kt, 0.0, 1.0))
        for part in range(_TICKS):
            stood = servos.moved(load)
            surface[tick * _TICKS + part] = stood
            model["fcs/aileron-cmd-norm"] = 0.5 * (stood[0] + stood[1]) / _TRAVEL_DEG[0]
            model["fcs/elevator-cmd-norm"] = stood[2] / _TRAVEL_DEG[2]
            model["fcs/rudder-cmd-norm"] = -stood[3] / _TRAVEL_DEG[3]
            model.run()
    apart_deg = 0.0
    if fault is not None:
        after = surface[int(fault.start_s / (_STEPS * _STEP_S)) :]
        apart_deg = float(np.quantile(np.abs(after[:, fault.surface] - after[:, 4]), 0.95))
    return Flown(_table(rng, plane, command, surface[:, :4], airspeed_m_s), apart_deg)


def _table(rng: np.random.Generator, plane: Aeroplane, command: Floats, surface: Floats, airspeed_m_s: Floats) -> str:
    """What the logger writes."""
    step_s = _STEPS * _STEP_S
    rows: list[tuple[float, list[float]]] = []
    every = round(1.0 / (plane.command_hz * _TICKS * step_s))
    empty = [np.nan] * 8
    for tick in range(0, command.shape[0], every):
        row = empty.copy()
        row[::2] = command[tick].tolist()
        rows.append((tick * _TICKS * step_s, [*row, float(airspeed_m_s[tick])]))
    at_s = np.arange(0.1, _FLIGHT_S - 0.1, 1.0 / plane.position_hz) + rng.uniform(0.0, 0.004)
    slope = 1.0 + 0.01 * rng.standard_normal(4)
    zero = 0.15 * rng.standard_normal(4)
    freezes_s = np.sort(rng.uniform(5.0, _FLIGHT_S, 4)) if plane.freezes else np.zeros(0)
    last = [0.0] * 4
    for time_s in at_s.tolist():
        true = surface[min(int(time_s / step_s), surface.shape[0] - 1)]
        read = slope * true + zero + plane.noise_deg * rng.standard_normal(4)
        read = np.round(read / plane.step_deg) * plane.step_deg
        lost = rng.random(4) < 0.01
        if any(begin <= time_s < begin + 0.6 for begin in freezes_s):
            read = np.array(last)
        elif plane.repeats:
            read = np.where(lost, last, read)
        else:
            read = np.where(lost, np.nan, read)
        last = np.where(np.isfinite(read), read, last).tolist()
        row = empty.copy()
        row[1::2] = read.tolist()
        rows.append((time_s + plane.late_s, [*row, np.nan]))
    rows.sort(key=lambda row: row[0])
    names = [f"{name}_{what}_deg" for name in SURFACES for what in ("cmd", "pos")]
    lines = [",".join(["time_s", *names, "airspeed_m_s"])]
    for time_s, values in rows:
        lines.append(",".join([f"{time_s:.4f}", *("" if np.isnan(v) else f"{v:.3f}" for v in values)]))
    return "\n".join(lines) + "\n"


def _drawn(seed: int, number: int) -> Fault:
    rng = np.random.default_rng([seed, number, 3])
    kind = KINDS[(number + seed) % len(KINDS)]
    sizes = {"loss_of_effectiveness": (0.3, 0.8), "slow": (0.15, 0.5), "deadband": (1.5, 5.0)}
    sizes |= {"oscillation": (1.0, 4.0), "intermittent": (0.5, 1.5), "bias": (1.0, 5.0)}
    size = float(rng.uniform(*sizes.get(kind, (1.0, 1.0))))
    if kind in {"hardover", "bias"}:
        size *= float(rng.choice([-1.0, 1.0]))
    return Fault(kind, int(rng.integers(4)), float(rng.uniform(35.0, 110.0)), float(size))


class Said(NamedTuple):
    """What became of one flight, judged one way."""

    way: str
    style: str
    fault: Fault | None
    apart_deg: float
    statuses: dict[str, str]
    kinds: tuple[str, ...]
    seed: int
    number: int


def judged(seed: int, healthy: int, faulty: int) -> list[Said]:
    """All flights of one aeroplane, both ways."""
    plane = aeroplane(seed)
    out = []
    with tempfile.TemporaryDirectory() as folder:
        good = Path(folder) / "good.csv"
        good.write_text(fly(plane, 0, "ordinary").table)
        ways: dict[str, Any] = {"no file": None}
        try:
            ways["calibrated"] = servofd.calibrate(good).aircraft
        except ServofdError as error:
            print(f"aeroplane {seed} ({plane.model}): not calibrated: {error}", flush=True)
        for number in range(1, 1 + healthy + faulty):
            fault = _drawn(seed, number) if number > healthy else None
            style = STYLES[(number + seed // 2) % len(STYLES)]
            flown = fly(plane, number, style, fault)
            path = Path(folder) / f"flight_{number}.csv"
            path.write_text(flown.table)
            for way, known in ways.items():
                (found,) = servofd.audit(path) if known is None else servofd.audit(path, aircraft=known)
                kinds = () if fault is None else tuple(each.kind for each in found[SURFACES[fault.surface]].faults)
                statuses = {each.surface: each.status for each in found.surfaces}
                out.append(Said(way, style, fault, flown.apart_deg, statuses, kinds, seed, number))
    return out


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=1, metavar="SEED")
    parser.add_argument("--aircraft", type=int, default=12, metavar="N")
    parser.add_argument("--healthy", type=int, default=6, metavar="N", help="healthy flights of each")
    parser.add_argument("--faulty", type=int, default=11, metavar="N", help="faulty flights of each")
    options = parser.parse_args()
    seeds = range(options.first, options.first + 2 * options.aircraft, 2)
    with ProcessPoolExecutor() as pool:
        every = list(pool.map(partial(judged, healthy=options.healthy, faulty=options.faulty), seeds))
    said = [one for each in every for one in each]
    for way in ("no file", "calibrated"):
        _print(way, [one for one in said if one.way == way])


def _print(way: str, said: Sequence[Said]) -> None:
    sound = [one for one in said if one.fault is None]
    at_fault = [one for one in sound if "fault" in one.statuses.values()]
    clear = sum(set(one.statuses.values()) <= {"healthy", "unknown"} for one in sound)
    print(f"{way}: {len(sound)} healthy flights, {len(at_fault)} at fault, {clear} without a word against them")
    print("  surfaces:", dict(Counter(status for one in sound for status in one.statuses.values())))
    for one in at_fault:
        print(f"   false: aeroplane {one.seed}, flight {one.number}, {one.style}, {one.statuses}")
    broken = [(one, one.fault, SURFACES[one.fault.surface]) for one in said if one.fault is not None]
    others = [status for one, _, failed in broken for name, status in one.statuses.items() if name != failed]
    print("  sound surfaces beside a faulty one:", dict(Counter(others)))
    for low, high in zip((*_SHOWN_DEG, 0.0), (np.inf, *_SHOWN_DEG), strict=True):
        some = [each for each in broken if low <= each[0].apart_deg < high]
        verdicts = Counter(one.statuses[failed] for one, _, failed in some)
        named = sum(
            any(kind == fault.kind or (fault.kind, kind) in _ALIKE for kind in one.kinds) for one, fault, _ in some
        )
        print(f"  faults that move it by {low:g} to {high:g} deg: {len(some)}: {dict(verdicts)}, {named} named")
    for one, fault, failed in broken:
        if one.apart_deg >= _SHOWN_DEG[-1] and one.statuses[failed] != "fault":
            print(f"   {one.seed} {one.number} {one.style} {fault} {one.apart_deg:.1f} deg: {one.statuses[failed]}")


if __name__ == "__main__":
    main()
