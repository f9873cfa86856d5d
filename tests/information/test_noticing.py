"""The power to notice a hidden map, against simulated units whose hidden maps are drawn and integrated here."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss, legvander
from scipy import stats

from gradcal_jax.design.plan_objective import noticing, with_hidden
from gradcal_jax.estimation import Whitened, chi_squared, components, size_of, structure_test
from gradcal_jax.information import (
    at_readings,
    information,
    kept,
    missed,
    noise_steps,
    noticed_from,
    power,
    quantiles,
    simulate_noise,
    where_hidden,
    whiten,
)
from gradcal_jax.information.prediction import monte_carlo, predict
from gradcal_jax.model.build import assemble
from gradcal_jax.model.imu_build import build_imu
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import read_spec

ROOT = Path(__file__).parents[2] / "experiments"
PPM = 1e-6
HIDDEN = {"standard_deviation": "10 ppm", "temperature_degree": 5, "rate_degree": 5}


def spec_named(name: str):
    spec = read_spec(ROOT / "designs/headline.toml") if name == "written" else read_recipe(ROOT / name).spec
    return changed(spec, {"sensor.scale_factor.discrepancy": None})


class Bench:
    """A plan's units: whitened readings of noise and hidden maps, and what the structure test makes of them."""

    def __init__(self, name: str):
        self.spec = spec_named(name)
        self.built = assemble(self.spec)
        self.line = self.built.trajectory()
        self.model = self.built.model
        self.hidden, _ = where_hidden(with_hidden(self.spec, self.model, "scale_factor"), "scale_factor")
        self.steps = noise_steps(self.line, self.model)
        self.columns = at_readings(self.line, self.model)
        self.degrees = self.hidden.degrees()

    def integrals(self) -> np.ndarray:
        """What each hidden function adds to the readings: integrated here, by its own rule and its own polynomials."""
        nodes, weights = leggauss(24)
        v = np.broadcast_to(0.5 * (nodes + 1.0), (self.line.piece_count, 24))
        rate, temperature = self.line.rate(v), self.line.temperature(v)
        in_t, in_w = legvander((temperature - 20.0) / 50.0, 5), legvander(rate / np.radians(300.0), 5)
        share = 0.5 * weights * self.line.duration[:, None] * rate
        pieces = np.stack([np.sum(in_t[..., i] * in_w[..., j] * share, axis=1) for i, j in self.degrees], axis=1)
        pieces[self.line.gap] = 0.0
        return np.cumsum(pieces, axis=0)

    def units(self, count: int, std: float, seed: int) -> tuple[Whitened, np.ndarray, np.ndarray]:
        """Whitened readings, whitened columns of the hidden functions as `estimate` has them, and the hidden maps."""
        rng = np.random.default_rng(seed)
        gamma = std * rng.standard_normal((len(self.degrees), count))
        readings = simulate_noise(self.steps, count, rng) + self.integrals() @ gamma
        hidden = at_readings(self.line, with_hidden(self.spec, self.model, "scale_factor"))[:, self.model.size :]
        rows = whiten(self.steps, np.concatenate([self.columns, hidden, readings], axis=1))[self.steps.used]
        p, k = self.model.size, self.hidden.size
        return Whitened(rows[:, :p], rows[:, p + k :], self.model.prior_rows()), rows[:, p : p + k], gamma


def test_the_degrees_are_those_of_the_functions():
    bench = Bench("written")
    t, w = np.array([-10.0, 55.0]), np.radians([120.0, -250.0])
    expected = [legvander((t - 20) / 50, 5)[:, i] * legvander(w / np.radians(300), 5)[:, j] for i, j in bench.degrees]
    np.testing.assert_allclose(bench.hidden.values(t, w), np.stack(expected, axis=1), rtol=1e-12)


@pytest.mark.parametrize("share", [[0.3, 0.9, 0.999, 0.02], [1.0, 1.0], [1e-6, 0.5, 0.5, 0.5, 1.0, 0.99]])
def test_the_probability_to_miss_is_that_of_a_sum_of_weighted_chi_squares(share):
    share, draws = np.array(share), 400_000
    below = quantiles(len(share), 0.05)
    sums = (np.random.default_rng(1).standard_normal((draws, len(share))) ** 2) @ (1.0 / share)
    expected = np.mean(sums <= stats.chi2.isf(0.05, len(share)))
    assert missed(share, below) == pytest.approx(expected, abs=4.0 * np.sqrt(0.25 / draws))
    slope = np.asarray(jax.grad(missed)(jnp.asarray(share), below))
    inner = np.minimum(share, 1.0 - 1e-5)
    eye = 1e-6 * np.eye(len(share)) * share
    for k, step in enumerate(eye):
        difference = (missed(inner + step, below) - missed(inner - step, below)) / (2.0 * step[k])
        assert slope[k] == pytest.approx(difference, rel=1e-4, abs=1e-6)
    assert np.all(np.isfinite(slope))


def test_where_nothing_is_hidden_the_power_is_the_level_of_false_alarms():
    gain = np.array([1e10, 3e9, 2e8])
    assert power(gain, 0.0, 0.03) == pytest.approx(0.03, rel=1e-9)
    least = noticed_from(gain, 0.8, 0.03)
    assert power(gain, least, 0.03) == pytest.approx(0.8, rel=1e-8)
    assert noticed_from(gain[:0], 0.8, 0.03) is None
    with pytest.raises(ValueError, match="between 0 and 1"):
        quantiles(3, 1.5)


def test_the_gradient_of_the_probability_to_miss_through_the_information():
    """In the readings' noise, against central differences: 1e-6."""
    bench = Bench("written")
    model = with_hidden(bench.spec, bench.model, "scale_factor")
    where = model.where("scale_factor_discrepancy")
    below = quantiles(where.stop - where.start, 0.01)
    root = np.linalg.qr(np.random.default_rng(3).standard_normal((60, model.size)), mode="r")
    info = information(bench.line, model)

    def log(x):
        factor = jnp.asarray(info.factor) + x * jnp.asarray(root * np.abs(info.factor).max() * 0.1)
        return jnp.log(missed(kept(info._replace(factor=factor), where, 10 * PPM), below))

    slope = float(jax.grad(log)(0.01))
    difference = float(log(0.01 + 1e-6) - log(0.01 - 1e-6)) / 2e-6
    assert slope == pytest.approx(difference, rel=1e-6)


def detected(bench: Bench, count: int, std: float, seed: int) -> tuple[float, np.ndarray, float]:
    """Share of units in which the test notices, their probabilities, and the power predicted for the plan."""
    white, extra, _ = bench.units(count, std, seed)
    result = components(white, extra)
    probability = np.array([chi_squared(result, unit).probability for unit in range(count)])
    sized = changed(
        bench.spec, {"sensor.scale_factor.discrepancy": HIDDEN | {"standard_deviation": f"{std / PPM} ppm"}}
    )
    (row,) = noticing(build_imu(sized))
    assert row.components == len(result.gains)
    return float(np.mean(probability < row.false_alarm)), probability, row.power


@pytest.mark.parametrize("name", ["written", "recipes/headline_discrepancy.toml"])
def test_simulated_units_are_noticed_as_often_as_predicted(name):
    bench = Bench(name)
    (row,) = noticing(build_imu(bench.spec))
    share, _, predicted = detected(bench, 400, row.sure_from * PPM, 5)
    assert predicted == pytest.approx(0.9, abs=1e-6)
    assert share == pytest.approx(0.9, abs=4.0 * np.sqrt(0.09 / 400))
    share, probability, _ = detected(bench, 400, 1e-6 * PPM, 6)
    assert stats.kstest(probability, "uniform").pvalue > 1e-3


def test_the_data_ask_for_the_degree_that_is_hidden():
    """30 ppm of the fourth Legendre polynomial of temperature alone, and nothing else."""
    bench = Bench("written")
    white, extra, _ = bench.units(1, 0.0, 7)
    of_fourth = [k for k, d in enumerate(bench.degrees) if d == (4, 0)]
    test = structure_test(white._replace(data=white.data + 30 * PPM * extra[:, of_fourth]), extra, bench.hidden, 0.01)
    assert test.noticed
    assert test.asked == (4, 3)
    nothing = structure_test(white, extra, bench.hidden, 0.01)
    assert not nothing.noticed
    assert nothing.asked is None


def test_a_discrepancy_is_measured_within_its_uncertainty_and_units_together_tell_more():
    bench = Bench("written")
    white, extra, _ = bench.units(40, 10 * PPM, 8)
    every = components(white, extra)
    alone = [size_of([every._replace(y=every.y[:, k : k + 1])]) for k in range(40)]
    covers = [one.low <= 10 * PPM <= (np.inf if one.high is None else one.high) for one in alone]
    assert sum(covers) >= 33
    together = size_of([every])
    assert together.low < 10 * PPM < together.high
    assert together.high - together.low < 0.25 * np.median([one.high - one.low for one in alone])
    assert size_of([every._replace(y=every.y[:0], gains=every.gains[:0])]) is None


def test_the_monte_carlo_counts_what_a_calibration_does_not_carry():
    """With a discrepancy the simulated calibrations leave what is predicted: the hidden part stays."""
    spec = changed(spec_named("written"), {"sensor.scale_factor.discrepancy": HIDDEN, "plan.gradient": "2 K/min"})
    rows, tests = monte_carlo(spec, 400, 2)
    assert all(test.consistent for test in tests.values())
    for row in rows:
        assert row.simulated == pytest.approx(row.predicted, rel=0.1)
    assert (
        rows[0].predicted
        > 3.0 * predict(changed(spec, {"sensor.scale_factor.discrepancy": None})).requirements[0].mean_of_max
    )


PLANS = ["written", "recipes/headline.toml", "recipes/headline_discrepancy.toml"]


@pytest.mark.evidence
@pytest.mark.parametrize("name", PLANS)
def test_a_thousand_units_with_hidden_maps(name):
    """Predicted over achieved within 5 %, power within 3 points, false alarms at their rate."""
    bench = Bench(name)
    (row,) = noticing(build_imu(bench.spec))
    share, _, predicted = detected(bench, 1000, row.sure_from * PPM, 15)
    assert abs(share - predicted) < 0.03
    alarms, probability, _ = detected(bench, 1000, 1e-6 * PPM, 16)
    assert stats.binomtest(round(1000 * alarms), 1000, row.false_alarm).pvalue > 0.01
    assert stats.kstest(probability, "uniform").pvalue > 0.01
    # What the calibration leaves, with 5 ppm hidden in the maps and in the model.
    spec = changed(bench.spec, {"sensor.scale_factor.discrepancy": HIDDEN | {"standard_deviation": "5 ppm"}})
    model = assemble(spec).model
    white, extra, gamma = bench.units(1000, 5 * PPM, 17)
    rows = np.concatenate([white.rows, extra], axis=1)
    both = np.concatenate([rows, model.prior_rows()])
    data = np.concatenate([white.data, np.zeros((len(model.prior_rows()), 1000))])
    size = np.linalg.norm(both, axis=0)
    beta = (np.linalg.lstsq(both / size, data, rcond=None)[0] / size[:, None])[: bench.model.size]
    t, w = (a.ravel() for a in np.meshgrid(np.linspace(-30, 70, 41), np.radians(np.linspace(-300, 300, 41))))
    in_t, in_w = legvander((t - 20.0) / 50.0, 5), legvander(w / np.radians(300.0), 5)
    outside = np.stack([in_t[:, i] * in_w[:, j] for i, j in bench.degrees], axis=1)
    error = model.scale.values(t, w) @ beta - outside @ gamma
    achieved = np.mean(np.max(np.sqrt(np.mean(error**2, axis=1)).reshape(41, 41), axis=1)) / PPM
    predicted = predict(spec).requirements[0].mean_of_max
    assert achieved == pytest.approx(predicted, rel=0.05)


@pytest.mark.evidence
@pytest.mark.parametrize("name", ["written", "recipes/headline_discrepancy_10ppm.toml"])
def test_intervals_of_measured_discrepancies_cover_as_they_say(name):
    """2000 trials of one unit each, 95 % intervals: of 500, one lot in twenty would be outside 93 to 97 % by chance."""
    white, extra, _ = Bench(name).units(2000, 10 * PPM, 21)
    every = components(white, extra)
    result = [size_of([every._replace(y=every.y[:, k : k + 1])]) for k in range(2000)]
    covered = sum(one.low <= 10 * PPM <= (np.inf if one.high is None else one.high) for one in result)
    assert 0.93 <= covered / 2000 <= 0.97
    assert np.median([one.std for one in result]) == pytest.approx(10 * PPM, rel=0.2)
