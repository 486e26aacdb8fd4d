"""The verbs as functions for a notebook: results that show themselves, and become a table, a figure or a page."""

from servofd.results.audits import Audit, Audits, Comparison, Fleet, audit, compare, fleet, load
from servofd.results.models import calibrate, explain, identify, trend
from servofd.results.simulated import simulate

__all__ = [
    "Audit",
    "Audits",
    "Comparison",
    "Fleet",
    "audit",
    "calibrate",
    "compare",
    "explain",
    "fleet",
    "identify",
    "load",
    "simulate",
    "trend",
]
