"""A tactical unit at rest while the chamber goes up, or up and down in the same time (one or two ways), with a loop
over the temperature by a law of its own."""

from functools import lru_cache

import numpy as np

from gradcal_jax.hardware.simulate.draws import draw_table
from gradcal_jax.hardware.simulate.imu import ImuTruth, SimulatedImu
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.records.log import Log
from gradcal_jax.spec import spec as specs
from gradcal_jax.spec.spec_sections import Spec

COLD, WARM, LASTING_S = -20.0, 60.0, 4800.0
SIZE, WIDTHS = 10.0, (3.0, 10.0, 30.0)


class Course(ChamberPlant):
    """A load that is on the plan's temperatures."""

    def __init__(self, ways: int) -> None:
        super().__init__(ChamberTruth())
        self._ways = ways

    def load_at(self, times_s):
        leg = self._ways * np.asarray(times_s) / LASTING_S
        return COLD + (WARM - COLD) * (1.0 - np.abs(1.0 - leg % 2.0))


@lru_cache
def spec_of(*, ways: int, size: float = SIZE, plays: bool = True) -> Spec:
    """A tactical unit at rest; `size`: of the hysteresis, deg/h; `ways`: of the chamber in the same time."""
    slope = ways * (WARM - COLD) / LASTING_S * 60.0
    programme = [{"soak": "10 s", "at": f"{COLD} degC"}]
    programme += [{"ramp_to": f"{(WARM, COLD)[way % 2]} degC", "rate": f"{slope} K/min"} for way in range(ways)]
    of_temperature = {"degree": 3, "centre": "20 degC", "scale": "40 K"}
    gyro = {
        "angle_random_walk": "0.1 deg/sqrt(h)", "rate_random_walk": "0 deg/h/sqrt(h)", "turn_on_bias": "0 deg/h",
        "drift": [{"standard_deviation": "0.5 deg/h", "correlation_time": "300 s"}],
        "temperature_error": {"standard_deviation": "0 K"}, "bias_temperature_gradient": {"prior": "3 deg/h/(K/min)"},
        "bias": {
            "temperature": of_temperature, "prior": "50 deg/h",
            "discrepancy": {"standard_deviation": "1 deg/h", "temperature_degree": 6},
        },
    }  # fmt: skip
    if plays:
        prior = size / 3.0**0.5
        gyro["hysteresis"] = [{"width": f"{w} K", "prior": f"{prior / w} deg/h/K"} for w in WIDTHS]
    axis = {
        "name": "turn", "direction": [0, 0, 1], "max_rate": "100 deg/s", "max_acceleration": "100 deg/s^2",
        "angle": {
            "reading_noise": "0.1 arcsec", "standstill_offset": "0 arcsec", "read_every": "30 s", "harmonics": [],
        },
    }  # fmt: skip
    return specs.spec_of({
        "format": "gradcal-spec/1",
        "sensor": {
            "grade": "tactical", "clock": "sensor", "temperature_offset": "0 K", "temperature_lag": "0 s",
            "thermal_lag": "0 s", "sample_clock_error": "0 ppm", "gyro": gyro,
        },
        "rig": {
            "site": {"latitude": "45 deg", "gravity": "9.8 m/s^2"},
            "table": {"axis": [axis], "standing": "read", "tilt": "0 deg", "azimuth": "0 deg"},
            "chamber": {"range": ["-40 degC", "85 degC"], "max_heating": "3 K/min", "max_cooling": "3 K/min"},
        },
        "requirement": [
            {
                "name": branch, "quantity": "gyro_bias", "temperature": ["0 degC", "45 degC"], "grid": [10],
                "branch": branch, "slope": [f"{low} K/min", f"{high} K/min"], "axis": "all", "statistic": "rms",
            }
            for branch, low, high in (("heating", 2.0, 2.0), ("cooling", -2.0, -2.0))
        ],
        "plan": {"method": "gradient", "programme": programme},
    })  # fmt: skip


def recorded(truth: ImuTruth, spec: Spec, *, ways: int, seed: int) -> Log:
    table, _, _ = draw_table(spec, seed)
    unit = SimulatedImu(truth, table, Course(ways), [AxisPlant()], sample_rate_hz=1.0, seed=seed)
    kept = unit.take(int(LASTING_S))
    rate, count = np.radians(kept.rate_dps), int(LASTING_S)
    rate[count // 2] = np.nan
    number = (np.arange(count) >= count // 2).astype(int)
    angles = ("turn",), np.zeros((count, 1))
    at = kept.temperature_c[None]
    return Log(kept.time_s, rate[None], ("u",), ("x", "y", "z"), at, *angles, None, number, simulated=True)
