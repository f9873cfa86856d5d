"""One spec in two languages: what both a spec of one gyro axis and the spec of a unit of one channel can say.

A recorded case of one axis is first reduced to that (`common`), then written as a unit (`as_unit`). The two must
predict the same.
"""

import copy
import math
from typing import Any

from gradcal_jax.files.moves import Rest

Tables = dict[str, Any]
_OF_INSTRUMENT = ("thermal_lag", "sample_clock_error")
_OF_GYRO = (
    "angle_random_walk", "rate_random_walk", "full_scale", "full_scale_margin", "drift", "scale_factor_instability",
    "turn_on_bias", "bias", "scale_factor",
)  # fmt: skip
_READ_EVERY = "1 s"
# A unit estimates a bias in any case: this one is as good as known.
_KNOWN = {
    "temperature": {"basis": "polynomial", "degree": 0, "centre": "20 degC", "scale": "50 K"},
    "prior": "1e-6 deg/h",
}


def common(axis: Tables) -> Tables | None:
    """An axis's spec without what a unit's spec cannot say; None for the standard method, and for several axes."""
    spec = copy.deepcopy({key: value for key, value in axis.items() if key not in ("design", "done")})
    sensor, plan = spec["sensor"], spec["plan"]
    if plan["method"] != "gradient" or isinstance(plan.get("gradient"), list):
        return None
    spec["sensor"] = {key: sensor[key] for key in ("quantity", *_OF_INSTRUMENT, *_OF_GYRO) if key in sensor}
    for name in ("bias", "scale_factor"):
        if name in sensor:
            sensor[name].pop("discrepancy", None)
    spec["sensor"].setdefault("bias", _KNOWN)
    cycle = plan.pop("cycle", None) or {"moves": [{"rest": "60 s"}]}
    plan.pop("read_every", None)
    if any(move.get("axis", "x") != "x" for move in cycle["moves"]):
        return None
    moves: list[Tables] = []
    for move in cycle["moves"]:
        plain = {key: value for key, value in move.items() if key not in ("axis", "read", "read_every", "other_axes")}
        # A rest after each move: without one, the moves of a unit's recording are one.
        # Rests of whole seconds: a unit's last reading of a rest is at its end.
        if "rest" in plain:
            length = math.ceil(float(Rest(rest=plain["rest"]).rest))
            moves.append(plain | {"rest": f"{length} s", "read_every": _READ_EVERY})
        else:
            moves += [plain, {"rest": "3 s", "read_every": _READ_EVERY}]
    plan["cycle"] = {"moves": moves}
    table = spec["rig"]["table"]
    table["angle"] = {k: v for k, v in table.get("angle", {}).items() if k != "timing_error"}
    spec["rig"] = {"table": table, "chamber": spec["rig"]["chamber"]}
    return spec


def as_unit(axis: Tables) -> Tables:
    """The same as a unit; `axis` as `common` gives it."""
    sensor, plan, table = axis["sensor"], axis["plan"], axis["rig"]["table"]
    own = {key: table[key] for key in ("max_rate", "max_acceleration", "travel") if key in table}
    angle = table["angle"] | {"read_every": _READ_EVERY}
    turn = {"name": "turn", "direction": [0.0, 0.0, 1.0], **own, "angle": angle}
    moves = [{k: v for k, v in move.items() if k != "read_every"} for move in plan["cycle"]["moves"]]
    return {
        "format": axis["format"],
        "sensor": {key: sensor[key] for key in _OF_INSTRUMENT if key in sensor}
        | {"gyro": {"axes": ["z"]} | {key: sensor[key] for key in _OF_GYRO if key in sensor}},
        "rig": {
            "site": {"latitude": "0 deg"},
            "table": {"standing": "read", "drive": table.get("drive", "motor"), "axis": [turn]},
            "chamber": axis["rig"]["chamber"],
        },
        "requirement": [{**row, "quantity": f"gyro_{row['quantity']}", "axis": "z"} for row in axis["requirement"]],
        "plan": plan | {"cycle": {"moves": moves}},
    }
