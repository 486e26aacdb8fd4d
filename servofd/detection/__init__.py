"""From the series of a surface to its verdict, after a flight and in it.

`seen` is where to start: it takes the healthy servo of a surface and sees a log beside it. That servo is calibrated
on good flights (`known`), fitted to a part of the log (`own`), or named by the user (`named`, with the nullspace
filter of the thesis in `nullspace`, `pulse` and `residual`). `moving` has how it moves beside a flight, `changes` the
statistics of what the position does otherwise, their windows and limits; `faults` begins, names and ends a fault by
the `hypotheses`, and `kinds` says what each is and does; `evidence` says what would have shown. `audit` does so for
all surfaces of a log and makes the results of `verdict`; in flight `stream` and `monitor` do the same piece by piece,
and tell `event`. Beside them stand `flights` (parts of logs), `outages` (commands that do not arrive), `wiring`
(signs and scales) and `probability` (odds).
"""
