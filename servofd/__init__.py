"""servofd tells which servo of an aircraft is lying, from its flight log.

The names below are the public interface; each is imported when it is first used, so that ``import servofd``
costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from servofd.version import __version__ as __version__

if TYPE_CHECKING:
    from servofd.aircraft import Aircraft as Aircraft
    from servofd.aircraft import Surface as Surface
    from servofd.aircraft import load_aircraft as load_aircraft
    from servofd.detection.audit import audit_log as audit_log
    from servofd.detection.nullspace import design_nullspace_filter as design_nullspace_filter
    from servofd.detection.pulse import design_pulse_filter as design_pulse_filter
    from servofd.detection.residual import ResidualGenerator as ResidualGenerator
    from servofd.detection.verdict import LogAudit as LogAudit
    from servofd.detection.verdict import SurfaceAudit as SurfaceAudit
    from servofd.discrepancy.explanation import Explanation as Explanation
    from servofd.discrepancy.explanation import explain_gap as explain_gap
    from servofd.discrepancy.own import OwnEffect as OwnEffect
    from servofd.discrepancy.own import OwnParameter as OwnParameter
    from servofd.errors import ServofdError as ServofdError
    from servofd.explaining import explain_log as explain_log
    from servofd.explaining import explain_logs as explain_logs
    from servofd.fleet.run import audit_logs as audit_logs
    from servofd.identification.result import Identification as Identification
    from servofd.models.servo_model import ServoModel as ServoModel
    from servofd.models.transfer import TransferFunction as TransferFunction
    from servofd.results import Audit as Audit
    from servofd.results import Audits as Audits
    from servofd.results import audit as audit
    from servofd.results import calibrate as calibrate
    from servofd.results import explain as explain
    from servofd.results import identify as identify
    from servofd.results import trend as trend
    from servofd.segment import Segment as Segment
    from servofd.segment import cut as cut
    from servofd.servos import Servo as Servo
    from servofd.servos import library as library
    from servofd.servos import servo_named as servo_named
    from servofd.simulation.flight import simulate_flight as simulate_flight

_HOME = {
    "Aircraft": "aircraft",
    "Audit": "results",
    "Audits": "results",
    "Explanation": "discrepancy.explanation",
    "Identification": "identification.result",
    "LogAudit": "detection.verdict",
    "OwnEffect": "discrepancy.own",
    "OwnParameter": "discrepancy.own",
    "ResidualGenerator": "detection.residual",
    "Segment": "segment",
    "Servo": "servos",
    "ServoModel": "models.servo_model",
    "ServofdError": "errors",
    "Surface": "aircraft",
    "SurfaceAudit": "detection.verdict",
    "TransferFunction": "models.transfer",
    "audit": "results",
    "audit_logs": "fleet.run",
    "calibrate": "results",
    "audit_log": "detection.audit",
    "cut": "segment",
    "design_nullspace_filter": "detection.nullspace",
    "design_pulse_filter": "detection.pulse",
    "explain": "results",
    "explain_gap": "discrepancy.explanation",
    "explain_log": "explaining",
    "explain_logs": "explaining",
    "identify": "results",
    "library": "servos",
    "load_aircraft": "aircraft",
    "servo_named": "servos",
    "simulate_flight": "simulation.flight",
    "trend": "results",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'servofd' has no attribute {name!r}")
    return getattr(import_module(f"servofd.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted((*__all__, "__version__"))
