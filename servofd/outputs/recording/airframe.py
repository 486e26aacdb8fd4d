"""Where a surface sits on a drawn aircraft, guessed from its name, and how it turns there."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.types import FloatArray

__all__ = ["BODY", "Hinge", "hinges", "turned", "turned_by_euler"]

BODY = (
    ((0.0, 0.0, 0.0), (0.75, 0.07, 0.08)),
    ((0.12, 0.0, -0.05), (0.16, 1.2, 0.015)),
    ((-0.72, 0.0, -0.02), (0.10, 0.38, 0.012)),
    ((-0.72, 0.0, -0.22), (0.10, 0.012, 0.20)),
)
"""Fuselage, wing, tail and fin: centre and half size in the axes forward, right, down, in drawn metres."""

_RIGHT, _DOWN = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Hinge:
    """Axis that a surface turns about; its trailing edge is behind (forward, right, down)."""

    at: tuple[float, float, float]
    axis: tuple[float, float, float]
    half_size: tuple[float, float, float]
    """Of the surface: half its chord, span and thickness, in the same axes."""


_PLACES: tuple[tuple[str, Hinge], ...] = (
    ("rudder|yaw", Hinge((-0.825, 0.0, -0.22), _DOWN, (0.06, 0.014, 0.20))),
    ("elev(?!on)|pitch|stab", Hinge((-0.825, 0.0, -0.02), _RIGHT, (0.06, 0.38, 0.014))),
    ("flap.*(left|_l)", Hinge((-0.045, -0.35, -0.05), _RIGHT, (0.06, 0.22, 0.017))),
    ("flap.*(right|_r)", Hinge((-0.045, 0.35, -0.05), _RIGHT, (0.06, 0.22, 0.017))),
    ("(left|_l$)", Hinge((-0.045, -0.88, -0.05), _RIGHT, (0.06, 0.28, 0.017))),
    ("(right|_r$)|aileron", Hinge((-0.045, 0.88, -0.05), _RIGHT, (0.06, 0.28, 0.017))),
)


def hinges(names: list[str]) -> dict[str, Hinge]:
    """A place for each surface; those whose names say nothing stand in a row behind the aircraft.

    Examples
    --------
    >>> [round(h.at[0], 2) for h in hinges(["elevator", "servo_7"]).values()]
    [-0.82, -1.3]
    """
    placed: dict[str, Hinge] = {}
    for name in names:
        guess = next((hinge for words, hinge in _PLACES if re.search(words, name.lower())), None)
        if guess is None or guess in placed.values():
            row = sum(h.at[0] == -1.3 for h in placed.values())
            sideways = (row + 1) // 2 * (0.35 if row % 2 else -0.35)
            guess = Hinge((-1.3, sideways, 0.0), _RIGHT, (0.08, 0.14, 0.014))
        placed[name] = guess
    return placed


def turned(axis: tuple[float, float, float], angle_deg: FloatArray) -> FloatArray:
    """Rotations by angles of shape (n,) about one axis, as quaternions (x, y, z, w) of shape (n, 4).

    Examples
    --------
    >>> turned((0.0, 1.0, 0.0), np.array([180.0])).round(6).tolist()
    [[0.0, 1.0, 0.0, 0.0]]
    """
    half = np.radians(angle_deg) / 2.0
    return np.column_stack([np.outer(np.sin(half), axis), np.cos(half)])


def turned_by_euler(euler_deg: FloatArray) -> FloatArray:
    """Roll, pitch and yaw of shape (n, 3) [deg] to quaternions (x, y, z, w) of shape (n, 4): yaw first, roll last.

    Examples
    --------
    >>> turned_by_euler(np.array([[0.0, 0.0, 180.0]])).round(6).tolist()
    [[0.0, 0.0, 1.0, 0.0]]
    """
    from scipy.spatial.transform import Rotation

    quaternions: FloatArray = Rotation.from_euler("ZYX", euler_deg[:, ::-1], degrees=True).as_quat()
    return quaternions
