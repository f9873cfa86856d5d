"""The specs of features, of one gyro axis and of a whole IMU, and what else the command lines name."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from nothing_omitted import zeros_of_omitted
from scipy.signal import lfilter

import gradcal_jax as gj
from gradcal_jax.records.log import Log
from gradcal_jax.records.log_file import write_log
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed, patched, tables_of
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.writing import to_toml

ROOT = Path(__file__).parents[2]
WALK, FORCE_WALK = float(np.radians(0.1) / 60.0), 0.05 / 60.0
"""White noise of the record at rest, rad/√s and m/s/√s."""
DRIFT, DRIFT_TIME_S = 3.0 * WALK, 200.0
"""Standard deviation (rad/s) and correlation time of its gyros' drift."""

# ------------------------------------------------------------------------------------------------------------ the specs
# Plans of some four minutes: ramps that are steep, maps of first degree.
_MAP = {"basis": "polynomial", "degree": 1, "centre": "18 degC", "scale": "8 K"}
_BOX = ["12 degC", "22 degC"]
_RATES = ["-200 deg/s", "200 deg/s"]
_FIRST = [{"rest": "4 s"}]


def _turned(turns: float, rate: str | None = None, **more: Any) -> list[dict[str, Any]]:
    """A turn and the way back, with rests between."""
    peak = {} if rate is None else {"peak_rate": rate}
    return [part for n in (turns, -turns) for part in ({"turns": n, **peak, **more}, {"rest": "4 s"})]


def _pose(spin: str, tilt: str) -> list[dict[str, Any]]:
    return [{"pose": {"tilt": tilt, "spin": spin}, "rest": "4 s"}]


_COMMON = {
    "sensor.gyro.bias": {"temperature": _MAP, "prior": "500 deg/h"},
    "sensor.gyro.scale_factor": {
        "temperature": _MAP,
        "rate": {"basis": "polynomial", "degree": 1, "scale": "200 deg/s"},
        "prior": "5000 ppm",
    },
    "sensor.thermal_lag": "10 s",
    "rig.chamber.max_heating": "10 K/min",
    "rig.chamber.max_cooling": "10 K/min",
    "plan.temperature": ["10 degC", "26 degC"],
    "plan.soak": {"duration": "20 s", "used": False},
}
_OF_GYROS = [
    {
        "name": "scale factor",
        "quantity": "gyro_scale_factor",
        "temperature": _BOX,
        "rate": _RATES,
        "grid": [9, 9],
        "target": "2000 ppm",
    },
    {"name": "bias", "quantity": "gyro_bias", "temperature": _BOX, "grid": [9], "target": "200 deg/h"},
]
_AXIS = _COMMON | {
    "rig.table.axis[0].max_acceleration": "400 deg/s^2",
    "rig.table.axis[0].angle.reading_noise": "30 arcsec",
    "requirement": [row | {"axis": "x"} for row in _OF_GYROS],
    "plan.cycle": {"moves": [*_FIRST, *_turned(3), *_turned(1, "60 deg/s")]},
    "plan.gradient": "2.5 K/min",
    "design": {"minimise": "scale factor", "free": ["duration", "peak_rate"], "moves": 2, "starts": 1},
}
_IMU = _COMMON | {
    "sensor.accelerometer.bias.temperature": _MAP,
    "sensor.accelerometer.scale_factor.temperature": _MAP,
    "sensor.gyro.misalignment": {"prior": "10 mrad"},
    "sensor.accelerometer.misalignment": {"prior": "10 mrad"},
    "requirement": [
        *_OF_GYROS,
        {"name": "force", "quantity": "accelerometer_bias", "temperature": _BOX, "grid": [9], "target": "5 mg"},
    ],
    "plan.cycle": {
        "moves": [
            *_FIRST,
            *_turned(2, axis="spin"),
            *_turned(1, "60 deg/s", axis="spin"),
            *_pose("0 deg", "90 deg"),
            *_turned(1, axis="tilt"),
            *_turned(1, "60 deg/s", axis="tilt"),
            *_pose("90 deg", "90 deg"),
            *_turned(1, axis="tilt"),
            *_turned(1, "60 deg/s", axis="tilt"),
            *_pose("270 deg", "90 deg"),
            *_pose("180 deg", "90 deg"),
            *_pose("45 deg", "180 deg"),
            *_pose("225 deg", "135 deg"),
            *_pose("45 deg", "45 deg"),
            *_pose("0 deg", "0 deg"),
        ]
    },
    # Two cycles fill the ramp.
    "plan.gradient": "3.13 K/min",
    "design": {"minimise": "all requirements"},
}
_BASES = {"axis": ("paper-dynamic-gradient", _AXIS), "IMU": ("two-axis-table", _IMU)}

_STAY = {"method": "standard", "temperatures": ["12 degC", "22 degC"], "soak": "10 min", "integration": "60 s"}
_HELD = _STAY | {"rates": ["-200 deg/s", "-60 deg/s", "60 deg/s", "200 deg/s"]}
_MISSION = "time (s), rate (deg/s), temperature (degC)\n0, 0, 14\n60, 30, 16\n120, -20, 20\n300, 0, 22\n"
_PROGRAMME = [
    {"soak": "20 s", "at": "10 degC"},
    {"ramp_to": "26 degC", "rate": "4 K/min"},
    {"ramp_to": "10 degC", "rate": "4 K/min"},
]


def _base(kind: str) -> gj.Spec:
    preset, keys = _BASES[kind]
    return changed(parse_spec(presets.text(preset)), keys)


def _requirements(spec: gj.Spec, **keys: Any) -> list[dict[str, Any]]:
    """Those of gyros, with keys added to each."""
    rows = tables_of(spec)["requirement"]
    return [row | keys for row in rows if row["quantity"].startswith("gyro_")]


def _variants(kind: str, spec: gj.Spec) -> dict[str, dict[str, Any]]:
    """What each spec changes in the first one, by the name of its file."""
    bias = _requirements(spec)[1]
    of_axis = {"axis": "z"} if kind == "IMU" else {"axis": "x"}
    heading = of_axis | {"name": "heading", "quantity": "mission_heading", "mission": "mission.csv"}
    north = of_axis | {
        "name": "north",
        "quantity": "north",
        "latitude": "52 deg",
        "after": "10 min",
        "temperature": _BOX,
    }
    branches = [bias | {"name": name, "branch": name} for name in ("heating", "cooling")]
    moves = tables_of(spec)["plan"]["cycle"]["moves"]
    slow = _turned(1, "20 deg/s", read_every="1 s", shape="linear ramps", **({"axis": "tilt"} if kind == "IMU" else {}))
    moving: dict[str, Any] = {"plan.cycle.moves": [*moves, *slow], "rig.table.standing": "read"}
    held: dict[str, Any] = {"plan": _HELD, "design": None}
    if kind == "IMU":
        moving |= {"sensor.accelerometer.read_on_moves_below": "30 deg/s"}
        spin = tables_of(spec)["rig"]["table"]["axis"][1]
        rows = [row | {"axis": "z"} for row in _requirements(spec)]
        held |= {"rig.table.axis": [spin], "requirement": rows}
    return {
        "better.toml": zeros_of_omitted(spec) | {"requirement[0].target": "10 ppm" if kind == "IMU" else "3 ppm"},
        "strict.toml": {"requirement[1].target": "3 deg/h"},
        "judged.toml": {"requirement": [bias | {"coverage": 2, "risk": "2 %"}], "design": None},
        "noisier.toml": {"sensor.gyro.angle_random_walk": "3 deg/sqrt(h)"},
        "slower.toml": {"plan.gradient": "2 K/min"},
        "hidden.toml": {
            "sensor.gyro.scale_factor.discrepancy": {
                "standard_deviation": "200 ppm",
                "temperature_degree": 2,
                "rate_degree": 2,
            }
        },
        "seeing.toml": {"design.notice": {"standard_deviation": "3000 ppm", "temperature_degree": 2, "rate_degree": 2}},
        "unsteady.toml": {
            "sensor.gyro.scale_factor_instability": [{"standard_deviation": "300 ppm", "correlation_time": "5 min"}]
        },
        "uncertain.toml": {"sensor.gyro.uncertain": {"angle_random_walk": "factor 2"}},
        "moving.toml": moving,
        "missions.toml": {"requirement": [heading, north], "design.minimise": "heading"},
        "both-ways.toml": {
            "plan.temperature": None,
            "plan.gradient": None,
            "plan.soak": None,
            "plan.programme": _PROGRAMME,
            "sensor.gyro.hysteresis": [{"width": "3 K", "prior": "20 deg/h/K"}],
            "requirement": [bias, *branches],
            "design": None,
        },
        "held.toml": held,
        "shortest.toml": {"design.minimise": "motion time"},
    }


_SWEEP = """format = "gradcal-sweep/1"
base   = "spec.toml"
[[axis]]
name    = "sensor"
section = "sensor"
values  = ["spec.toml", "noisier.toml"]
"""
_OF_GRADIENT = """[[axis]]
key    = "plan.gradient"
values = ["2 K/min", "2.4 K/min"]
"""
_RIG = """format = "gradcal-rig/1"
[chamber]
driver = "espec"
port   = "/dev/no"
safe   = "hold"
[laboratory]
name    = "Laboratory"
country = "DE"
"""


def write_files(kind: str, folder: Path) -> None:
    """What the command lines name and do not make themselves."""
    spec = _base(kind)
    text = to_toml(spec)
    files = {
        "spec.toml": text,
        "wrong.toml": text.replace("degree = 1", "degre = 1", 1).replace('"gyro_bias"', '"gyro_bia"'),
        "mission.csv": _MISSION,
        "sweep.toml": _SWEEP + _OF_GRADIENT,
        "designs.toml": _SWEEP.replace("[[axis]]", 'do     = "optimise"\n[[axis]]'),
        "rig.toml": _RIG,
    }
    recorded = json.loads((ROOT / "tests/numbers/calibrations.json").read_text(encoding="utf-8"))
    old = recorded["axes x, polynomials" if kind == "axis" else "unit 0"]["tables"]
    files["old-calibration.toml"] = tomlkit.dumps(old)
    if kind == "axis":
        files["old.toml"] = (
            (ROOT / "tests/spec/broken/rig_max_rate_misspelt.toml")
            .read_text(encoding="utf-8")
            .replace("max_rte", "max_rate")
        )
    files |= {name: tomlkit.dumps(patched(spec, keys)) for name, keys in _variants(kind, spec).items()}
    for name, content in files.items():
        (folder / name).write_text(content, encoding="utf-8")
    _write_rest(kind, folder / "rest.nc")


def _write_rest(kind: str, path: Path) -> None:
    """Three hours at rest at 1 Hz: white noise and a drift, of one gyro or of a whole IMU."""
    rng, count, axes = np.random.default_rng(5), 10_800, ("x", "y", "z")[: 1 if kind == "axis" else 3]
    keep = np.exp(-1.0 / DRIFT_TIME_S)
    shape = (count, len(axes))

    def noise(white: float, drift: float) -> np.ndarray:
        shocks = drift * np.sqrt(1.0 - keep**2) * rng.standard_normal(shape)
        return white * rng.standard_normal(shape) + lfilter([1.0], [1.0, -keep], shocks, axis=0)

    more: dict[str, Any] = {}
    if kind == "IMU":
        more = {
            "specific_force_m_per_s2": noise(FORCE_WALK, 3.0 * FORCE_WALK)[None] + [0.0, 0.0, 9.81],
            "force_axes": axes,
        }
    rate = noise(WALK, DRIFT)
    log = Log(np.arange(float(count)), rate[None], ("SN1",), axes, np.full((1, count), 20.0), simulated=True, **more)
    write_log(log, path)
