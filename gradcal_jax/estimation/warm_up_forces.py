"""Accelerometers of a vehicle that warms up at rest: the change of their biases over temperature.

At rest, a bias and a tilt are one number: an accelerometer measures its bias plus a part of gravity that nobody knows.
What a warm-up shows is therefore how the bias *changes*. It is zero in the middle of the range of temperature, by
definition, and six positions at one temperature tell what it is there (PX4's and ArduPilot's accelerometer
calibration). The part of gravity is a constant as long as the vehicle stands still.

Generalised least squares of the means over stretches of the record, with the white noise of the record, and the
drift and the lag behind the thermometer that are typical of the class.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2

from gradcal_jax import units
from gradcal_jax.calibration.file import CalibratedChannel, CalibratedTerm, Covariance, FitTest
from gradcal_jax.identify.instability import RestRecord, allan_of, at_rest, number
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.absent import grade_of_forces, terms_of
from gradcal_jax.spec.bases import TemperaturePolynomial
from gradcal_jax.tables.quantity import Quantity

DEGREE = 3
_STRETCHES = 300
_LAG_S = 60.0
"""1σ of the time by which the die is behind its thermometer, s."""
_RARE = 1e-3
"""Probability below which the data contradict the model; the covariance then grows with the misfit."""


class ForcesOfWarmUp(NamedTuple):
    """The accelerometers' channels, the covariance of their coefficients (m/s²), tests of the fits and the names of
    those that fail, and sentences."""

    channels: tuple[CalibratedChannel, ...]
    covariance: Covariance
    tests: tuple[FitTest, ...]
    contradicted: tuple[str, ...]
    messages: tuple[str, ...]


class _Means(NamedTuple):
    """Of stretches of a record: time (s), length of the data in it (s), force (m/s²), temperature (°C), dT/dt (K/s)."""

    time: np.ndarray
    duration: np.ndarray
    force: np.ndarray
    temperature: np.ndarray
    slope: np.ndarray


def forces_of_warm_up(log: Log, unit: str) -> ForcesOfWarmUp:
    """The bias over temperature of every accelerometer of a unit, in a log whose standstills are marked.

    **Raises:** `LogError` where the record shows no white noise of an accelerometer.
    """
    channels, names, blocks = list[CalibratedChannel](), list[str](), list[np.ndarray]()
    centre = 0.0
    tests, contradicted, messages = list[FitTest](), list[str](), list[str]()
    for axis in log.force_axes:
        rest = at_rest(log, axis, unit, bias_degree=DEGREE, lag="none", force=True)
        _, fit = allan_of(rest)
        walk = fit.angle_random_walk
        if not walk.value > walk.standard_error:
            raise LogError(
                f"the Allan deviation of accelerometer {axis} of IMU {unit} shows no velocity random walk, but the "
                "estimate needs one: log at a higher rate, or leave the accelerometers out of the column map"
            )
        whole = at_rest(log, axis, unit, bias_degree=-1, lag="none", force=True)
        assert whole.temperature_c is not None
        used = whole.temperature_c[whole.valid]
        span = float(used.min()), float(used.max())
        centre = round(0.5 * sum(span), 1)
        channel, matrix, test, words = _channel(_means(whole), span, walk.value, axis)
        channels.append(channel)
        blocks.append(matrix)
        names += [f"{channel.name}.a{k}" for k in range(1, DEGREE + 1)]
        tests.append(test)
        messages += words
        if test.chance < _RARE:
            contradicted.append(test.name)
            messages.append(
                f"not valid: {channel.label}: its force changes in other ways than with the temperature: was the "
                "vehicle moved or tilted? The covariance includes the misfit"
            )
    size = len(names)
    matrix = np.zeros((size, size))
    for k, block in enumerate(blocks):
        here = slice(k * DEGREE, (k + 1) * DEGREE)
        matrix[here, here] = block
    messages.insert(
        0,
        f"accelerometers at rest: a bias and a tilt cannot be separated, so the biases are changes from {centre:g} "
        "degC, where they are zero. Calibrate the accelerometers in six positions at one temperature afterwards",
    )
    return ForcesOfWarmUp(
        tuple(channels),
        Covariance(names=tuple(names), matrix=tuple(map(tuple, matrix.tolist()))),
        tuple(tests),
        tuple(contradicted),
        tuple(messages),
    )


def _means(rest: RestRecord) -> _Means:
    """Means over up to `_STRETCHES` stretches with data for at least half of each."""
    assert rest.temperature_c is not None
    width = max(len(rest.rate) // _STRETCHES, 1)
    count = len(rest.rate) // width
    shape = (count, width)

    def of(values: np.ndarray) -> np.ndarray:
        return np.where(rest.valid, values, 0.0)[: count * width].reshape(shape).sum(axis=1)

    held = of(np.ones(len(rest.rate)))
    kept = held > 0.5 * width
    middle = (np.flatnonzero(kept) + 0.5) * width * rest.sample_interval_s
    force, temperature = (of(values)[kept] / held[kept] for values in (rest.rate, rest.temperature_c))
    slope = np.gradient(temperature, middle)
    return _Means(middle, held[kept] * rest.sample_interval_s, force, temperature, slope)


def _channel(
    means: _Means, span: tuple[float, float], walk: float, axis: str
) -> tuple[CalibratedChannel, np.ndarray, FitTest, list[str]]:
    """A channel, the covariance of its coefficients a1 … a3, the test of its fit, and sentences. `span`: lowest and
    highest temperature that were used, °C; `walk`: m/s/√s."""
    low, high = span
    centre, scale = round(0.5 * (low + high), 1), round(0.5 * (high - low), 1)
    z = (means.temperature - centre) / scale
    powers = np.vander(z, DEGREE + 1, increasing=True)
    grade = grade_of_forces(Quantity.of(walk, "m/s/sqrt(s)"))
    (drift,) = next(t.value for t in terms_of("accelerometer", grade.name) if t.key == "drift")
    std = units.parse(drift["standard_deviation"], "acceleration")
    tau = units.parse(drift["correlation_time"], "time")
    noise = std**2 * np.exp(-np.abs(means.time[:, None] - means.time) / tau) + np.diag(walk**2 / means.duration)
    factor = cho_factor(noise)
    normal = powers.T @ cho_solve(factor, powers)
    found = np.linalg.solve(normal, powers.T @ cho_solve(factor, means.force))
    left = means.force - powers @ found
    statistic, degrees = float(left @ cho_solve(factor, left)), len(z) - DEGREE - 1
    # A die that is behind its thermometer: an error of no residual, along one direction.
    slopes = np.polynomial.polynomial.polyval(z, np.polynomial.polynomial.polyder(found)) / scale
    unseen = np.linalg.solve(normal, powers.T @ cho_solve(factor, _LAG_S * slopes * means.slope))
    covariance = (np.linalg.inv(normal) + np.outer(unseen, unseen))[1:, 1:]
    chance = float(chi2.sf(statistic, degrees))
    if chance < _RARE:
        covariance = covariance * (statistic / degrees)
    valid = Quantity.of(low, "degC"), Quantity.of(high, "degC")
    still = Quantity.of(0.0, "rad/s")
    basis = TemperaturePolynomial(degree=DEGREE, centre=Quantity.of(centre, "degC"), scale=Quantity.of(scale, "K"))
    term = CalibratedTerm(
        name="bias",
        unit="m/s^2",
        temperature=basis,
        coefficients={f"a{k}": value for k, value in enumerate((0.0, *found[1:].tolist()))},
    )
    channel = CalibratedChannel(
        kind="accelerometer",
        axis=axis,
        valid_temperature=valid,
        valid_rate=(still, still),
        term=(term,),
    )
    test = FitTest(name=f"{channel.name}: chi-squared", statistic=statistic, degrees=degrees, chance=chance)
    words = [
        f"accelerometer {axis}: velocity random walk {number(walk * 60.0)} m/s/sqrt(h), from the record; drift of the "
        f"class {grade.name} ({grade.like})"
    ]
    return channel, covariance, test, words
