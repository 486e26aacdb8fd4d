"""From the residual of one surface to named faults."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.core.frozen import held_rows
from servofd.detection.alarm import find_episodes
from servofd.detection.bank.isolate import confirmed, has_recovered, isolate, joined
from servofd.detection.bank.window import Fault, Flight, noise_deg
from servofd.detection.contradiction import contradictions
from servofd.detection.residual import commands_at_servo
from servofd.detection.threshold import Threshold, constant_threshold, interval_threshold, suspicion

if TYPE_CHECKING:
    from servofd.aircraft.schema import Surface
    from servofd.aircraft.segment import Segment
    from servofd.core.types import BoolArray
    from servofd.detection.alarm import Episode
    from servofd.detection.residual import Commands, ResidualGenerator, Residuals

_MOST_EPISODES = 50
"""Of one surface that are named, which takes some 50 ms each: a threshold within the noise is crossed thousands of
times, and what matters is in the largest, and in what goes on."""

_SELDOM_S = 0.15
"""Commands further apart than this, where an autopilot gives 50 a second, are a link's choice of them."""
_AT_REST = ("stuck", "hardover")

ECHO_S = 3.0
"""Alarms so close to a contradiction are part of it."""


class Judgement(NamedTuple):
    """What was found, and against which threshold."""

    threshold: Threshold
    faults: tuple[Fault, ...]
    suspicions: tuple[Fault, ...]
    """What only the cumulative sum noticed, or the tolerances of a working servo explain."""
    unnamed: int = 0
    """Smaller episodes that nobody named, because there are too many."""


def judge(
    generator: ResidualGenerator, segment: Segment, residuals: Residuals, surface: Surface, *, dismiss: bool = True
) -> Judgement:
    """Compare the residual with its threshold, and name each alarm.

    Unless told not to, it dismisses an alarm that the tolerances of a working servo explain: that is a suspicion.
    """
    threshold = interval_threshold(generator, segment, residuals, surface.tolerances, surface.threshold_sigmas)
    if surface.threshold == "constant":
        threshold = constant_threshold(threshold, surface.threshold_deg)
    commands = commands_at_servo(segment, generator.model.plan.delay_s, generator.longest_gap_s(segment))
    judgement = judge_evaluated(generator, surface, residuals, threshold, None, commands, dismiss=dismiss)
    return _as_commanded(judgement, segment) if surface.model.origin == "fitted" else judgement


def judge_evaluated(
    generator: ResidualGenerator,
    surface: Surface,
    residuals: Residuals,
    threshold: Threshold,
    suspicious: BoolArray | None,
    commands: Commands,
    *,
    dismiss: bool = True,
    is_report: bool = True,
    quiet_s: float = np.inf,
) -> Judgement:
    """Name each alarm of a flight whose threshold is known, and whose suspicious samples may be.

    A model that was fitted to a log accuses only of what contradicts any servo; the rest is suspicious. What only
    reports tell may be left out. In flight an alarm that stands is over where the servo has surely moved as a healthy
    one since it became quiet [s].
    """
    is_fitted = surface.model.origin == "fitted"
    contradicted = contradictions(generator, residuals) if is_fitted else ()
    suspects = None
    if is_fitted:  # readings that are merely held are no ground for a suspicion
        residuals = _of_a_bus_in_time(generator, residuals)
    elif surface.tells_small_faults:
        suspects = suspicion(residuals, threshold) if suspicious is None else suspicious
    episodes = find_episodes(residuals, threshold, persistence=surface.persistence, suspicion=suspects)
    episodes = tuple(e for e in episodes if not any(_belongs(e, fault) for fault in contradicted))
    if not episodes:
        return Judgement(threshold, contradicted, ())
    unnamed = max(len(episodes) - _MOST_EPISODES, 0)
    if unnamed:
        episodes = _largest(episodes, residuals, threshold)
    noise = noise_deg(residuals.error_deg[residuals.settled])
    sigma_deg = float(np.median(threshold.sigma_deg))
    flight = Flight(generator, surface.tolerances, noise, sigma_deg, residuals, commands, is_report or is_fitted)
    if is_fitted:
        named = joined(flight, (replace(f, level="suspect") for e in episodes for f in isolate(flight, e)))
        return Judgement(threshold, contradicted, tuple(f for f in named if f.kind != "healthy"), unnamed)
    named = joined(flight, (fault for episode in episodes for fault in _named(flight, episode, threshold)))
    if not dismiss:
        named = tuple(_held(fault) for fault in named)
    if np.isfinite(quiet_s) and named and named[-1].end_s is None and has_recovered(flight, named[-1].kind, quiet_s):
        named = (*named[:-1], replace(named[-1], end_s=quiet_s))
    faults = tuple(fault for fault in named if fault.level == "fault" and fault.kind != "healthy")
    return Judgement(threshold, faults, tuple(fault for fault in named if fault not in faults), unnamed)


def _of_a_bus_in_time(generator: ResidualGenerator, residuals: Residuals) -> Residuals:
    """Judge nothing while a late bus repeats its last answer although the servo moves, nor shortly after."""
    known = np.flatnonzero(np.isfinite(residuals.measured_deg))
    time_s = residuals.time_s
    held = np.zeros(time_s.size, dtype=bool)
    held[known] = held_rows(time_s[known], residuals.measured_deg[known], residuals.simulated_deg[known])
    if not held.any():
        return residuals
    last_s = np.maximum.accumulate(np.where(held, time_s, -np.inf))
    in_time = residuals.settled & (time_s > last_s + generator.blanking_s)
    return replace(generator.without(residuals, held), settled=in_time)


def _as_commanded(judgement: Judgement, segment: Segment) -> Judgement:
    """Accuse of no motion where commands came so seldom that nobody knows what was asked between them."""

    def unknown(fault: Fault) -> bool:
        command_s = segment.command_s
        count = int(np.count_nonzero((command_s >= fault.start_s) & (command_s <= fault.alarm_s)))
        return fault.kind not in _AT_REST and fault.alarm_s - fault.start_s > _SELDOM_S * max(count, 1)

    asked = tuple(fault for fault in judgement.faults if not unknown(fault))
    not_asked = tuple(replace(fault, level="suspect") for fault in judgement.faults if unknown(fault))
    suspicions = tuple(sorted((*judgement.suspicions, *not_asked), key=lambda fault: fault.start_s))
    return judgement._replace(faults=asked, suspicions=suspicions)


def _belongs(episode: Episode, fault: Fault) -> bool:
    """Whether an alarm is raised by what is known to be a fault, or by its end."""
    end_s = np.inf if fault.end_s is None else fault.end_s + ECHO_S
    return fault.start_s - ECHO_S <= episode.alarm_s <= end_s


def _largest(episodes: tuple[Episode, ...], residuals: Residuals, threshold: Threshold) -> tuple[Episode, ...]:
    """Those in which the residual is the most above its threshold, and the last, which may go on; in order of time."""
    with np.errstate(over="ignore"):
        size = np.where(residuals.settled, np.abs(residuals.residual_deg) / threshold.level_deg, 0.0)
    first = np.searchsorted(residuals.time_s, [episode.alarm_s for episode in episodes])
    last = np.searchsorted(residuals.time_s, [np.inf if e.end_s is None else e.end_s for e in episodes], side="right")
    peaks = [float(size[i:j].max(initial=0.0)) for i, j in zip(first, last, strict=True)]
    peaks[-1] = np.inf
    chosen = sorted(np.argsort(peaks, kind="stable")[-_MOST_EPISODES:].tolist())
    return tuple(episodes[k] for k in chosen)


def _named(flight: Flight, episode: Episode, threshold: Threshold) -> tuple[Fault, ...]:
    """What happened in an episode. With a constant threshold, a suspicion remains one: the user says what is large."""
    named = isolate(flight, episode)
    return confirmed(named, episode) if threshold.kind == "interval" else named


def _held(fault: Fault) -> Fault:
    """An alarm remains an alarm, even if a healthy servo could have raised it; what it is, is not known then."""
    dismissed = fault.level == "fault" and fault.kind == "healthy"
    return replace(fault, kind="unknown", probability=1.0 - fault.probability) if dismissed else fault
