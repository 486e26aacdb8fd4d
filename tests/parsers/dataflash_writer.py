"""DataFlash logs for tests: columns of every kind, in binary and as text."""

from __future__ import annotations

from typing import Any

import numpy as np

from logparsers.dataflash import open_dataflash
from logparsers.dataflash.encode import Message, encode

SEED = 20240607


def servo_flight(seconds: float = 4.0, *, first_us: int = 5_000_000, radians: bool = False) -> list[Message]:
    """RCOU 25 Hz, CSRV of three servos 50 Hz, PARM, MSG, GPS 5 Hz, and one column of every kind."""
    rng = np.random.default_rng(SEED)

    def at(rate_hz: float, lag_us: int) -> Any:
        return first_us + lag_us + (np.arange(int(seconds * rate_hz)) * 1e6 / rate_hz).astype(np.int64)

    servo_us = np.concatenate([at(50, 10 + i) for i in (0, 1, 8)])
    n, m, g = len(servo_us), len(at(25, 0)), len(at(5, 0))
    names = ["SERVO1_FUNCTION", "SERVO1_TRIM", "SERVO1_TRIM"]
    parm: dict[str, Any] = {
        "TimeUS": [first_us, first_us, first_us + 2_000_000],
        "Name": names,
        "Value": [4.0, 1500.0, 1512.0],
    }
    csrv: dict[str, Any] = {
        "TimeUS": servo_us,
        "Id": np.repeat([0, 1, 8], n // 3),
        "Pos": rng.normal(0, 10, n),
        "PosCmd": rng.normal(0, 10, n),
        "V": np.where(np.arange(n) % 7, 7.4, np.nan),
    }
    gps: dict[str, Any] = {
        "TimeUS": at(5, 30),
        "Status": [3] * g,
        "GMS": 1000 + 200 * np.arange(g),
        "GWk": [2300] * g,
    }
    odd: dict[str, Any] = {
        "TimeUS": at(25, 40),
        "M": rng.integers(0, 25, m),
        "Data": rng.integers(-9, 9, (m, 32)),
        "Half": [0.5] * m,
    }
    scaled: dict[str, Any] = {"TimeUS": at(25, 50)}
    scaled |= {c: rng.integers(0, 30_000, m) / 100 for c in ("c", "C", "e", "E")}
    scaled |= {"L": rng.integers(-(10**9), 10**9, m) / 1e7}
    plain: dict[str, Any] = {
        "TimeUS": at(25, 60),
        "b": rng.integers(-128, 128, m),
        "B": rng.integers(0, 256, m),
    }
    plain |= {"h": rng.integers(-(2**15), 2**15, m), "H": rng.integers(0, 2**16, m)}
    plain |= {"i": rng.integers(-(2**31), 2**31, m), "I": rng.integers(0, 2**32, m)}
    plain |= {"q": rng.integers(-(2**62), 2**62, m), "d": rng.normal(0, 1e9, m)}
    words = {
        "TimeUS": at(25, 70),
        "n": ["ab"] * m,
        "N": [f"UMPOS_{i % 3}" for i in range(m)],
        "Z": ["grün"] * m,
    }
    said: dict[str, Any] = {
        "TimeUS": [first_us, first_us + 1],
        "Message": ["ArduPlane V4.5.1 (1a2b3c4d)", "Throttle armed"],
    }
    pwm: dict[str, Any] = {"TimeUS": at(25, 20), "C1": 1500 + np.arange(m), "C2": [0] * m}
    return [
        Message("PARM", "QNf", parm, "s--", "F--"),
        Message("MSG", "QZ", said, "s-", "F-"),
        Message("RCOU", "QHH", pwm, "sYY", "F--"),
        Message("CSRV", "QBfff", csrv, "s#-dv" if radians else "s#ddv", "F----"),
        Message("GPS", "QBIH", gps),
        Message("ODD", "QMag", odd),
        Message("SCAL", "QcCeEL", scaled),
        Message("PLN", "QbBhHiIqd", plain),
        Message("TXT", "QnNZ", words),
    ]


def as_text(messages: list[Message]) -> bytes:
    """The text form of a log, as ground stations write it."""
    return text_of(encode(messages))


def text_of(content: bytes) -> bytes:
    """The text form of a binary log; numbers to the last digit."""
    log = open_dataflash(content)
    lines = [f"FMT, {f.type}, {f.length}, {f.name}, {f.format}, {','.join(f.columns)}" for f in log.layouts.values()]
    rows = []
    for name in (n for n in log.names if n != "FMT"):
        table = log.table(name)
        for i, at in enumerate(log.times_us(name).tolist()):
            cells = (v[i].tobytes().hex() if v.ndim > 1 else str(v[i].item()) for v in table.values())
            rows.append((at, f"{name}, {', '.join(cells)}"))
    return "\n".join([*lines, *(row for _, row in sorted(rows, key=lambda r: r[0])), ""]).encode()


def before_stamps(rows: int = 100, *, gps: str = "TimeMS") -> bytes:
    """A text log of 2013: attitude at 10 Hz and throttle behind it, GPS once a second, and no stamp but that of GPS."""
    head = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 129, 23, PARM, Nf, Name,Value",
        "FMT, 1, 17, ATT, cccc, RollIn,Roll,PitchIn,Pitch",
        "FMT, 4, 17, CTUN, hch, ThrIn,SonAlt,ThrOut",
        f"FMT, 3, 31, GPS, BIHBe, Status,{gps},Week,NSats,Alt",
        "PARM, SYSID_SW_TYPE, 0.000000",
    ]
    for k in range(rows):
        if k % 10 == 0:
            head.append(f"GPS, 3, {123_400_000 + 100 * k}, 1750, 9, {100 + k / 100:.2f}")
        head += [f"ATT, 0.00, {k % 90}.25, -0.50, {k % 7}.00", f"CTUN, {k}, 1.50, {k + 3}"]
    return "\n".join([*head, ""]).encode()
