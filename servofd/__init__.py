"""servofd tells which servo of an aircraft is lying, from its flight log.

The names below are the public interface; each is imported when it is first used, so that ``import servofd``
costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from servofd.version import __version__ as __version__

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft as Aircraft
    from servofd.aircraft.schema import Surface as Surface
    from servofd.aircraft.schema import load_aircraft as load_aircraft
    from servofd.aircraft.series import Series as Series
    from servofd.aircraft.series import cut as cut
    from servofd.core.errors import ServofdError as ServofdError
    from servofd.detection.audit import audit_log as audit_log
    from servofd.detection.nullspace import design_nullspace_filter as design_nullspace_filter
    from servofd.detection.pulse import design_pulse_filter as design_pulse_filter
    from servofd.detection.residual import ResidualGenerator as ResidualGenerator
    from servofd.detection.verdict import LogAudit as LogAudit
    from servofd.detection.verdict import SurfaceAudit as SurfaceAudit
    from servofd.discrepancy.explanation import Explanation as Explanation
    from servofd.discrepancy.explanation import explain_gap as explain_gap
    from servofd.identification.result import Identification as Identification
    from servofd.jobs.explaining import explain_logs as explain_logs
    from servofd.results.audits import Audit as Audit
    from servofd.results.audits import Audits as Audits
    from servofd.results.audits import Comparison as Comparison
    from servofd.results.audits import Fleet as Fleet
    from servofd.results.audits import audit as audit
    from servofd.results.audits import compare as compare
    from servofd.results.audits import fleet as fleet
    from servofd.results.audits import load as load
    from servofd.results.models import calibrate as calibrate
    from servofd.results.models import explain as explain
    from servofd.results.models import identify as identify
    from servofd.results.models import simulate as simulate
    from servofd.results.models import trend as trend
    from servofd.servo.effect import Effect as Effect
    from servofd.servo.effect import Parameter as Parameter
    from servofd.servo.effect import Slot as Slot
    from servofd.servo.library import Servo as Servo
    from servofd.servo.library import library as library
    from servofd.servo.library import servo_named as servo_named
    from servofd.servo.servo_model import ServoModel as ServoModel
    from servofd.servo.transfer import TransferFunction as TransferFunction
    from servofd.simulation.flight import simulate_flight as simulate_flight

_NAMES = {
    "aircraft.schema": "Aircraft Surface load_aircraft",
    "aircraft.series": "Series cut",
    "core.errors": "ServofdError",
    "detection.audit": "audit_log",
    "detection.nullspace": "design_nullspace_filter",
    "detection.pulse": "design_pulse_filter",
    "detection.residual": "ResidualGenerator",
    "detection.verdict": "LogAudit SurfaceAudit",
    "discrepancy.explanation": "Explanation explain_gap",
    "identification.result": "Identification",
    "jobs.explaining": "explain_logs",
    "results.audits": "Audit Audits Comparison Fleet audit compare fleet load",
    "results.models": "calibrate explain identify simulate trend",
    "servo.effect": "Effect Parameter Slot",
    "servo.library": "Servo library servo_named",
    "servo.servo_model": "ServoModel",
    "servo.transfer": "TransferFunction",
    "simulation.flight": "simulate_flight",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = list(_HOME)


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'servofd' has no attribute {name!r}")
    return getattr(import_module(f"servofd.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted((*__all__, "__version__"))
