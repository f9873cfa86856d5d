"""The loops of three recorded MEMS gyros over temperature, without and with plays: `python make.py` writes loop.png.

The record is `tofupilot_imu_thermal_cycle.npz` (tofupilot/examples, MIT; read as µs and rad/s) in the folder that the
environment variable GRADCAL_DATA names: three gyros at rest, 52 → −17 → 74 → 36 °C in 71 minutes.
"""

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gradcal_jax.estimation.bias_curves import BiasCurve
from gradcal_jax.estimation.estimate import SensorEstimate, estimate_sensors
from gradcal_jax.information.residual import UNITS_OF_TERMS
from gradcal_jax.plots import save
from gradcal_jax.plots.style import PALETTE
from gradcal_jax.records.log import Log
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec

HERE = Path(__file__).parent
WIDTHS = (3, 10, 30)
COURSE = [
    {"soak": "1 min", "at": "52 degC"},
    {"ramp_to": "-17 degC", "rate": "3 K/min"},
    {"ramp_to": "74 degC", "rate": "3 K/min"},
    {"ramp_to": "36 degC", "rate": "2 K/min"},
]


def record() -> Log:
    """The record as a log of two standstills; the row between them is left out."""
    with np.load(Path(os.environ["GRADCAL_DATA"]) / "tofupilot_imu_thermal_cycle.npz") as data:
        stamps, temperature, rate = (data[key][1:] for key in ("timestamp_raw", "temperature_C", "gyro"))
    count, rate = len(stamps), rate.astype(float)
    rate[count // 2] = np.nan
    number = (np.arange(count) >= count // 2).astype(int)
    time, at = (stamps - stamps[0]) * 1e-6, temperature.astype(float)[None]
    return Log(time, rate[None], ("unit",), ("x", "y", "z"), at, ("turn",), np.zeros((count, 1)), None, number)


def spec(*, plays: bool) -> Spec:
    """Three gyros at rest, the noise as the record shows it."""
    cubic = {"degree": 3, "centre": "30 degC", "scale": "50 K"}
    gyro: dict[str, Any] = {
        "angle_random_walk": "0.6 deg/sqrt(h)",
        "drift": [{"standard_deviation": "250 deg/h", "correlation_time": "20 min"}],
        "bias": {"temperature": cubic, "prior": "5000 deg/h"},
    }
    if plays:
        gyro["hysteresis"] = [{"width": f"{w} K", "prior": "60 deg/h/K"} for w in WIDTHS]
    axis = {"name": "turn", "direction": [0, 0, 1], "max_rate": "100 deg/s", "max_acceleration": "100 deg/s^2"}
    angle = {"reading_noise": "1 arcsec", "standstill_offset": "0 arcsec", "read_every": "30 s"}
    return spec_of({
        "format": "gradcal-spec/1",
        "sensor": {"gyro": gyro},
        "rig": {
            "site": {"latitude": "45 deg"},
            "table": {"axis": [axis | {"angle": angle}], "standing": "read"},
            "chamber": {"range": ["-40 degC", "90 degC"], "max_heating": "10 K/min", "max_cooling": "10 K/min"},
        },
        "plan": {"method": "gradient", "programme": COURSE},
    })  # fmt: skip


def draw_loop(curve: BiasCurve, ax: Axes) -> None:
    """The difference between a channel's bias and its map, over temperature, on every leg: as measured, and as modelled
    with ± 2 standard deviations."""
    unit, factor = UNITS_OF_TERMS[curve.si_unit]
    for first, end in legs_of(curve.temperature_c):
        own = slice(first, end)
        heats = curve.temperature_c[end - 1] > curve.temperature_c[first]
        at, colour = curve.temperature_c[own], PALETTE[1 if heats else 0]
        seen, fitted = ((v - curve.map)[own] * factor for v in (curve.measured, curve.model))
        std = curve.std[own] * factor
        ax.plot(at, seen, ".", markersize=3, color=colour)
        dash = "-" if heats else "--"
        ax.plot(at, fitted, dash, color=colour, label="heating" if heats else "cooling")
        ax.fill_between(at, fitted - 2.0 * std, fitted + 2.0 * std, alpha=0.15, color=colour)
    handles, labels = ax.get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    ax.legend(by_label.values(), by_label.keys(), fontsize="small")
    ax.set(xlabel="temperature, °C", ylabel=unit, title=f"{curve.channel.replace('_', ' ')}: bias beyond its map")


def legs_of(temperature: np.ndarray) -> list[tuple[int, int]]:
    """Rows `first … end − 1` of every heating or cooling leg of more than a twentieth of the range."""
    least, legs = 0.05 * float(np.ptp(temperature)), [0]
    highest = lowest = 0
    # A leg ends where the temperature has returned by that from its extreme.
    way = 0
    for k, t in enumerate(temperature):
        highest, lowest = (k if t > temperature[highest] else highest), (k if t < temperature[lowest] else lowest)
        if way >= 0 and temperature[highest] - t > least:
            legs, way, lowest = [*legs, highest], -1, k
        elif way <= 0 and t - temperature[lowest] > least:
            legs, way, highest = [*legs, lowest], 1, k
    edges = [*legs, len(temperature) - 1]
    return [(a, b + 1) for a, b in pairwise(edges) if abs(temperature[b] - temperature[a]) >= least]


def main() -> None:
    """Estimate both ways, and draw."""
    jax.config.update("jax_enable_x64", True)
    log, reports = record(), list[SensorEstimate]()
    for plays in (False, True):
        reports += estimate_sensors(spec(plays=plays), [log])
    figure = Figure(figsize=(10.2, 5.2), layout="constrained")
    panels = figure.subplots(2, 3)
    for row, report in zip(panels, reports, strict=True):
        for curve, ax in zip(report.curves, row, strict=True):
            draw_loop(curve, ax)
    for ax, words in zip(panels[:, 0], ("a cubic in temperature", f"with plays of {WIDTHS} K"), strict=True):
        ax.set_ylabel(f"{words}\ndeg/h")
    save(figure, HERE / "loop.png")


if __name__ == "__main__":
    main()
