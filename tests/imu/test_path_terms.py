"""Terms of the path of temperature, against a play that is stepped sample by sample, and dense integrals."""

from typing import Any

import numpy as np
import pytest
from path_scene import LEVEL, MOVES, fine, spec_of_table

from gradcal_jax.estimation.executed_nodes import turning_points
from gradcal_jax.formulas import play_states
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.model.build import BuiltImu, build_imu
from gradcal_jax.spec.spec_sections import Spec

DEG = np.pi / 180.0
HOUR = DEG / 3600.0
WIDTHS = (4.0, 9.0)
LINEAR = {"degree": 1, "centre": "20 degC", "scale": "30 K"}
FLAT = LINEAR | {"degree": 0}
BY_RATE = {"degree": 0, "centre": "0 deg/s", "scale": "100 deg/s"}
GYRO: dict[str, Any] = {
    "axes": ["z"], "angle_random_walk": "0.3 deg/sqrt(h)",
    "bias": {"temperature": LINEAR, "prior": "100 deg/h"},
    "scale_factor": {"temperature": FLAT, "rate": BY_RATE, "prior": "5000 ppm"},
    "hysteresis": [{"width": f"{w:g} K", "prior": "2 deg/h/K"} for w in WIDTHS],
    "scale_factor_hysteresis": [{"width": "9 K", "prior": "10 ppm/K"}],
    "term": [{"name": "gradient", "target": "scale_factor", "factors": ["dT/dt"], "prior": "200 ppm/(K/min)"}],
}  # fmt: skip
FORCE: dict[str, Any] = {
    "axes": ["z"], "velocity_random_walk": "0.05 m/s/sqrt(h)",
    "bias": {"prior": "2 mg"}, "scale_factor": {"prior": "500 ppm"},
    "hysteresis": [{"width": "9 K", "prior": "30 ug/K"}],
    "scale_factor_hysteresis": [{"width": "4 K", "prior": "10 ppm/K"}],
}  # fmt: skip
COURSE = [
    {"soak": "3 min", "at": "10 degC", "used": True},
    {"ramp_to": "36 degC", "rate": "2 K/min"},
    {"ramp_to": "24 degC", "rate": "3 K/min"},
    {"ramp_to": "33 degC", "rate": "1.5 K/min"},
    {"ramp_to": "12 degC", "rate": "2 K/min"},
]


def spec_with(sensor: dict[str, Any], plan: dict[str, Any] | None = None, standing: str = "held") -> Spec:
    course = {"method": "gradient", "programme": COURSE, "cycle": {"moves": MOVES}}
    return spec_of_table(sensor, plan or course, standing=standing, **LEVEL)


def stepped(temperature: np.ndarray, width: float, state: float) -> np.ndarray:
    """A play of half-width `width`, step by step, from an initial state: the definition."""
    result = np.empty_like(temperature)
    for k, t in enumerate(temperature):
        state = max(t - width, min(t + width, state))
        result[k] = state
    return result


def test_a_play_is_its_definition_at_every_turning_point():
    random = np.random.default_rng(0)
    temperature = np.cumsum(random.normal(0.0, 5.0, 400))
    for width in (0.5, 4.0, 11.0, 60.0):
        low, high = play_states(temperature, width)
        # To the last bit: nothing is smoothed and nothing is rounded.
        np.testing.assert_array_equal(low, stepped(temperature, width, temperature[0] - width))
        np.testing.assert_array_equal(high, stepped(temperature, width, temperature[0] + width))
        assert np.all(low <= high)
        assert np.all(np.diff(high - low) <= 1e-12)


def test_turning_points_keep_the_states_of_a_course():
    temperature = 20.0 * np.sin(np.linspace(0.0, 15.0, 700)) + np.linspace(0.0, 9.0, 700)
    few = turning_points(temperature)
    assert len(few) < 9
    for width in WIDTHS:
        assert [s[-1] for s in play_states(few, width)] == [s[-1] for s in play_states(temperature, width)]
    assert list(turning_points(np.full(5, 3.0))) == [3.0, 3.0]
    assert list(turning_points(np.array([3.0]))) == [3.0]


def dense_columns(built: BuiltImu) -> dict[str, np.ndarray]:
    """Every path column of a channel over each piece, by sums over fine steps of the motion."""
    steps, (begin, end) = fine(built, 4000), built.motion.line.ends()
    temperature, weight, drive = steps.temperature, steps.weight, steps.rate
    # With the ends of the pieces, where the course turns.
    course = np.concatenate([begin[:1], np.column_stack([temperature, end]).ravel()])
    result = {}
    for width in WIDTHS:
        low, high = (stepped(course, width, course[0] + s * width)[1:] for s in (-1.0, 1.0))
        low, high = (state.reshape(len(end), -1)[:, :-1] for state in (low, high))
        h, left = 0.5 * (low + high) - temperature, (high - low) / (2.0 * width)
        result[f"hysteresis_{width:g}K"] = np.sum(h * weight, axis=1)
        result[f"hysteresis_{width:g}K_start"] = np.sum(left * weight, axis=1)
        result[f"scale_factor_hysteresis_{width:g}K"] = np.sum(h * drive * weight, axis=1)
        result[f"scale_factor_hysteresis_{width:g}K_start"] = np.sum(left * drive * weight, axis=1)
    result["gradient"] = np.sum(steps.slope * drive * weight, axis=1)
    return result


@pytest.mark.long
@pytest.mark.parametrize("lag", [None, "200 s"])
def test_columns_are_the_integrals_of_the_definition(lag):
    sensor = {"gyro": GYRO, "accelerometer": FORCE} | ({} if lag is None else {"thermal_lag": lag})
    built = build_imu(spec_with(sensor))
    model, nodes = built.model, built.body_nodes()
    for c, columns in zip(model.channels, model.own_columns(nodes), strict=True):
        dense = dense_columns(built)
        names = c.names()
        compared = [n for n in dense if n in names and (c.kind == "gyro" or not n.startswith("scale"))]
        assert len(compared) == (7 if c.kind == "gyro" else 2)
        for name in compared:
            own = columns[:, names.index(name)]
            assert np.max(np.abs(own)) > 0.0, name
            assert own == pytest.approx(dense[name], rel=1e-6, abs=1e-6 * np.max(np.abs(own))), name


def rested(gyro: dict[str, Any], programme: list[dict[str, Any]]) -> BuiltImu:
    own = {k: v for k, v in GYRO.items() if k in ("axes", "angle_random_walk", "bias")} | gyro
    return build_imu(spec_with({"gyro": own}, {"method": "gradient", "programme": programme}, "read"))


def test_a_two_way_ramp_sees_what_a_one_way_ramp_does_not():
    """The half-difference of the legs, c·w, keeps its prior on a one-way ramp."""
    one_way = [{"soak": "1 min", "at": "0 degC"}, {"ramp_to": "60 degC", "rate": "1 K/min"}]
    two_way = [
        {"soak": "1 min", "at": "0 degC"},
        {"ramp_to": "60 degC", "rate": "2 K/min"},
        {"ramp_to": "0 degC", "rate": "2 K/min"},
    ]
    gyro = {"hysteresis": [{"width": "4 K", "prior": "5 deg/h/K"}]}
    found = []
    for course in (one_way, two_way):
        built = rested(gyro, course)
        names = built.model.names()
        rows = np.zeros((2, built.model.size))
        rows[0, names.index("gyro_z.hysteresis_4K")] = 4.0
        # The bias as a heating leg has it, at 20 degC.
        rows[1, names.index("gyro_z.a0")], rows[1, names.index("gyro_z.hysteresis_4K")] = 1.0, -4.0
        found.append(imu_posterior(built).deviations(rows) / HOUR)
    (one, heating), (two, _) = found
    assert 0.9 * 20.0 < one < 20.0
    assert two < 0.5
    assert heating < 0.6


def test_what_is_known_before_the_plan_settles_the_initial_state():
    """From the room to 0 degC, and then up: the first 2w of the ramp show the hysteresis. Half a traverse of 2w leaves
    half of the range of the state."""
    programme = [{"soak": "1 min", "at": "0 degC"}, {"ramp_to": "60 degC", "rate": "1 K/min"}]
    own = {k: v for k, v in GYRO.items() if k in ("axes", "angle_random_walk", "bias")}
    gyro = own | {"hysteresis": [{"width": "6 K", "prior": "5 deg/h/K"}]}
    starts, known = [], []
    for before in ([], ["6 degC"], ["20 degC"], ["-40 degC", "20 degC"]):
        plan = {"method": "gradient", "programme": programme, "before": before}
        built = build_imu(spec_with({"gyro": gyro}, plan, "read"))
        names = built.model.names()
        used = np.flatnonzero(~built.motion.line.gap)
        columns = built.model.own_columns(built.body_nodes())[0][used[0]] / built.motion.line.duration[used[0]]
        starts.append([columns[names.index(f"gyro_z.hysteresis_6K{ending}")] for ending in ("", "_start")])
        known.append(imu_posterior(built).deviations(np.eye(built.model.size)[[names.index("gyro_z.hysteresis_6K")]]))
    begins = np.array([[0.0, 1.0], [3.0, 0.5], [6.0, 0.0], [6.0, 0.0]])
    assert np.array(starts) == pytest.approx(begins, abs=0.05)
    assert known[2] < 0.2 * known[0]
    assert known[3] == pytest.approx(known[2], rel=1e-9)
