"""Specs of a table of one axis, and the fine course of a plan on it, for terms that are summed step by step."""

from typing import Any, NamedTuple

import numpy as np

from gradcal_jax.model.build import BuiltImu
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec

G = 9.80665
ANGLE = {"reading_noise": "5 arcsec", "standstill_offset": "5 arcsec", "read_every": "5 s"}
# The body's z against a level axis.
LEVEL = {"direction": [1.0, 0.0, 0.0], "mounting": {"x": "+z", "y": "+y", "z": "-x"}, "latitude": "40 deg"}
MOVES = [{"rest": "37 s"}, {"turn": "180 deg"}, {"rest": "53 s"}, {"turn": "-180 deg"}]


def spec_of_table(sensor: dict[str, Any], plan: dict[str, Any], requirement: Any = (), **table: Any) -> Spec:
    """A spec of an axis that points up (or in the `direction`), at the `latitude` 0; `angle`: of its encoder."""
    axis = {"name": "turn", "max_rate": "400 deg/s", "max_acceleration": "400 deg/s^2"}
    own = {"direction": table.pop("direction", [0.0, 0.0, 1.0]), "angle": table.pop("angle", ANGLE)}
    return spec_of({
        "format": "gradcal-spec/1",
        "sensor": {"clock": "sensor", **sensor},
        "rig": {
            "site": {"latitude": table.pop("latitude", "0 deg"), "gravity": f"{G} m/s^2"},
            "table": {"axis": [axis | own]} | table,
            "chamber": {"range": ["-40 degC", "85 degC"], "max_heating": "5 K/min", "max_cooling": "5 K/min"},
        },
        "requirement": list(requirement),
        "plan": plan,
    })  # fmt: skip


class Fine(NamedTuple):
    """A motion in `parts` equal steps of every piece, `(P, parts)`: s, °C, K/s, s; and the rate of gyro z, rad/s."""

    time: np.ndarray
    temperature: np.ndarray
    slope: np.ndarray
    weight: np.ndarray
    rate: np.ndarray


def fine(built: BuiltImu, parts: int) -> Fine:
    """The steps of a plan's motion. The gyro along z of the body is against the axis."""
    line = built.motion.line
    places = np.broadcast_to((np.arange(parts) + 0.5) / parts, (line.piece_count, parts))
    turning, since = line.rate(places), places * line.duration[:, None]
    earth = np.zeros_like(turning)
    for g in built.body_nodes().groups:
        earth[g.pieces] = g.earth[g.kind, 0, 2][:, None]
    rate = earth - np.where(built.motion.axis[:, None] == 0, turning, 0.0)
    weight = np.broadcast_to(line.duration[:, None] / parts, places.shape)
    return Fine(line.start[:, None] + since, line.temperature(places), line.temperature_slope(since), weight, rate)
