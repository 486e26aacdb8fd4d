"""What a calibration found, the aircraft that follows from it, and that as a commented TOML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from servofd.aircraft.calibrated import CalibratedServo, calibrated_to_toml, terms_to_toml
from servofd.aircraft.calibration import Calibration as Scale
from servofd.aircraft.current import REGRESSORS, CalibratedCurrent
from servofd.core.evidence import NOTHING_DETECTABLE, Detectable
from servofd.core.statistics import Estimate
from servofd.core.toml_text import toml_comment, toml_key, toml_lines, toml_value
from servofd.detection.seen import FALSE_ALARMS_PER_HOUR

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft
    from servofd.core.tolerance import Tolerance
    from servofd.servo.library import Servo


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedSurface:
    """One surface, fitted."""

    surface: str
    known: CalibratedServo
    """Servo, noise, differences between flights, thresholds."""
    estimates: Mapping[str, Estimate]
    """Of the parameters, with 95 % intervals."""
    bandwidth_rad_s: Estimate
    """Where its gain is 3 dB below that at rest."""
    effects: tuple[str, ...]
    """Effects that predict flights better which they were not fitted to, in words, the most telling first."""
    measured: Scale
    """Channel of the position, so scaled that it reads in degrees of the command."""
    servo: Servo
    """The linear part alone, for constant thresholds, simulations and the script on board."""
    tolerance: Tolerance
    """How far a good servo strays from the linear part."""
    threshold_deg: float
    """Constant threshold that the flights stayed below, with a margin [deg]."""
    held_out_rms_deg: float
    explained_share: float
    flights: tuple[str, ...]
    """Names of the logs, without folders."""
    detectable: Detectable = NOTHING_DETECTABLE
    """What these flights would have shown."""
    sharper: str = ""
    """What more flights buy."""
    notes: tuple[str, ...] = ()
    """What a user should know before trusting it."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """An aircraft calibrated from good flights."""

    aircraft: Aircraft
    """Ready for an audit."""
    surfaces: tuple[CalibratedSurface, ...]
    kept: dict[str, str]
    """Surfaces left as they were, and why."""

    currents: tuple[str, ...] = ()
    """Surfaces whose current was calibrated."""
    without_current: Mapping[str, str] = field(default_factory=dict)
    """Surfaces whose current was logged and could not be calibrated, and why."""

    def with_currents(self, currents: Mapping[str, CalibratedCurrent], unfit: Mapping[str, str]) -> Calibration:
        """The same with the currents of good flights, by surface, and why those of others are `unfit`."""
        surfaces = {
            name: surface.model_copy(update={"healthy_current": currents.get(name, surface.healthy_current)})
            for name, surface in self.aircraft.surfaces.items()
        }
        aircraft = self.aircraft.model_copy(update={"surfaces": surfaces})
        kept = {name: reason for name, reason in self.kept.items() if name not in currents}
        return replace(self, aircraft=aircraft, currents=tuple(currents), kept=kept, without_current=unfit)

    @property
    def false_alarms_per_hour(self) -> float:
        """Of all surfaces that were calibrated, in flights like those of simulated aircraft of other physics."""
        return len(self.surfaces) * FALSE_ALARMS_PER_HOUR


def calibration_to_toml(calibration: Calibration) -> str:
    """Text of an aircraft file that `servofd audit -c` accepts, with intervals and provenance as comments."""
    aircraft = calibration.aircraft
    logs = {label: None for one in calibration.surfaces for label in one.flights}
    named = toml_comment(", ".join(logs)) or "their currents"
    lines = [
        f"# Calibrated by `servofd calibrate` from {named}: flights taken to be good.",
        "# Numbers in square brackets behind a # are 95% intervals.",
        "",
        f"name = {toml_value(aircraft.name)}",
    ]
    if aircraft.table is not None:
        lines += ["", "[table]", *toml_lines(aircraft.table.model_dump(exclude_defaults=True))]
    found = {one.surface: one for one in calibration.surfaces}
    for name in aircraft.surfaces:
        lines += ["", *_surface(calibration, name, found.get(name))]
    for name, servo in aircraft.servos.items():
        lines += ["", *[f"[servos.{toml_key(name)}]", *toml_lines(servo.model_dump(exclude_defaults=True))]]
    return "\n".join(lines) + "\n"


def _surface(calibration: Calibration, name: str, one: CalibratedSurface | None) -> list[str]:
    entry = calibration.aircraft.surfaces[name].model_dump(exclude_defaults=True)
    entry = {"servo": calibration.aircraft.surfaces[name].servo, **entry}
    known, drawn = entry.pop("calibrated", None), entry.pop("healthy_current", None)
    lines = [f"[surfaces.{toml_key(name)}]"]
    if one is None:
        why = "judged by its current" if name in calibration.currents else "not calibrated"
        reason = calibration.kept.get(name, "no position" if name in calibration.currents else "not asked for")
        lines += [f"# {why}: {toml_comment(reason)}", *toml_lines(entry)]
    else:
        lines += [f"# {effect}" for effect in one.effects]
        lines += [f"# note: {toml_comment(note)}" for note in (*one.notes, one.sharper) if note]
        comments = {
            "measured": "position in degrees of the command",
            "threshold_deg": "for `--threshold constant`",
            "tolerance": "of the linear servo alone: for the script on board, and for limits of wear",
        }
        entry.setdefault("threshold_deg", one.threshold_deg)
        lines += toml_lines(entry, comments)
    if drawn is not None:
        lines += terms_to_toml(f"surfaces.{toml_key(name)}.healthy_current", drawn, REGRESSORS)
    if known is None:
        return lines
    intervals = {} if one is None else {key: f"[{e.low:.4g}, {e.high:.4g}]" for key, e in one.estimates.items()}
    return [*lines, *calibrated_to_toml(name, known, intervals)]
