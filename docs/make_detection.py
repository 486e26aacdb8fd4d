"""Make ``docs/detection.md`` and its pictures: ``python docs/make_detection.py [FOLDER] [SEEDS] [HEALTHY]``.

The numbers of the text come from the constants in the code; section "Measured" and the pictures from the fleet of
`benchmarks/fleet.py`, 8 seeds of each fault and 1000 healthy flights unless given otherwise (some minutes).
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
from servofd.aircraft.priors import FITTED, PRIORS
from servofd.aircraft.schema import DEFAULT_SIGMAS
from servofd.core.tolerance import Tolerance
from servofd.detection import changes, faults, hypotheses, named
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
    text = "\n".join([introduction(), thresholds(), windows(), bank(), onsets_text(), results])
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

While a servo runs at its rate limit, what an error of that limit would leave is added. A threshold that is named in the call
(`--threshold-deg`) dismisses nothing: what reaches it is a fault, whatever explains it.

What it must tolerate is what healthy servos of one type differ by, and that grows with the command. To first order, a servo
whose gain, delay and bandwidth are off by dk, dt, dw leaves

    r = dk r0 - dt dr0/dt + dw sum_i s/(s + a_i) r0                                                   (D2)

where r0 = Qy ŷ is the healthy deflection as the residual filter sees it, and -a_i are the poles of the servo. (A test
compares D2 with servos that are simulated with these errors.)

**Interval.** `threshold = "interval"` bounds each term of D2 by its tolerance. The filter passes the sensitivities s of the
position to gain, bias, delay, bandwidth and largest speed as it passes the error:

    tau(t) = {DEFAULT_SIGMAS:g} sigma_r + sum_i tolerance_i |s_r,i|,    s_r = Qy s                                             (D3)

| in D3 | | default |
|---|---|---|
| tolerance | of the bias | {tolerance.bias_deg:g} deg |
| | gain | {tolerance.gain:.0%} |
| | delay | {1e3 * tolerance.delay_s:g} ms |
| | bandwidth | {tolerance.bandwidth:.0%} |
| | largest speed | {tolerance.rate:.0%} |
| sigma_r | noise gain of the filter times the noise of the position, measured as the flight goes on (starts at {tolerance.noise_deg:g} deg) | |

It uses no later sample. At rest it is lower than {CONSTANT_DEG:g} deg and sees small faults; in a fast manoeuvre it is higher
and stays silent. {named._IN_A_ROW} samples in a row make an alarm: a command or a reading may be as old as the interval since the one before it. The noise is measured from second differences of the simulation error, in which nothing that a fault
does at the speed of a servo counts.

![One flight](detection/example.png)

**Persistence.** `persistence = n` asks for n judged samples in a row, all on one side:

    sign r(k) = ... = sign r(k-n+1)  and  |r| >= tau at each of them.                                 (D4)

"""


def windows() -> str:
    floors = {key: f"{changes.MARGIN * value:.3g}" for key, value in changes.FLOORS.items()}
    lengths = ", ".join(f"{length_s:g}" for length_s in changes.WINDOWS_S)
    return f"""## Windows

Some faults are too small for the threshold, but last. Whatever its origin, a healthy servo is a set of {FITTED} parameters and the
covariance Sigma by which good servos of its kind differ:

| | parameters | Sigma |
|---|---|---|
| **named** | the library's servo, or the file's: simulated by its own model, with all its effects | tolerance² / 3 of each |
| **calibrated** | fitted to good flights (`servofd calibrate`) | between good flights, and what the fit leaves unknown |
| **fitted** | fitted to a part of the very log | the same, of a part of one flight |

With e the simulation error, s its sensitivities to the parameters, and noise sigma, a good servo has the variance

    sigma_tot² = sigma² + s' Sigma s                                                                  (D5)

so that at rest a small error counts, and in a fast manoeuvre it does not. A change h of the servo (travel lost, an offset, half of
the torque, play) is tested by what of its pattern the others cannot explain: with
A = sum s s' and b = sum s e over a window, whitened by the noise,

    z_h = (b_h - A_hn M b_n) / sqrt(I + (delta / rms d)² I² + 1),    M = (A_nn + Sigma^-1)^-1         (D6)

I being the information A_hh - A_hn M A_nh that is left of it, and delta ({named.NamedMoving.missed_deg:g} deg for a named servo) what the model misses of
how a sound servo moves. Windows of {lengths} s end every {changes.GRID_S:g} s. Beside these, the mean of (e / sigma_tot)², what no parameter
explains of e, and a narrow band from 1 Hz on, over the noise and what a servo that is late would leave there.

An alarm is raised where a statistic is beyond its limit twice in a row, or once by {changes._AT_ONCE:g} times; the limits are a table in
`servofd/detection/changes.py` (loss of travel in 2 s {floors["loss_2s"]}, in 30 s {floors["loss_30s"]}; an offset {floors["bias_10s"]}; energy in 0.5 s {floors["energy_0.5s"]}).
A residual counts for {changes._LARGEST:g} sigma at most, and for {changes._LARGEST_UNSEEN:g} where positions lie further apart than {changes.UNSEEN_S:g} s or a link loses most commands, for
one may have gone and come back unseen; the limit of a mean square lies within {changes._MOST_SHARE:g} of the most that it can be so.
A named servo's fast test is the residual over its threshold (D1, D3); a calibrated one's are three errors in a row over sigma_tot,
which at such rates tell of the servo only if the reading is not the same in all three, or has been for longer than a logger holds it.
Where the file or the user names a constant level, that alone makes a fault, and what the windows see beside it is *suspect*; with
`--threshold-deg` nothing but the level counts.
"""


def bank() -> str:
    scales = ", ".join(f"{scale:g}" for scale in hypotheses._SCALES)
    speeds = ", ".join(f"{speed:g}" for speed in hypotheses._SPEEDS)
    widths = ", ".join(f"{width:g}" for width in hypotheses._WIDTHS_DEG)
    friction = next(prior for prior in PRIORS if prior.name == "friction_deg")
    return f"""## The bank

Each alarm is handed to a bank of hypotheses, each a change of the servo, or no servo at all. In the {hypotheses.WINDOW_S:g} s from {faults._SETTLING_S:g} s after
the alarm, to the end of the fault, or in as many as one of them explains, each explains the position as best it can, the {FITTED} parameters of the servo free as they are
between good ones (J is the misfit that remains, Q how far they had to go: theta' Sigma^-1 theta).

| hypothesis | what changes |
|---|---|
| healthy | nothing |
| bias | the offset |
| loss_of_effectiveness | the gain, times {scales} and free around it |
| slow | bandwidth and largest speed, or the torque, times {speeds} |
| deadband | a dead band or play wider by {widths} deg and free around it, or friction (usually {friction.value:g} deg) |
| oscillation | a sine at the strongest frequency, on the servo or on one that it keeps from sticking |
| intermittent | two or more moments in which the last command that arrived is held, and then obeyed again |
| stuck, hardover | no servo: a constant, within the travel or at an end of it |
| floating | no servo: a cubic in time, and the dynamic pressure |

**Score.** With n samples, a share of {hypotheses._COUNTED:g} of all (neighbours are alike), and p free sizes,

    B = n/2 ln(max(J/n, 1)) + Q + p ln n + 2 doubt                                                    (D7)

smaller is better; an alarm makes a good servo less likely by e^{hypotheses._ALARMED:g}, and wide play and large offsets are rare. The probability of
hypothesis i is

    P_i = exp(-B_i/2) / sum_j exp(-B_j/2).                                                            (D8)

What looks alike shares it: a geared servo without power stays where it is, and play that the air pushes is an offset. Below
{hypotheses._SURE:g}, or where the best hypothesis leaves most of what a good servo does not do, the name is `unknown`. If the winner is
*healthy*, or less likely than all others together, and no statistic is beyond {hypotheses.LOUD:g} times its limit, the alarm is listed as a
suspicion; and so is one without a name while the residual stays within what good flights do.

**Its end** is where the healthy servo becomes the better explanation again, by {faults._ENDED:g} s of one standard deviation for {faults._AFTER_END_S:g} s, or by {faults._SURELY_ENDED:g} s
of it at once. A jammed servo between two manoeuvres is quiet, and stays one fault. The tests begin anew {faults.AGAIN_S:g} s later.
"""


def onsets_text() -> str:
    return f"""## Onset

The split that makes the data most likely: with the fault's prediction f and the healthy servo's ŷ,

    k* = argmax sum_(j>=k) min(((y_j - ŷ_j) / sigma_tot)², {faults._LOG_CLIP:g}) - min(((y_j - f_j) / sigma_tot)², {faults._LOG_CLIP:g}),          (D9)

from {faults._BEFORE_S:g} s before the alarm, but not before the end of the last fault. The onset of a jam can be no earlier than the first motion that
it spoils: it is when the fault began to *show*.
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
sum of the likelihood ratio: no detector is faster in the worst case, Lorden 1971); **onset known** is given the time of onset, which
no detector has (`benchmarks/bound.py`). Delays are from the onset to the alarm; a missed fault has an infinite one.

{late}
{steps}
![Delays](detection/delays.png)

Onset, and what the probabilities are worth:

{starts}
{odds}"""


if __name__ == "__main__":
    words = sys.argv[1:]
    main(Path(words[0]) if words else HERE, *(int(word) for word in words[1:3]))
