"""A unit's bins and B-splines: pieces are divided where functions are not smooth, so that predictions are exact.

Every right answer is a small inverse in this file: the row of a segment weighs each function by the time spent at each
temperature, or the angle turned at each rate; the information is `Σ f fᵀ / (N² duration) + 1/prior²`.
"""

import numpy as np
import pytest

from gradcal_jax.formulas import b_spline
from gradcal_jax.model.build import build_imu, imu_posterior
from gradcal_jax.spec.spec import parse_spec

DEG_PER_H = np.radians(1.0) / 3600.0
N = np.radians(0.15) / 60.0
EARTH = 7.292115e-5
SPEC = """
format = "gradcal-spec/1"
[sensor.gyro]
axes = [{axes}]
angle_random_walk = "0.15 deg/sqrt(h)"
{maps}
[rig.site]
latitude = "{latitude} deg"
[rig.table]
[[rig.table.axis]]
name = "a"
direction = [{direction}]
max_rate = "300 deg/s"
max_acceleration = "400 deg/s^2"
[rig.chamber]
range = ["-40 degC", "85 degC"]
max_heating = "4 K/min"
max_cooling = "4 K/min"
[plan]
method = "gradient"
temperature = ["-30 degC", "70 degC"]
gradient = "2 K/min"
[plan.cycle]
moves = [{moves}]
"""
CONSTANT = 'temperature = { degree = 0, centre = "20 degC", scale = "50 K" }'
# As good as no bias.
NO_BIAS = f'bias = {{ {CONSTANT}, prior = "0.000001 deg/h" }}'


def sigmas(text: str) -> dict[str, float]:
    """Standard deviations of the reported parameters, SI."""
    built = build_imu(parse_spec(text))
    spread = built.model.to_reported @ imu_posterior(built).spread
    return dict(zip(built.model.names(), np.sqrt(np.sum(spread**2, axis=1)), strict=True))


def by_hand(rows: list[np.ndarray], durations: list[float], prior: float) -> np.ndarray:
    """The same from each segment's weights and duration (s)."""
    f = np.array(rows) / (N * np.sqrt(np.array(durations)))[:, None]
    return np.sqrt(np.diag(np.linalg.inv(f.T @ f + np.eye(f.shape[1]) / prior**2)))


TURNS = [(400.0, 100.0, 8.0), (-400.0, 100.0, 8.0), (40.0, 20.0, 4.0), (-40.0, 20.0, 4.0), (10.0, 5.0, 4.0)]
TURNING = ", ".join(
    f'{{ rest = "5 s" }}, {{ turn = "{a:g} deg", axis = "a", peak_rate = "{w:g} deg/s", duration = "{t:g} s", '
    'shape = "linear ramps" }'
    for a, w, t in TURNS
)


def test_splines_in_temperature_and_rate_are_as_a_fine_sum():
    """An inclined axis on the Earth: every gyro has its own rate, and the Earth's share changes with the attitude."""
    knots, rates = [-30.0, -10.0, 5.0, 40.0, 70.0], [-90.0, -20.0, 0.0, 35.0, 90.0]
    warm, fast = (
        f"{{ degree = {d}, knots = [{', '.join(f'{chr(34)}{k:g} {u}{chr(34)}' for k in of)}] }}"
        for d, u, of in ((3, "degC", knots), (2, "deg/s", rates))
    )
    maps = f'{NO_BIAS}\nscale_factor = {{ temperature = {warm}, rate = {fast}, prior = "10000 ppm" }}'
    direction, axis = np.array([0.6, 0.0, 0.8]), 0
    text = SPEC.format(axes='"x"', maps=maps, latitude=30, direction="0.6, 0.0, 0.8", moves=TURNING)
    earth = EARTH * np.array([0.0, np.cos(np.radians(30.0)), np.sin(np.radians(30.0))])
    along, across = direction * (direction @ earth), np.cross(direction, earth)
    rows, durations, at, stands = [], [], 0.0, 0.0
    schedule = parse_spec(text).schedule
    plan = [m for turn in TURNS for m in ((0.0, 1.0, 5.0), turn)] * schedule.stretches[0].cycles
    left = schedule.stretches[0].leftover
    for angle, peak, lasting in [*plan, *([(0.0, 1.0, left)] if left > 1e-6 else [])]:
        count = 20_000 if angle else 500
        t = lasting * (np.arange(count) + 0.5) / count
        ramp = lasting - abs(angle) / peak if angle else 1.0
        size = np.clip(np.minimum(t, lasting - t) / ramp, 0.0, 1.0) * (peak if angle else 0.0)
        joint = np.radians(np.sign(angle) * size)
        turned = stands + np.cumsum(joint) * lasting / count - 0.5 * joint * lasting / count
        stands += np.radians(angle)
        seen = (along + np.cos(turned)[:, None] * (earth - along) - np.sin(turned)[:, None] * across)[:, axis]
        rate = joint * direction[axis] + seen
        of_t = b_spline(-30.0 + 2.0 / 60.0 * (at + t), tuple(knots), 3)
        of_w = b_spline(rate, tuple(np.radians(rates)), 2)
        rows.append(((of_t * rate[:, None]).T @ of_w).ravel() * lasting / count)
        durations.append(lasting)
        at += lasting
    right = by_hand(rows, durations, 0.01)
    found = np.array([v for name, v in sigmas(text).items() if ".b_" in name])
    assert np.ptp(right) > 0.5 * np.max(right)
    assert found == pytest.approx(right, rel=2e-8)
