"""From the residual of one surface to named faults."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from servofd.detection.alarm import find_episodes
from servofd.detection.bank.isolate import SURE, Fault, Flight, isolate
from servofd.detection.bank.window import noise_deg
from servofd.detection.residual import commands_at_servo
from servofd.detection.threshold import Threshold, constant_threshold, interval_threshold, suspicion

if TYPE_CHECKING:
    from servofd.aircraft import Surface
    from servofd.detection.alarm import Episode
    from servofd.detection.residual import ResidualGenerator, Residuals
    from servofd.segment import Segment

__all__ = ["Judgement", "judge"]


class Judgement(NamedTuple):
    """What was found, and against which threshold."""

    threshold: Threshold
    faults: tuple[Fault, ...]
    suspicions: tuple[Fault, ...]
    """What only the cumulative sum noticed, or the tolerances of a working servo explain."""


def judge(generator: ResidualGenerator, segment: Segment, residuals: Residuals, surface: Surface) -> Judgement:
    """Compare the residual with its threshold, and name each alarm.

    Parameters
    ----------
    generator : ResidualGenerator
        Healthy model and filter.
    segment : Segment
        Commands and measurements.
    residuals : Residuals
        What the generator makes of the segment.
    surface : Surface
        Its threshold, persistence and tolerances.

    Returns
    -------
    Judgement
        Faults and suspicions in order of time.
    """
    threshold = interval_threshold(generator, segment, residuals, surface.tolerances, surface.threshold_sigmas)
    if surface.threshold == "constant":
        threshold = constant_threshold(threshold, surface.threshold_deg)
    suspects = suspicion(residuals, threshold) if surface.tells_small_faults else None
    episodes = find_episodes(residuals, threshold, persistence=surface.persistence, suspicion=suspects)
    if not episodes:
        return Judgement(threshold, (), ())
    commands = commands_at_servo(segment, generator.model.plan.delay_s, generator.longest_gap_s(segment))
    noise = noise_deg(residuals.error_deg[residuals.settled])
    flight = Flight(generator.model, surface.tolerances, noise, residuals, commands)
    named = [fault for episode in episodes for fault in _confirmed(isolate(flight, episode), episode, threshold)]
    faults = tuple(fault for fault in named if fault.level == "fault" and fault.kind != "healthy")
    return Judgement(threshold, faults, tuple(fault for fault in named if fault not in faults))


def _confirmed(named: tuple[Fault, ...], episode: Episode, threshold: Threshold) -> tuple[Fault, ...]:
    """Suspicions that the bank can name for sure are alarms, unless a constant threshold says what is large enough."""
    first = named[0]
    sure = first.probability >= SURE and first.kind not in ("healthy", "unknown")
    if threshold.kind == "constant" or not sure:
        return named
    alarm_s = first.alarm_s if episode.suspected_s is None else max(episode.suspected_s, first.start_s)
    return (replace(first, level="fault", alarm_s=alarm_s), *named[1:])
