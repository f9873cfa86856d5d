"""A tactical unit at rest while the chamber goes up, or up and down in the same time (one or two ways), with a loop
over the temperature by a law of its own."""

from functools import lru_cache

import numpy as np
from loop_laws import draw_with_loops

from gradcal_jax.estimation.estimate import SensorEstimate
from gradcal_jax.formulas import legendre
from gradcal_jax.hardware.simulate.draws import draw_table
from gradcal_jax.hardware.simulate.imu import ImuTruth, SimulatedImu
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.information.imu_residual import quantity_of
from gradcal_jax.records.log import Log
from gradcal_jax.spec import spec as specs
from gradcal_jax.spec.spec_sections import Spec

COLD, WARM, LASTING_S = -20.0, 60.0, 4800.0
SIZE, WIDTHS = 10.0, (3.0, 10.0, 30.0)
# Half-widths of plays for relays: those of half-widths of 4 to 29 K, over the temperatures of the plan.
WIDTHS_OF_RELAYS = (6.0, 14.0, 24.0)
HOUR = np.pi / 180.0 / 3600.0
# The legs of the service, which are so long that a mass of 10 min is in its steady state (100 min at 2 K/min).
COLDEST, WARMEST = -200.0, 245.0
AT = np.linspace(0.0, 45.0, 10)


class Course(ChamberPlant):
    """A load that is on the plan's temperatures."""

    def __init__(self, ways: int) -> None:
        super().__init__(ChamberTruth())
        self._ways = ways

    def load_at(self, times_s):
        leg = self._ways * np.asarray(times_s) / LASTING_S
        return COLD + (WARM - COLD) * (1.0 - np.abs(1.0 - leg % 2.0))


@lru_cache
def spec_of(*, ways: int, size: float = SIZE, plays: bool = True, late: bool = False) -> Spec:
    """A tactical unit at rest; `size`: of the hysteresis, deg/h; `ways`: of the chamber in the same time. `late`: the
    terms are those of two thermal masses in the place of plays."""
    slope = ways * (WARM - COLD) / LASTING_S * 60.0
    programme = [{"soak": "10 s", "at": f"{COLD} degC"}]
    programme += [{"ramp_to": f"{(WARM, COLD)[way % 2]} degC", "rate": f"{slope} K/min"} for way in range(ways)]
    of_temperature = {"basis": "polynomial", "degree": 3, "centre": "20 degC", "scale": "40 K"}
    gyro = {
        "angle_random_walk": "0.1 deg/sqrt(h)", "rate_random_walk": "0 deg/h/sqrt(h)", "turn_on_bias": "0 deg/h",
        "drift": [{"standard_deviation": "0.5 deg/h", "correlation_time": "300 s"}],
        "temperature_error": {"standard_deviation": "0 K"}, "bias_temperature_gradient": {"prior": "3 deg/h/(K/min)"},
        "bias": {
            "temperature": of_temperature, "prior": "50 deg/h",
            "discrepancy": {"standard_deviation": "1 deg/h", "temperature_degree": 6},
        },
    }  # fmt: skip
    if late:
        # The difference of masses of τ₁ and τ₂ is c·(τ₂·late(τ₂) − τ₁·late(τ₁)), with c = size/((τ₂ − τ₁)·1 K/min).
        shares = {1.0: 1.0 / 9.0, 10.0: 10.0 / 9.0}
        gyro["late_temperature_gradient"] = [
            {"time_constant": f"{t} min", "prior": f"{size * share} deg/h/(K/min)"} for t, share in shares.items()
        ]
    elif plays:
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


@lru_cache
def type_of_relays(units: int = 60) -> tuple[dict[float, float], float]:
    """What plays are of loops of relays of `SIZE`, by other units without noise: the root mean squares of the
    coefficient of every width, deg/h/K, where that of the middle one varies over temperature, and of what is left,
    deg/h.

    On both legs of the plan's course, and of one so wide that every relay switches: steady cycles, over the plan's
    temperatures, with the plan's maps."""
    courses = [
        np.concatenate([up, up[::-1], up, up[::-1]])
        for up in (np.arange(low, high + 0.1, 0.25) for low, high in ((COLD, WARM), (COLDEST, WARMEST)))
    ]
    kept = [(np.arange(len(t)) >= len(t) // 2) & (t >= COLD) & (t <= WARM) for t in courses]
    columns = []
    for t, steady in zip(courses, kept, strict=True):
        plays, x = [_behind(t, width) for width in WIDTHS_OF_RELAYS], (t - 20.0) / 40.0
        varying = [plays[1] * of for of in legendre(x, 10).T[1:]]
        columns.append(np.stack([*(x**power for power in range(4)), *plays, *varying], axis=1)[steady])
    design, coefficients, left = np.concatenate(columns), [], []
    for number in range(units):
        for loop in draw_with_loops(spec_of(ways=2), 41, number, "relays").triads["gyro"].loops:
            loops = [loop.begin(float(t[0]))(t, 1.0)[steady] for t, steady in zip(courses, kept, strict=True)]
            found = np.linalg.lstsq(design, np.concatenate(loops) / HOUR, rcond=None)[0]
            coefficients += [*found[4:7].T]
            left += [*(np.concatenate(loops) / HOUR - design @ found).T]
    sizes = np.sqrt(np.mean(np.square(coefficients), axis=0)).tolist()
    return dict(zip(WIDTHS_OF_RELAYS, sizes, strict=True)), float(np.sqrt(np.mean(np.square(left))))


def _behind(temperatures_c: np.ndarray, width_k: float) -> np.ndarray:
    """A play less its temperature, K."""
    play, values = temperatures_c[0], []
    for t in temperatures_c:
        play = max(t - width_k, min(t + width_k, play))
        values.append(play - t)
    return np.array(values)


def recorded(truth: ImuTruth, spec: Spec, *, ways: int, seed: int) -> Log:
    table, _, _ = draw_table(spec, seed)
    unit = SimulatedImu(truth, table, Course(ways), [AxisPlant()], sample_rate_hz=1.0, seed=seed)
    kept = unit.take(int(LASTING_S))
    rate, count = np.radians(kept.rate_dps), int(LASTING_S)
    rate[count // 2] = np.nan
    number = (np.arange(count) >= count // 2).astype(int)
    angles = ("turn",), np.zeros((count, 1))
    at = kept.temperature_c[None]
    second = None if kept.second_c is None else kept.second_c[None]
    fields = {"simulated": True, "second_temperature_c": second}
    return Log(kept.time_s, rate[None], ("u",), ("x", "y", "z"), at, *angles, None, number, **fields)


def on_branches(truth: ImuTruth) -> np.ndarray:
    """`(2, n, 3)`: the true bias at `AT` on a heating and on a cooling leg at 2 K/min, rad/s."""
    triad = truth.triads["gyro"]
    # The map's, and what a discrepancy says that it lacks.
    biases = [error for error in triad.errors if error.factors == "one" and not error.differs]
    none = np.zeros((len(AT), 3))
    both, course = [], np.arange(COLDEST, WARMEST, 2.0 / 60.0)
    loops = [loop.begin(COLDEST) for loop in triad.loops]
    for sign, leg in ((1.0, course), (-1.0, course[::-1]), (1.0, course)):
        values = sum((loop(leg, 1.0) for loop in loops), np.zeros((len(leg), 3)))
        order = np.argsort(leg)
        path = np.stack([np.interp(AT, leg[order], values[order, k]) for k in range(3)], axis=1)
        slope = sign * np.array(triad.gradient) * 2.0 / 60.0
        both.append(sum((bias(none, none, AT) for bias in biases), path + slope))
    return np.stack([both[2], both[1]])


def errors_on_branches(report: SensorEstimate, truth: ImuTruth) -> tuple[np.ndarray, np.ndarray]:
    """Error of the estimate on both branches, and its predicted standard deviation, `(2, n, 3)`, deg/h."""
    built, solution = report.built, report.solution
    true, errors, stds = on_branches(truth), np.zeros((2, len(AT), 3)), np.zeros((2, len(AT), 3))
    for branch, requirement in enumerate(built.spec.requirement):
        for k, element in enumerate(quantity_of(built, requirement).elements):
            assert element.path is not None
            at_rest = element.contrasts()
            # The discrepancy is estimated and is no part of a calibration.
            rows = np.asarray(at_rest.rows) - np.asarray(at_rest.alone) + element.path[0]
            errors[branch, :, k] = rows @ solution.parameters[element.where] - true[branch, :, k]
            stds[branch, :, k] = element.deviations(solution.known)
    return errors / HOUR, stds / HOUR
