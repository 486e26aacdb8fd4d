"""Make ``docs/detection.md`` and its pictures: ``python docs/make_detection.py [FOLDER] [SEEDS] [HEALTHY]``.

The numbers of the text come from the constants in the code; section "Measured" and the pictures from the fleet of
`benchmarks/fleet.py`, 8 seeds of each fault and 1000 healthy flights if not told otherwise (some minutes).
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parent))

from detection import calibration, delays, false_alarms, fly, limits, onsets, shares
from detection_pictures import draw
from servofd.aircraft.schema import DEFAULT_SIGMAS
from servofd.core.tolerance import Tolerance
from servofd.detection import bank as hypotheses
from servofd.detection import judge, probability, residual, threshold, verdict
from trial import CONSTANT_DEG, Trial

HERE = Path(__file__).parent
MEASURED = "## Measured\n"


def main(folder: Path, seeds: int = 8, healthy: int = 1000) -> None:
    faulty, well = fly(seeds, healthy, first=0, workers=None)
    (folder / "detection").mkdir(exist_ok=True)
    draw(folder / "detection", faulty, well)
    (folder / "detection.md").write_text(page(measured(faulty, well)), encoding="utf-8")
    print(folder / "detection.md")


def page(results: str) -> str:
    """The whole page, around what was measured."""
    text = "\n".join([introduction(), thresholds(), latching(), bank(), onsets_text(), results])
    return re.sub(r"^(    .*?) +(\(D\d+\))$", lambda match: f"{match[1]:<110} {match[2]}", text, flags=re.MULTILINE)


def introduction() -> str:
    return """# From residual to named fault

The residual r of [theory.md](theory.md) is zero while a servo does what its model says. This page tells what is made of it:
when an alarm is raised, when it ends, what the fault is called, since when it has been there, and how sure that is.
`python docs/make_detection.py` writes this page: the constants are read from the code, the results are flown.

With only command and position in the log, a servo and the potentiometer that reports its position are one: a shaft that
is off by 3 deg and a sensor that is off by 3 deg give the same log. Every name below therefore reads "the servo **or its
feedback** behaves as if ...".
"""


def thresholds() -> str:
    tolerance = Tolerance()
    return f"""## Before judging

A position that jumps away for one or two samples and back, while its neighbours agree, is no servo's motion: it is left out, and
counted in the verdict's sentence. Where positions come at 25 Hz or less and straight lines between the commands leave a clearly
smaller residual than steps do, the commands were logged more thinly than they were given, and the lines are used; the sentence
says so.

## Thresholds

**Constant.** Thesis Eq. 4.12: an alarm is raised at the first sample with

    |r(t)| >= tau,    tau = {CONSTANT_DEG:g} deg by default.                                                     (D1)

While a servo runs at its rate limit, what an error of that limit would leave (r_sat below) is added. A threshold that is named in
the call (`--threshold-deg`) dismisses nothing: what reaches it is a fault, whatever explains it.

What it must tolerate is what healthy servos of one type differ by, and that grows with the command. To first order, a servo
whose gain, delay and bandwidth are off by dk, dt, dw leaves

    r = dk r0 - dt dr0/dt + dw sum_i s/(s + a_i) r0                                                   (D2)

where r0 = Qy ŷ is the healthy deflection as the residual filter sees it, and -a_i are the poles of the servo. (A test
compares D2 with servos that are simulated with these errors.)

**Interval.** `threshold = "interval"` bounds each term of D2 by its tolerance times the recent peak of its signal:

    tau(t) = T(t) + {DEFAULT_SIGMAS:g} sigma_r(t)
    T(t)   = b + |dk| [r0] + |dt| [dr0/dt] + |dw| [sum_i ...] + [r_sat] + lost                        (D3)

| in D3 | | default |
|---|---|---|
| b | bias of a healthy servo | {tolerance.bias_deg:g} deg |
| dk | gain | {tolerance.gain:.0%} |
| dt | delay | {1e3 * tolerance.delay_s:g} ms |
| dw | bandwidth | {tolerance.bandwidth:.0%} |
| r_sat | residual of a servo whose rate limit is lower by its tolerance, while the model runs at it | {tolerance.rate:.0%} |
| lost | commands that never reached the log: half their recent curvature, times what the filter lets pass of one sample, {residual.PEAK_OF_LAGS:g} \\|p\\| T | |
| [x] | peak hold: max(\\|x\\|, the last peak / (1 + T/{threshold._PEAK_HOLD_S:g} s)) | |
| sigma_r | noise gain of the filter times the noise of the position, measured as the flight goes on (starts at {tolerance.noise_deg:g} deg) | |

It uses no later sample. At rest it is lower than {CONSTANT_DEG:g} deg and sees small faults; in a brisk manoeuvre it is higher
and stays silent. The noise is measured from second differences of the simulation error, in which nothing that a fault
does at the speed of a servo counts.

![One flight](detection/example.png)

**Persistence.** `persistence = n` asks for n judged samples in a row, all on one side:

    sign r(k) = ... = sign r(k-n+1)  and  |r| >= tau at each of them.                                 (D4)

The rate of false alarms under coloured noise is that of runs of at least n samples
(`servofd.detection.probability.persistent_false_alarms_per_hour`).

**Suspicion.** Some faults are too small for the threshold, but last. A cumulative sum gathers what exceeds the tolerance,
on either side, so that oscillations add up, less one standard deviation, so that the sum of noise alone falls:

    z(k) = max(|r| - T - sigma_r, 0) / sigma_r,     S(k) = max(0, S(k-1) + z(k) - {probability.KAPPA_SIGMA:g}),                         (D5)

It is beyond its limit when it has gathered what noise without tolerance would {threshold._SUSPICIONS_PER_HOUR:g} times an hour (Siegmund's run
length, multiplied by the long-run factor of the residual's colour). And the servo's deviations of the last {threshold.MEMORY_S:g} s are fitted
to the residual by the terms x = [r0, dr0/dt, sum_i ..., 1] of D2, once with what tolerances allow and once freely:

    H = min_tight - min_free,  min = min over theta of sum (r - x theta)² / (S sigma_r²) + sum theta_j² / s_j²,   (D6)

S being the long-run factor, and sigma_r no less than {threshold._TRIFLE:g} of the tolerated bias; what is beyond all tolerance, or rests on lost commands, teaches no deviations.
H >= {threshold.SUSPICIOUS_DRIFT:g} means that gain, delay, bandwidth or bias is not that of a healthy servo. Both raise a *suspicion*, which ends when
none was raised for {threshold.SUSPICION_LASTS_S:g} s. It goes through the bank like an alarm; under an interval threshold it becomes a fault if the
bank is sure of its name (P >= {verdict.SURE:g}), and its alarm is raised when the name is; else the surface is *suspect*. Rough models (drafts with a
wider threshold and no tolerances of their own) raise none.
"""


def latching() -> str:
    return f"""## Latching

An alarm lasts until the surface has *proved* to be well. A jammed servo between two manoeuvres has no residual. So an
episode ends only if |r| stayed below {threshold.QUIET_SHARE:g} tau while the residual of an immobile surface would have travelled

    sum |d play(r0, 2 tau)| >= {threshold._TRAVEL_TO_CLEAR:g} tau                                                           (D7)

(play: motion within a zone of twice the usual threshold so far, its median, does not count), and then at the last sample at which it was louder.

Of more than {judge._MOST_EPISODES} alarms of one surface those with the largest |r| / tau and the last are named, and the others counted: so many come
from a constant threshold within the noise, where a name for each would say nothing, or from a loose contact, which {judge._MOST_EPISODES} tell as well.
"""


def bank() -> str:
    names = ", ".join(hypotheses.BANK)
    return f"""## The bank

Each alarm is handed to a bank of hypotheses: {names}.
Each explains the measured deflection y in a window after the onset as best it can. What a working servo may add is free in all that still follow the command: with the nuisances
N = [ŷ, -dŷ/dt, dŷ/d(bandwidth), 1] and a normal prior of the tolerances' spread on their coefficients, theta minimises

    |y - f - N theta|² / sigma² + sum theta_j² / s_j²,     s_j = tolerance_j / sqrt(3).               (D8)

J is the sum of squared misfits that remains, and the second sum goes into the doubt D.

| hypothesis | f, and what is free in it |
|---|---|
| healthy | f = ŷ |
| bias | the same, with a spread of {hypotheses._LARGEST_BIAS_DEG:g} deg for the constant, which stays or grows by up to about {hypotheses._FASTEST_GROWTH_DEG_S:g} deg/s; it must be beyond the tolerance |
| loss_of_effectiveness | the same, with a spread of 1 for the gain, about zero or about another trim; gain between {hypotheses._STUCK_GAIN:g} and 1 less its tolerance |
| oscillation | ŷ, or a constant, and a sine from {hypotheses._SLOWEST_HZ:g} Hz on, {hypotheses._FEWEST_CYCLES:g} cycles or more |
| stuck | a constant where commands have led |
| hardover | a constant where none has: at a stop, {hypotheses._OUT_OF_REACH_DEG:g} deg beyond the range of ŷ so far, or {hypotheses._UNCOMMANDED_RUN_DEG:g} deg away from where the onset and the command would have left it |
| floating | cosines of up to {hypotheses._FASTEST_WIND_HZ:g} Hz, whose spread falls with the square of the frequency beyond {hypotheses._WIND_HZ:g} Hz |
| deadband | play before or behind the servo, or stiction; its width on a grid, then by golden section |
| slow | every pole scaled, or a lower rate limit; the same search |
| unknown | whatever removes all but {judge._UNEXPLAINED_SHARE:.0%} of the simulation error, at the price of {judge._UNKNOWN_FREEDOM:g} parameters; or ŷ with a smooth error, by the same cosines as floating |

**Score.** With n samples, of which {hypotheses.COLOUR:g} in a row tell as much as one, p free parameters and a doubt D (twice the negative
logarithm of how plausible the parameters are in themselves: a servo's deviations are within its tolerances, wide dead bands
are rare, smooth wind is what the priors of its cosines expect),

    B = n/{hypotheses.COLOUR:g} ln(max(J/n, {hypotheses._FLOOR:g} sigma²)) + {hypotheses._PENALTY:g} p ln(n/{hypotheses.COLOUR:g}) + D                                        (D9)

after Schwarz; smaller is better. The probability of hypothesis i, all being equally likely before, is

    P_i = exp(-B_i/2) / sum_j exp(-B_j/2).                                                            (D10)

**How long to look.** Windows begin {judge.SETTLING_S:g} s after the onset and last {", ".join(f"{length_s:g}" for length_s in judge.WINDOWS_S)} s; the first in which a hypothesis has
P >= {verdict.SURE:g} *and* the healthy deflection covers {judge._ENOUGH_MOTION_DEG:g} deg decides. **Not enough motion**: a jam and a dead band, a bias and a jam,
differ only in motion. If no window has enough of it the longest decides, with the probability that it gives, and names the
alternatives of {verdict.WORTH_TELLING:.0%} and more; below {judge._LIKELY:g} the name is `unknown` and all that can be said is "at fault, with too little
motion to tell which". If the winner is *healthy*, the tolerances of a working servo explain the alarm: it is dismissed
and listed as a suspicion.

**Floating and unknown** explain anything. Before they are believed, a window that begins {2.0 * judge.SETTLING_S:g} s after the alarm is named as well:
the first may have held the transition, and if another hypothesis is sure of the second, it wins.

**First signs.** What a fault could have been for all that was known within its first second: the hypotheses that are silent,
each by a residual of its own, r_i = Qy (y - y_i), evaluated by Narendra's filter with Varga's defaults,

    x(k+1) = {judge._GAMMA:g} x(k) + |r_i(k)|,     {1.0 - judge._GAMMA:.2g} x <= {judge._QUIET:g} sqrt(2/pi) sigma_r.                              (D11)

**Faults that change.** The end of an episode is judged once more, in blocks of {judge._BLOCK_S:g} s (up to {judge._LONGEST_BLOCK_S:g} s until there is motion). If
another hypothesis is sure of it, and of the block before, the instant of the change is found by bisection.
"""


def onsets_text() -> str:
    return f"""## Onset

First estimate: the first sample with |r| beyond the tolerance T and {threshold._ONSET_SIGMAS:g} standard deviations after the last quiet
{threshold._QUIET_BEFORE_ONSET_S:g} s before the alarm. Then, with the winner's prediction f, the split that makes the data most likely,

    k* = argmin sum_(j<k) min(e_j², 16 sigma²) + sum_(j>=k) min((y_j - f_j)², 16 sigma²),                (D12)

from {judge.BEFORE_S:g} s before that estimate ({judge._SUSPICION_LASTS_S:g} s for a suspicion) to the end of the window, e being the simulation
error less the servo's deviations (N theta, fitted to what was surely healthy). Splits within {judge._UNDECIDED:g} sigma² of the best are
equally good, for instance because the surface did not move; the last of them is taken, which is the first motion that the fault spoils. The onset of a jam can be no earlier than
that: it is when the fault began to *show*.
"""


def measured(faulty: Sequence[Trial], healthy: Sequence[Trial]) -> str:
    visible = [one for one in faulty if one.enough_motion]
    large = [one for one in visible if one.case.size != "small"]
    small = [one for one in visible if one.case.size == "small"]
    rest = [one for one in faulty if not one.enough_motion]
    limit = limits(faulty)
    groups = {
        "medium and large faults, enough motion": large,
        "small faults, enough motion": small,
        "too little motion": rest,
    }
    texts = [
        "\n\n".join(shares(name, group, lambda one: one.case.kind or "") for name, group in groups.items() if group),
        false_alarms(healthy, faulty),
        delays("Medium and large faults, enough motion, from the onset [s]", large, limit),
        delays(
            "Steps (bias) of any size and motion [s]", [t for t in faulty if t.case.kind == "bias"], limit, by_size=True
        ),
        onsets(large),
        calibration("Probabilities of names given, with enough motion", visible)
        + "\n\n"
        + calibration("The same with too little motion", rest),
    ]
    names, alarms, late, steps, starts, odds = (f"```text\n{text}\n```\n" for text in texts)
    return f"""{MEASURED}
{len(faulty)} flights with a fault and {len(healthy)} without, 120 s each, of servos that differ from the model within the tolerances, with noise,
10 or 12 bits of position, jitter and lost rows, by a simulator of their own (`benchmarks/fleet.py`). Enough motion: after the
onset the healthy surface turns faster than 5 deg/s for at least 2 s in all, over a range of at least 4 deg. A fault that was not
detected counts as not right. `python benchmarks/detection.py` prints all of it, and more.

![Names](detection/names.png)

{names}
Healthy flights:

{alarms}
![False alarms and detections](detection/roc.png)

Delays beside two bounds. Both detectors know the fault's exact signature in that very flight and the spread of servos, and
learn from the flight what their servo is like; **bound** has the same rate of false alarms, one in 1000 flights (a cumulative
sum of the likelihood ratio: nobody is faster in the worst case, Lorden 1971); **onset known** is told when to look, which
nobody can be (`benchmarks/bound.py`). Delays are from the onset to the alarm; a missed fault has an infinite one.

{late}
{steps}
![Delays](detection/delays.png)

Onset, and what the probabilities are worth:

{starts}
{odds}"""


if __name__ == "__main__":
    words = sys.argv[1:]
    main(Path(words[0]) if words else HERE, *(int(word) for word in words[1:3]))
