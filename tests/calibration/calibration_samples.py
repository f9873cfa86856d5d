"""Calibrations with any bases, and of an IMU with known errors, for the tests of this folder."""

import imu_twin
import numpy as np

from gradcal_jax.calibration import Calibration
from gradcal_jax.calibration.correction import channel_error
from gradcal_jax.records.log import Log

G = 9.80665

POLYNOMIAL_T = 'temperature = { degree = 3, centre = "20 degC", scale = "50 K" }'
POLYNOMIAL_W = 'rate = { degree = 3, scale = "300 deg/s" }'
SPLINE_T = 'temperature = { knots = ["-30 degC", "0 degC", "40 degC", "70 degC"] }'
BINS_W = 'rate = { degree = 0, knots = ["-300 deg/s", "0 deg/s", "300 deg/s"] }'


def axis_text(name, temperature=POLYNOMIAL_T, rate=POLYNOMIAL_W, seed=0, size=3e-3, more="", terms=""):
    """A gyro's channel: `more` are keys of the channel, `terms` further terms."""
    rng = np.random.default_rng(seed)
    spline, bins = "knots" in temperature, "knots" in rate
    n_t, n_w = 6 if spline else 4, 2 if bins else 4
    a = [f"a{'_spline' * spline}{i}" for i in range(n_t)]
    of_t = [f"{'_' * (spline or bins)}{'_spline' * spline}{i}" for i in range(n_t)]
    b = [f"b{'_bin' * bins}{j}{i}" for i in of_t for j in range(n_w)]
    lines = ["[[channel]]", 'kind = "gyro"', f'axis = "{name}"', 'valid_temperature = ["-30 degC", "70 degC"]']
    lines += ['valid_rate = ["-300 deg/s", "300 deg/s"]', more]
    lines += ["[[channel.term]]", 'name = "bias"', 'unit = "rad/s"', temperature, "[channel.term.coefficients]"]
    lines += [f"{n} = {v!r}" for n, v in zip(a, (1e-3 * rng.standard_normal(n_t)).tolist(), strict=True)]
    lines += ["[[channel.term]]", 'name = "scale_factor"', 'unit = "1"', f'signals = ["rate {name}"]']
    lines += [temperature, rate, "[channel.term.coefficients]"]
    lines += [f"{n} = {v!r}" for n, v in zip(b, (size * rng.standard_normal(n_t * n_w)).tolist(), strict=True)]
    return "\n".join([*lines, terms]) + "\n"


HEAD = """format = "gradcal-calibration/3"
serial_number = "SN-7"
simulated = true
frame = "the sensor's own axes"
order = "measured = (1 + M(T, rate)) * rate + B(T)"
"""
WHOLE = HEAD + axis_text("x") + axis_text("y", seed=1) + axis_text("z", seed=2)


TEMPERATURE = {"degree": 3, "centre": "20 degC", "scale": "50 K"}
LINEAR = TEMPERATURE | {"degree": 1}
RANGES = {"valid_temperature": ["-30 degC", "70 degC"], "valid_rate": ["-300 deg/s", "300 deg/s"]}
RATE = {"degree": 3, "scale": "300 deg/s"}


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


def document(truth: dict[str, float]) -> dict:
    """The file of an IMU that has these errors."""
    channels = []
    for kind, own in (("gyro", "rate"), ("accelerometer", "force")):
        for a in "xyz":
            name = f"{kind}_{a}."
            of = {k.removeprefix(name): v for k, v in truth.items() if k.startswith(name)}

            def term(called, unit, signals, prefix, of=of, **bases):
                values = {k: v for k, v in of.items() if k.startswith(prefix)}
                return {"name": called, "unit": unit, "signals": signals, "coefficients": values} | bases

            terms = [term("bias", "rad/s" if kind == "gyro" else "m/s^2", [], "a", temperature=TEMPERATURE)]
            if kind == "gyro":
                terms.append(term("scale_factor", "1", [f"rate {a}"], "b", temperature=TEMPERATURE, rate=RATE))
                terms += [term(f"g_sensitivity_{b}", "rad/s/(m/s^2)", [f"force {b}"], f"g_{b}") for b in "xyz"]
            else:
                terms.append(term("scale_factor", "1", [f"force {a}"], "s", temperature=TEMPERATURE))
                terms.append(term("second_order", "1/(m/s^2)", [f"force {a}"] * 2, "k2"))
            for b in "xyz":
                if b != a:
                    terms.append(term(f"misalignment_{b}", "rad", [f"{own} {b}"], f"m_{b}", temperature=LINEAR))
            channels.append({"kind": kind, "axis": a, "term": terms})
    return {
        "format": "gradcal-calibration/3",
        "serial_number": "SN 1",
        "simulated": True,
        "frame": "the table's axes",
        "order": "measured = input + sum",
        "channel": [channel | RANGES for channel in channels],
    }


def calibration_of(truth: dict[str, float]) -> Calibration:
    return Calibration.model_validate(document(truth))


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
        np.arange(count) * 0.01, said[None], ("SN 1",), tuple("xyz"), temperature[None],
        specific_force_m_per_s2=felt[None], force_axes=tuple("xyz"),
    )  # fmt: skip
    return log, rate, force


def gyro(calibration: Calibration, rate: np.ndarray, temperature: np.ndarray, axis: str = "x") -> np.ndarray:
    """The output of a calibration's gyro for true rates: the calibration forwards."""
    channel = next(channel for channel in calibration.channel if channel.name == f"gyro_{axis}")
    return rate + channel_error(channel, temperature, {channel.input: rate})
