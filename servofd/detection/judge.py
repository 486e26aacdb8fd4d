"""From the residual of one surface to named faults: which, since when, until when, how large, how sure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.detection.bank import BANK, Explanation, Flight, Onset, Window, wandering
from servofd.detection.residual import commands_at_servo, noise_deg
from servofd.detection.threshold import Threshold, constant_threshold, find_episodes, interval_threshold, suspicion
from servofd.detection.verdict import SURE, WORTH_TELLING, Fault

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from servofd.aircraft.schema import Surface
    from servofd.aircraft.series import Series
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.residual import Commands, ResidualGenerator, Residuals
    from servofd.detection.threshold import Episode

_UNEXPLAINED_SHARE = 0.25
_UNKNOWN_FREEDOM = 6.0


@dataclass(frozen=True, slots=True)
class Naming:
    """Which hypothesis explains a window best, and how sure that is."""

    best: Explanation | None
    """None if the best answer is "none of these"."""
    probabilities: Mapping[str, float]
    """Of every kind, `unknown` included, the largest first."""

    @property
    def kind(self) -> str:
        """The most probable kind."""
        return next(iter(self.probabilities))

    @property
    def probability(self) -> float:
        """Of that kind."""
        return next(iter(self.probabilities.values()))

    @property
    def alternatives(self) -> tuple[str, ...]:
        """Other kinds that are worth mentioning, the most probable first."""
        others = list(self.probabilities.items())[1:]
        return tuple(kind for kind, probability in others if probability >= WORTH_TELLING)


def name_fault(window: Window) -> Naming:
    """Compare all hypotheses on one window."""
    found = {kind: e for kind, explain in BANK.items() if (e := explain(window)) is not None}
    marks = scores(window, found)
    kinds = sorted(marks, key=marks.__getitem__)
    weights = np.exp(-0.5 * (np.array([marks[kind] for kind in kinds]) - marks[kinds[0]]))
    shares = weights / weights.sum()
    return Naming(found.get(kinds[0]), {k: float(s) for k, s in zip(kinds, shares, strict=True)})


def scores(window: Window, found: Mapping[str, Explanation]) -> dict[str, float]:
    """Information criterion of each explanation, and of having none; smaller is better."""
    gap = float(window.error_deg @ window.error_deg)
    cost_deg2 = _UNEXPLAINED_SHARE**2 * gap + window.time_s.size * window.noise_deg**2
    nothing = Explanation("unknown", window.measured_deg, cost_deg2, _UNKNOWN_FREEDOM)
    unknown = min(window.score(nothing), window.score(wandering(window) or nothing))
    return {**{kind: window.score(e) for kind, e in found.items()}, "unknown": unknown}


SETTLING_S = 0.25
"""Left out after the onset: faults that set in abruptly still move the surface as a healthy servo would."""
_AT_REST = ("stuck", "hardover")
_TAKES_ANYTHING = ("floating", "unknown")
WINDOWS_S = (2.0, 4.0, 8.0, 16.0)
_ENOUGH_MOTION_DEG = 4.0
_LIKELY = 0.4
_SHORT_S = 1.0
_BLOCK_S = 3.0
_LONGEST_BLOCK_S = 12.0
_RECENT_S = 1.5
_FIRST_S = 1.0 - SETTLING_S
_SUSPICION_LASTS_S = 15.0
"""The cumulative sum and the usual residual look back about ten seconds."""
_ONSET_BEFORE_RECORD_S = 0.5


def isolate(flight: Flight, episode: Episode) -> tuple[Fault, ...]:
    """Name what happened during an alarm: one fault, or several, if one turned into another.

    The kind `healthy` says that the tolerances of a working servo explain the alarm.
    """
    until_s = flight.end_s if episode.end_s is None else max(episode.end_s, episode.alarm_s + _SHORT_S)
    onset = _onset(flight, episode.start_s)
    naming, window = _name(flight, episode.start_s + SETTLING_S, until_s, onset)
    if naming is not None and not _is_sure(naming):
        naming, window = _second_look(flight, episode, until_s, onset) or (naming, window)
    if naming is None or window is None:
        alike = 1.0 / len(BANK)
        return (Fault("unknown", episode.start_s, episode.alarm_s, episode.end_s, {}, alike, (), episode.level),)
    start_s = episode.start_s
    if onset is not None and naming.best is not None and naming.kind != "healthy":
        before_s = BEFORE_S if episode.level == "fault" else _SUSPICION_LASTS_S
        if episode.suspected_s is not None:
            before_s = _SUSPICION_LASTS_S + max(episode.start_s - episode.suspected_s, 0.0)
        start_s = min(refine_onset_s(flight, naming.best, episode.start_s, window, before_s), episode.alarm_s)
    first = replace(_fault(naming, episode, start_s), named_s=float(window.time_s[-1]))
    begin_s = episode.start_s + SETTLING_S
    early = flight.window(begin_s, min(begin_s + _FIRST_S, until_s), onset) if flight.is_report else None
    if early is not None:
        first = replace(first, first_signs=first_signs(early, flight.generator, flight.sigma_deg))
    change = _change(flight, naming.kind, float(window.time_s[-1]), until_s)
    if change is None:
        return (first,)
    changed_s, then = change
    if then.kind == "healthy":
        return (replace(first, end_s=changed_s),)
    # A monitor that is in alarm already learns of it when two blocks agree.
    known_s = min(changed_s + 2.0 * _BLOCK_S, until_s)
    second = replace(_fault(then, replace(episode, alarm_s=known_s), changed_s), named_s=known_s)
    return (replace(first, end_s=changed_s), second)


def _onset(flight: Flight, start_s: float) -> Onset | None:
    """How the fault came; None if the record begins with it."""
    residuals = flight.residuals
    judged_s = residuals.time_s[residuals.settled]
    if start_s - judged_s[0] < _ONSET_BEFORE_RECORD_S:
        return None
    first, last = np.searchsorted(residuals.time_s, (start_s, start_s + SETTLING_S)).tolist()
    near = residuals.measured_deg[max(first - 3, 0) : first + 1]
    near = near[np.isfinite(near)]
    healthy_deg = residuals.simulated_deg[first : last + 1]
    if near.size == 0 or healthy_deg.size == 0:
        return None
    return Onset(start_s, float(np.median(near)), float(healthy_deg.min()), float(healthy_deg.max()))


def _name(flight: Flight, from_s: float, until_s: float, onset: Onset | None) -> tuple[Naming | None, Window | None]:
    """Name the fault from the shortest window that is sure."""
    best: tuple[Naming | None, Window | None] = (None, None)
    for length_s in WINDOWS_S:
        window = flight.window(from_s, min(from_s + length_s, until_s), onset)
        if window is not None:
            naming = name_fault(window)
            # What a shorter window told for sure, a longer one that holds the end of it does not undo.
            if best[0] is None or not (_is_sure(best[0]) and naming.kind in _TAKES_ANYTHING):
                best = naming, window
            if _is_sure(naming) and window.motion_deg >= _ENOUGH_MOTION_DEG:
                return best
        if from_s + length_s >= until_s:
            break
    return best


def _second_look(flight: Flight, episode: Episode, until_s: float, onset: Onset | None) -> tuple[Naming, Window] | None:
    """Look again where the first window may have held the wrong stretch.

    It may begin too early, and hold the transition; hold the end of a short fault; or leave out the only fast motion.
    """
    for from_s, to_s in (
        (episode.alarm_s + 2.0 * SETTLING_S, episode.alarm_s + 2.0 * SETTLING_S + WINDOWS_S[0]),
        (episode.start_s + SETTLING_S, episode.start_s + SETTLING_S + _SHORT_S),
        (episode.start_s, episode.alarm_s + _SHORT_S),
    ):
        window = flight.window(from_s, min(to_s, until_s), onset)
        if window is not None:
            naming = name_fault(window)
            if _is_sure(naming):
                return naming, window
    return None


def _is_sure(naming: Naming) -> bool:
    return naming.probability >= SURE and naming.kind not in (*_TAKES_ANYTHING, "healthy")


def _fault(naming: Naming, episode: Episode, start_s: float) -> Fault:
    kind, parameters, alternatives = naming.kind, naming.best.parameters if naming.best else {}, naming.alternatives
    if naming.probability < _LIKELY:
        alternatives = tuple(each for each in (kind, *alternatives) if each != "unknown")
        kind, parameters = "unknown", {}
    until_s, level = episode.end_s, episode.level
    return Fault(kind, start_s, episode.alarm_s, until_s, parameters, naming.probability, alternatives, level)


def _change(flight: Flight, kind: str, from_s: float, until_s: float) -> tuple[float, Naming] | None:
    """When the fault turned into another, or went away, and into what; found by bisection."""
    last = _block(flight, until_s, from_s, until_s)
    if last is None or not _differs(last.naming, kind):
        return None
    confirmed = _block(flight, last.begin_s, from_s, last.begin_s)
    if confirmed is None or confirmed.naming.kind != last.naming.kind:
        return None
    low_s, high_s = from_s, confirmed.begin_s
    while high_s - low_s > _BLOCK_S / 2.0:
        middle_s = 0.5 * (low_s + high_s)
        block = _block(flight, middle_s, from_s, until_s)
        if block is not None and block.naming.kind == last.naming.kind:
            high_s = middle_s
        else:
            low_s = middle_s
    return high_s, last.naming


def has_recovered(flight: Flight, kind: str, quiet_s: float) -> bool:
    """Whether what it did lately is surely the motion of a healthy servo, and not the fault going on.

    All since it became quiet [s], or the last of that: where little was asked, a faulty servo is quiet as well.
    """
    for from_s in {quiet_s, max(quiet_s, flight.end_s - _RECENT_S)}:
        window = flight.window(from_s, flight.end_s, None)
        if window is not None and window.motion_deg >= _ENOUGH_MOTION_DEG:
            naming = name_fault(window)
            if naming.kind == "healthy" and naming.probabilities.get(kind, 0.0) <= 1.0 - SURE:
                return True
    return False


def _differs(naming: Naming, kind: str) -> bool:
    if kind in _AT_REST and naming.kind in _AT_REST:
        return False  # only the onset, which lies outside the block, tells which
    return naming.kind not in (kind, *_TAKES_ANYTHING) and naming.probabilities.get(kind, 0.0) <= 1.0 - SURE


class _Block(NamedTuple):
    begin_s: float
    naming: Naming


def _block(flight: Flight, begin_s: float, earliest_s: float, latest_s: float) -> _Block | None:
    """Name what happens from some instant on, or in the last block, in as long a block as it takes to see motion."""
    length_s = _BLOCK_S
    while length_s <= _LONGEST_BLOCK_S:
        first_s = max(earliest_s, min(begin_s, latest_s - length_s))
        window = flight.window(first_s, min(first_s + length_s, latest_s), None)
        if window is not None and window.motion_deg >= _ENOUGH_MOTION_DEG:
            return _Block(first_s, name_fault(window))
        length_s *= 2.0
    return None


BEFORE_S = 4.0
_HEALTHY_BEFORE_S = 0.3
_FEWEST_HEALTHY = 30
_UNDECIDED = 4.0
"""Splits whose log-likelihood is this close to the best, in units of 1/2, are equally good."""


def refine_onset_s(
    flight: Flight, fault: Explanation, rough_s: float, window: Window, before_s: float = BEFORE_S
) -> float:
    """Move the onset to where the fault begins to explain the data better than health does [s].

    Where several instants do alike, because the surface did not move, the last of them is taken: it is the first
    motion that the fault spoils.
    """
    if fault.predict is None:
        return rough_s
    wide = flight.window(rough_s - before_s, float(window.time_s[-1]), window.onset)
    if wide is None:
        return rough_s
    surely_healthy = wide.time_s < wide.time_s[0] + 0.5 * before_s - _HEALTHY_BEFORE_S
    error_deg = wide.error_deg
    if np.count_nonzero(surely_healthy) >= _FEWEST_HEALTHY:
        known = type(wide.ridge)(wide.nuisances[surely_healthy], wide.spread, wide.noise_deg)
        deviations = known.fit(error_deg[surely_healthy]).coefficients
        error_deg = error_deg - wide.nuisances @ deviations
    healthy = error_deg**2
    faulty = (wide.measured_deg - fault.predict(wide)) ** 2
    # Misfits beyond four sigma all count alike: the transition itself is neither healthy nor explained.
    most = 16.0 * wide.noise_deg**2
    gain = np.minimum(healthy, most) - np.minimum(faulty, most)
    cost = np.concatenate([[0.0], np.cumsum(gain)])
    near = np.flatnonzero(cost <= cost.min() + _UNDECIDED * wide.noise_deg**2)
    split = int(near[-1])
    return float(wide.time_s[min(split, wide.time_s.size - 1)])


_ALPHA, _BETA, _GAMMA = 0.0, 1.0, 0.9
"""Defaults of Varga's FaultDetectionTools."""
_FORGOTTEN = 350
"""Samples after which less than 1e-16 of one is left."""
_QUIET = 1.5
"""Levels this much above that of noise alone are still quiet: the mean of ten or so coloured samples scatters."""
_MEAN_OF_ABSOLUTE = float(np.sqrt(2.0 / np.pi))


def narendra(residual_deg: FloatArray) -> FloatArray:
    r"""Evaluate a residual by Narendra's filter [deg]; both of shape (n,).

    As in Varga's model detection, each hypothesis has a residual of its own, :math:`r_i = Q_y (y - \hat y_i)`, and is
    possible while its :math:`\theta` stays within the noise:

    .. math:: \theta_k = \frac{\alpha |r_k| + \beta x_k}{\alpha + \beta/(1-\gamma)}, \qquad x_{k+1} = \gamma x_k + |r_k|
    """
    size_deg = np.abs(residual_deg)
    # The sum of what came before, forgotten by the power of its age; scipy.signal takes longer to load than all else.
    remembered_deg = np.convolve(np.append(0.0, size_deg[:-1]), _GAMMA ** np.arange(_FORGOTTEN))[: size_deg.size]
    level_deg: FloatArray = (_ALPHA * size_deg + _BETA * remembered_deg) / (_ALPHA + _BETA / (1.0 - _GAMMA))
    return level_deg


def first_signs(window: Window, generator: ResidualGenerator, sigma_deg: float) -> tuple[str, ...]:
    """Kinds of faults that a second or less from shortly after the onset on admits, the likeliest first."""
    restart = np.zeros(window.time_s.size, dtype=np.int8)
    restart[0] = 1
    limit_deg = _QUIET * _MEAN_OF_ABSOLUTE * sigma_deg
    quiet = {}
    for kind, explain in BANK.items():
        explanation = explain(window) if kind != "healthy" else None
        if explanation is not None:
            misfit_deg = window.measured_deg - explanation.predicted_deg
            if narendra(generator.filtered(window.time_s, misfit_deg, restart))[-1] <= limit_deg:
                quiet[kind] = window.score(explanation)
    return tuple(sorted(quiet, key=quiet.__getitem__))


def confirmed(named: tuple[Fault, ...], episode: Episode) -> tuple[Fault, ...]:
    """Turn a suspicion into an alarm if the bank can name it for sure.

    The alarm is raised when the name is: with the last sample of the window that told it. A crossing of the threshold
    before that remains the alarm.
    """
    first = named[0]
    sure = first.probability >= SURE and first.kind not in ("healthy", "unknown")
    if episode.level == "fault" or first.named_s is None or not sure:
        return named
    return (replace(first, level="fault", alarm_s=first.named_s), *named[1:])


def joined(flight: Flight, faults: Iterable[Fault]) -> tuple[Fault, ...]:
    """Join neighbours of one kind unless the surface was healthy in between.

    A small lasting fault may stay below half of its threshold for a while, which looks like an end.
    """
    result: list[Fault] = []
    for fault in faults:
        before = result[-1] if result else None
        if before is not None and (before.kind, before.level) == (fault.kind, fault.level):
            between = None if before.end_s is None else flight.window(before.end_s, fault.start_s, None)
            if between is None or name_fault(between).kind != "healthy":
                result[-1] = replace(before, end_s=fault.end_s)
                continue
        result.append(fault)
    return tuple(result)


_MOST_EPISODES = 50
"""Of one surface that are named, which takes some 50 ms each: a threshold within the noise is crossed thousands of
times, and what matters is in the largest, and in what goes on."""


class Judgement(NamedTuple):
    """What was found, and against which threshold."""

    threshold: Threshold
    faults: tuple[Fault, ...]
    suspicions: tuple[Fault, ...]
    """What only the cumulative sum noticed, or the tolerances of a working servo explain."""
    unnamed: int = 0
    """Smaller episodes that nobody named, because there are too many."""


def judge(
    generator: ResidualGenerator, segment: Series, residuals: Residuals, surface: Surface, *, dismiss: bool = True
) -> Judgement:
    """Compare the residual with its threshold, and name each alarm.

    Unless told not to, it dismisses an alarm that the tolerances of a working servo explain: that is a suspicion.
    """
    threshold = interval_threshold(generator, segment, residuals, surface.tolerances, surface.threshold_sigmas)
    if surface.threshold == "constant":
        threshold = constant_threshold(threshold, surface.threshold_deg)
    commands = commands_at_servo(segment, generator.model.delay_s, generator.longest_gap_s(segment))
    return judge_evaluated(generator, surface, residuals, threshold, None, commands, dismiss=dismiss)


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

    What only reports tell may be left out. In flight an alarm that stands is over where the servo has surely moved as
    a healthy one since it became quiet [s].
    """
    suspects = None
    if surface.tells_small_faults:
        suspects = suspicion(residuals, threshold) if suspicious is None else suspicious
    episodes = find_episodes(residuals, threshold, persistence=surface.persistence, suspicion=suspects)
    if not episodes:
        return Judgement(threshold, (), ())
    unnamed = max(len(episodes) - _MOST_EPISODES, 0)
    if unnamed:
        episodes = _largest(episodes, residuals, threshold)
    noise = noise_deg(residuals.error_deg[residuals.settled])
    sigma_deg = float(np.median(threshold.sigma_deg))
    flight = Flight(generator, surface.tolerances, noise, sigma_deg, residuals, commands, is_report)
    found = ((isolate(flight, episode), episode) for episode in episodes)
    if threshold.kind == "interval":  # a constant one is of a user, who says what is large
        found = ((confirmed(some, episode), episode) for some, episode in found)
    named = joined(flight, (fault for some, _ in found for fault in some))
    if not dismiss:
        named = tuple(_held(fault) for fault in named)
    if np.isfinite(quiet_s) and named and named[-1].end_s is None and has_recovered(flight, named[-1].kind, quiet_s):
        named = (*named[:-1], replace(named[-1], end_s=quiet_s))
    faults = tuple(fault for fault in named if fault.level == "fault" and fault.kind != "healthy")
    return Judgement(threshold, faults, tuple(fault for fault in named if fault not in faults), unnamed)


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


def _held(fault: Fault) -> Fault:
    """An alarm remains an alarm, even if a healthy servo could have raised it; what it is, is not known then."""
    dismissed = fault.level == "fault" and fault.kind == "healthy"
    return replace(fault, kind="unknown", probability=1.0 - fault.probability) if dismissed else fault
