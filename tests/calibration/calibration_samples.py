"""Calibrations with any bases, and of an IMU with known errors, for the tests of this folder."""

import imu_twin
import numpy as np

from gradcal_jax.calibration.equation import equation
from gradcal_jax.calibration.file import Calibration
from gradcal_jax.records.log import Log

G = 9.80665

POLYNOMIAL_T = {"degree": 3, "centre": "20 degC", "scale": "50 K"}
POLYNOMIAL_W = {"degree": 3, "scale": "300 deg/s"}
SPLINE_T = {"knots": ["-30 degC", "0 degC", "40 degC", "70 degC"]}
BINS_W = {"degree": 0, "knots": ["-300 deg/s", "0 deg/s", "300 deg/s"]}
LINEAR = POLYNOMIAL_T | {"degree": 1}


def channel(kind, axis, terms, **more):
    ranges = {"valid_temperature": ["-30 degC", "70 degC"], "valid_rate": ["-300 deg/s", "300 deg/s"]}
    return {"kind": kind, "axis": axis, "term": terms} | ranges | more


def term(name, unit, signals, coefficients, **bases):
    return {"name": name, "unit": unit, "signals": signals, "coefficients": coefficients} | bases


def axis(name, temperature=POLYNOMIAL_T, rate=POLYNOMIAL_W, *, terms=(), seed=0, size=3e-3, **more):
    """A gyro's channel with further terms; `more` are its keys."""
    rng = np.random.default_rng(seed)
    spline, bins = "knots" in temperature, "knots" in rate
    of_t = [f"{'_spline' * spline}{i}" for i in range(6 if spline else 4)]
    of_w = [f"b{'_bin' * bins}{j}{'_' * (spline or bins)}" for j in range(2 if bins else 4)]
    bias = {f"a{i}": 1e-3 * rng.standard_normal() for i in of_t}
    scale = {j + i: size * rng.standard_normal() for i in of_t for j in of_w}
    own = [term("bias", "rad/s", [], bias, temperature=temperature)]
    own += [term("scale_factor", "1", [f"rate {name}"], scale, temperature=temperature, rate=rate)]
    return channel("gyro", name, [*own, *terms], **more)


def of(*channels):
    known = {"format": "gradcal-calibration/3", "serial_number": "SN-7", "simulated": True}
    known |= {"frame": "the sensor's own axes", "order": "measured = (1 + M(T, rate)) * rate + B(T)"}
    return Calibration.model_validate(known | {"channel": channels})


WHOLE = of(axis("x"), axis("y", seed=1), axis("z", seed=2))


def a_truth(seed: int = 3) -> dict[str, float]:
    """Errors of a consumer IMU, by the coefficients' names."""
    rng = np.random.default_rng(seed)
    truth = {}
    for a in "xyz":
        truth |= {f"gyro_{a}.a{k}": 2e-3 * v for k, v in enumerate(rng.standard_normal(4))}
        truth |= {f"gyro_{a}.b{j}{i}": 3e-3 * rng.standard_normal() for i in range(4) for j in range(4)}
        truth |= {f"gyro_{a}.g_{b}": 1e-5 * rng.standard_normal() for b in "xyz"}
        truth |= {f"accelerometer_{a}.a{k}": 0.1 * v for k, v in enumerate(rng.standard_normal(4))}
        truth |= {f"accelerometer_{a}.s{k}": 3e-3 * v for k, v in enumerate(rng.standard_normal(4))}
        truth[f"accelerometer_{a}.k2"] = 1e-5 * rng.standard_normal()
        for kind in ("gyro", "accelerometer"):
            truth |= {f"{kind}_{a}.m_{b}{k}": 5e-3 * rng.standard_normal() for b in "xyz" if b != a for k in range(2)}
    return truth


def calibration_of(truth: dict[str, float]) -> Calibration:
    """Of an IMU that has these errors."""
    channels = []
    for kind, own in (("gyro", "rate"), ("accelerometer", "force")):
        for a in "xyz":
            values = {k.partition(".")[2]: v for k, v in truth.items() if k.startswith(f"{kind}_{a}.")}

            def part(called, unit, signals, prefix, *, values=values, **bases):
                return term(called, unit, signals, {k: v for k, v in values.items() if k.startswith(prefix)}, **bases)

            of_t = {"temperature": POLYNOMIAL_T}
            terms = [part("bias", "rad/s" if kind == "gyro" else "m/s^2", [], "a", **of_t)]
            if kind == "gyro":
                terms.append(part("scale_factor", "1", ["rate " + a], "b", rate=POLYNOMIAL_W, **of_t))
                terms += [part("g_sensitivity_" + b, "rad/s/(m/s^2)", ["force " + b], "g_" + b) for b in "xyz"]
            else:
                terms.append(part("scale_factor", "1", ["force " + a], "s", **of_t))
                terms.append(part("second_order", "1/(m/s^2)", ["force " + a] * 2, "k2"))
            for b in "xyz".replace(a, ""):
                terms.append(part(f"misalignment_{b}", "rad", [f"{own} {b}"], f"m_{b}", temperature=LINEAR))
            channels.append(channel(kind, a, terms))
    return of(*channels)


def readings(truth: dict[str, float], count: int = 400) -> tuple[Log, np.ndarray, np.ndarray]:
    """A log of such an IMU by the twin's own formulas, and the true rates and forces."""
    rng = np.random.default_rng(0)
    rate = rng.uniform(-5.0, 5.0, (count, 3))
    force = rng.uniform(-G, G, (count, 3))
    temperature = rng.uniform(-29.0, 69.0, count)
    warm = (temperature - 20.0) / 50.0
    said = imu_twin.said_by(truth, "gyro", rate, force, warm, np.radians(300.0))
    felt = imu_twin.said_by(truth, "accelerometer", force, force, warm)
    log = Log(
        np.arange(count) * 0.01, said[None], ("SN-7",), tuple("xyz"), temperature[None],
        specific_force_m_per_s2=felt[None], force_axes=tuple("xyz"),
    )  # fmt: skip
    return log, rate, force


def gyro(calibration: Calibration, rate: np.ndarray, temperature: np.ndarray, axis: str = "x") -> np.ndarray:
    """The output of a calibration's gyro for true rates: the calibration forwards."""
    channel = next(channel for channel in calibration.channel if channel.name == f"gyro_{axis}")
    return rate + equation([channel], [channel.input], [temperature]).errors(rate[None])[0]


def largest(errors: np.ndarray) -> float:
    return float(np.max(np.abs(errors)))
