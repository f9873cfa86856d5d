"""The loops of three recorded MEMS gyros over temperature, without and with plays: `python make.py` writes loop.png.

The record is `tofupilot_imu_thermal_cycle.npz` (tofupilot/examples, MIT; read as µs and rad/s) in the folder that the
environment variable GRADCAL_DATA names: three gyros at rest, 52 → −17 → 74 → 36 °C in 71 minutes.
"""

import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gradcal_jax.estimation.estimate import SensorEstimate, estimate_sensors
from gradcal_jax.plots import save
from gradcal_jax.plots.calibration import draw_loop
from gradcal_jax.plots.style import new_panels
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


def main() -> None:
    """Estimate both ways, and draw."""
    jax.config.update("jax_enable_x64", True)
    log, reports = record(), list[SensorEstimate]()
    for plays in (False, True):
        reports += estimate_sensors(spec(plays=plays), [log])
    figure, panels = new_panels(2, 3, (3.4, 2.6))
    for row, report in zip(panels, reports, strict=True):
        for curve, ax in zip(report.curves, row, strict=True):
            draw_loop(curve, ax=ax)
    for ax, words in zip(panels[:, 0], ("a cubic in temperature", f"with plays of {WIDTHS} K"), strict=True):
        ax.set_ylabel(f"{words}\ndeg/h")
    save(figure, HERE / "loop.png")


if __name__ == "__main__":
    main()
