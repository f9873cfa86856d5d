"""The attitude of a whole unit as a drawing in text for the operator: which of its axes point where."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.spec.places import rotation_of
from gradcal_jax.spec.spec_sections import Spec

Numbers = NDArray[np.float64]

# A direction is named by the body's axes that are at most 67.5 degrees from it.
_NAMED: Final = np.sin(np.radians(22.5))
_WORLD: Final = {"up": (0.0, 0.0, 1.0), "east": (1.0, 0.0, 0.0), "north": (0.0, 1.0, 0.0)}


def drawn(spec: Spec, angles_deg: Mapping[str, float], mounting: int) -> str:
    """A unit at these angles of its table's axes, by name, in a mounting (its number, from 1), seen from the south:

    ``  up: body +z``
    ``  |  north: body between +y and -x``
    ``  | /``
    ``  o---- east: body +x``
    """
    attitude = np.eye(3)
    for axis in spec.rig.table.axis:
        attitude = attitude @ turn_about(axis.unit_vector, np.radians(angles_deg.get(axis.name, 0.0)))
    attitude = attitude @ rotation_of(spec.rig.table.mounting[max(mounting - 1, 0)])
    texts = {name: f"{name}: body {_seen(np.array(world) @ attitude)}" for name, world in _WORLD.items()}
    return f"  {texts['up']}\n  |  {texts['north']}\n  | /\n  o---- {texts['east']}"


def turn_about(axis: Sequence[float] | Numbers, angle: float | Numbers) -> Numbers:
    """`(…, 3, 3)`, the matrices of turns by angles `(…)` (rad) about a unit vector (Rodrigues)."""
    x, y, z = axis
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.asarray(angle)[..., None, None]
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def turn_by(vector: Sequence[float] | Numbers) -> Numbers:
    """`(3, 3)`, the matrix of a turn by a rotation vector (rad)."""
    size = float(np.linalg.norm(vector))
    return turn_about(np.array(vector) / size, size) if size > 0.0 else np.eye(3)


def _seen(direction: Numbers) -> str:
    order = [int(i) for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > _NAMED]
    names = [f"{'+' if direction[i] > 0.0 else '-'}{'xyz'[i]}" for i in order]
    return names[0] if len(names) == 1 else f"between {' and '.join(names)}"
