"""How often noise alone raises an alarm, how often a fault is missed, and how long it takes to be seen."""

from servofd.detection.probability.cusum import CusumDesign, cusum, design_cusum
from servofd.detection.probability.missed import Detection, bias_response, detect, smallest_bias_deg
from servofd.detection.probability.noise import Noise
from servofd.detection.probability.persistence import (
    persistent_delay_s,
    persistent_false_alarms_per_hour,
    persistent_threshold_deg,
)
from servofd.detection.probability.tail import Quoted, TailFit, fit_tail
from servofd.detection.probability.upcrossing import false_alarms_per_hour, threshold_for_rate_deg

__all__ = [
    "CusumDesign",
    "Detection",
    "Noise",
    "Quoted",
    "TailFit",
    "bias_response",
    "cusum",
    "design_cusum",
    "detect",
    "false_alarms_per_hour",
    "fit_tail",
    "persistent_delay_s",
    "persistent_false_alarms_per_hour",
    "persistent_threshold_deg",
    "smallest_bias_deg",
    "threshold_for_rate_deg",
]
