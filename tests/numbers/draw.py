"""What is drawn once and then recorded: calibration files, and small logs of simulated runs."""

import gzip
import json
import tempfile
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import calibration_samples as samples
import logs_zoo
import numpy as np
from estimate_scenes import draw_truth, record, scene
from simulated_log import simulate_log

from gradcal_jax.records.log import Log
from gradcal_jax.records.log_file import write_log
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.spec import parse_spec

HERE = Path(__file__).resolve().parent
Tables = dict[str, Any]
# Resolution of what is kept of a log, far below the sensors' noise, so that it packs: rad/s, m/s², °C, rad.
_STEPS = {
    "rate_rad_per_s": 2**-22,
    "specific_force_m_per_s2": 2**-18,
    "temperature_c": 2**-10,
    "table_angle_rad": 2**-28,
}


def calibrations() -> dict[str, Tables]:
    """Ten of axes and ten of units: polynomials, splines and bins; one axis or three; all sizes of error."""
    found: dict[str, Tables] = {}
    bases = {
        "polynomials": {},
        "splines": {"temperature": samples.SPLINE_T, "n_t": 6},
        "bins": {"rate": samples.BINS_W, "n_w": 2},
        "splines and bins": {"temperature": samples.SPLINE_T, "n_t": 6, "rate": samples.BINS_W, "n_w": 2},
        "large": {"size": 3e-2},
    }
    for seed, (kind, options) in enumerate(bases.items()):
        for axes in ("x", "xyz"):
            parts = [samples.axis_text(a, seed=10 * seed + k, **options) for k, a in enumerate(axes)]
            found[f"axes {axes}, {kind}"] = tomllib.loads(samples.HEAD + "".join(parts))
    return found | {f"unit {k}": unit(np.random.default_rng(k), k) for k in range(10)}


def unit(rng: np.random.Generator, number: int) -> Tables:
    """A unit's calibration file; even numbers have gyros and accelerometers, every fourth a gyro alone."""
    polynomial = {"basis": "polynomial", "degree": 3, "centre": "20 degC", "scale": "50 K"}
    spline = {"basis": "b-spline", "knots": ["-30 degC", "0 degC", "40 degC", "70 degC"]}
    warm, name, count = (spline, "a_spline", 6) if number % 3 == 2 else (polynomial, "a", 4)
    rate = {"basis": "polynomial", "degree": 3, "scale": "300 deg/s"}
    kinds = ("gyro",) if number % 4 == 3 else ("accelerometer",) if number % 4 == 1 else ("gyro", "accelerometer")

    def term(called: str, unit: str, signals: list[str], coefficients: dict[str, float], **more: Any) -> Tables:
        return {"name": called, "unit": unit, "signals": signals, "coefficients": coefficients} | more

    def of(names: list[str], size: float) -> dict[str, float]:
        return dict(zip(names, (size * rng.standard_normal(len(names))).tolist(), strict=True))

    channels = []
    for kind in kinds:
        own, unit_of = ("rate", "rad/s") if kind == "gyro" else ("force", "m/s^2")
        for a in "xyz":
            bias = of([f"{name}{k}" for k in range(count)], 2e-3 if kind == "gyro" else 0.1)
            terms = [term("bias", unit_of, [], bias, temperature=warm)]
            if kind == "gyro":
                scale = of([f"b{j}{i}" for i in range(4) for j in range(4)], 3e-3)
                terms.append(term("scale_factor", "1", [f"rate {a}"], scale, temperature=polynomial, rate=rate))
                terms += [
                    term(f"g_sensitivity_{b}", "rad/s/(m/s^2)", [f"force {b}"], of([f"g_{b}"], 1e-5))
                    for b in "xyz"
                    if len(kinds) == 2
                ]
            else:
                scale = of([f"s{k}" for k in range(4)], 3e-3)
                terms.append(term("scale_factor", "1", [f"force {a}"], scale, temperature=polynomial))
                terms.append(term("second_order", "1/(m/s^2)", [f"force {a}"] * 2, of(["k2"], 1e-5)))
            linear = polynomial | {"degree": 1}
            terms += [
                term(f"misalignment_{b}", "rad", [f"{own} {b}"], of([f"m_{b}{k}" for k in range(2)], 5e-3)) | more
                for b in "xyz"
                if b != a
                for more in ({"temperature": linear},)
            ]
            channels.append({"kind": kind, "axis": a, "term": terms})
    return {
        "format": "gradcal-calibration/1", "serial_number": "SN 1", "quantity": "unit", "simulated": bool(number % 2),
        "frame": "the table's axes", "order": "measured = input + sum",
        "valid_temperature": ["-30 degC", "70 degC"], "valid_rate": ["-300 deg/s", "300 deg/s"], "channel": channels,
    } | ({"thermal_lag": "90 s"} if number == 4 else {})  # fmt: skip


def logs() -> None:
    """Six small logs beside this file, with their specs as tables in logs/specs.json."""
    short = parse_spec(logs_zoo.GRADIENT)
    standard = parse_spec(logs_zoo.STANDARD)
    quick = parse_spec(logs_zoo.GRADIENT.replace('gradient = "4 K/min"', 'gradient = "5 K/min"'))
    kept: dict[str, tuple[Any, list[Log]]] = {
        "axis ramp": (short, [simulate_log(short, sample_rate_hz=5.0, seed=1).log]),
        "axis readings": (short, [simulate_log(short, sample_rate_hz=5.0, seed=2, readings=True).log]),
        "axis quick, two sensors": (quick, [simulate_log(quick, units=2, sample_rate_hz=5.0, seed=3).log]),
        "axis standard": (standard, [simulate_log(standard, sample_rate_hz=2.0, seed=4).log]),
    }
    for plan, minutes, seed in (("two axes", 6.0, 5), ("one axis, three mountings", 3.0, 6)):
        spec, rng = scene(plan, 1.0, minutes), np.random.default_rng(seed)
        kept[f"unit {plan}"] = (spec, record(spec, draw_truth(spec, rng), rng, rate_hz=5.0))
    folder = HERE / "logs"
    folder.mkdir(exist_ok=True)
    for name, (_, several) in kept.items():
        for number, log in enumerate(several):
            rounded = {f: step * np.round(v / step) for f, step in _STEPS.items() if (v := getattr(log, f)) is not None}
            with tempfile.TemporaryDirectory() as scratch:
                write_log(replace(log, **rounded), Path(scratch, "log.nc"))
                packed = gzip.compress(Path(scratch, "log.nc").read_bytes(), mtime=0)
            (folder / f"{name}, {number}.nc.gz").write_bytes(packed)
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(tables_of(spec))}" for name, (spec, _) in kept.items())
    (folder / "specs.json").write_text("{\n" + lines + "\n}\n", encoding="utf-8")
