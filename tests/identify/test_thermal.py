import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gradcal_jax.identify.thermal import fit_thermal_bias, lagged

INTERVAL = 0.5
TIME = np.arange(8000) * INTERVAL
CYCLE = 25 + 45 * np.sin(2 * np.pi * TIME / 2500) ** 3


def test_the_lag_solves_its_differential_equation():
    time = np.arange(200) * 2.0
    ramp = np.interp(time, [0, 100, 250, 400], [20.0, 60.0, 60.0, -10.0])
    solution = solve_ivp(
        lambda t, y: (np.interp(t, time, ramp) - y) / 30.0, (0, time[-1]), [20.0], t_eval=time, max_step=1.0, rtol=1e-9
    )
    np.testing.assert_allclose(lagged(ramp, 2.0, 30.0), solution.y[0], atol=1e-5)
    np.testing.assert_array_equal(lagged(ramp, 2.0, 0.0), ramp)
    np.testing.assert_allclose(lagged(ramp, 2.0, 1e-3), ramp, atol=0.02)


@pytest.mark.parametrize("lag", [0.0, 300.0])
def test_a_lagging_cubic_is_found(lag):
    rng = np.random.default_rng(int(lag))
    z = (lagged(CYCLE, INTERVAL, lag) - 20) / 50
    truth = 0.1 + 2 * z - 0.7 * z**2 + 0.3 * z**3
    rate = truth + 0.05 * rng.standard_normal(len(z))
    fit = fit_thermal_bias(rate, CYCLE, INTERVAL)
    assert fit.lag_time_s == pytest.approx(lag, abs=1.0)
    assert fit.residual_rms == pytest.approx(0.05, rel=0.03)
    np.testing.assert_allclose(fit.bias(CYCLE, INTERVAL), truth, atol=0.01)


def test_gaps_in_temperature_are_bridged_and_masked_rates_do_not_count():
    temperature = CYCLE.copy()
    temperature[1000:1010] = np.nan
    rate = (CYCLE - 25) / 45
    rate[1000:1010] = 1e3
    valid = np.ones(len(TIME), bool)
    valid[1000:1010] = False
    fit = fit_thermal_bias(rate, temperature, INTERVAL, degree=1, lag_time_s=0.0, valid=valid)
    assert fit.residual_rms < 1e-12


def test_what_does_not_determine_a_polynomial_is_said():
    ones = np.ones(10)
    for arguments, sentence in [
        ({"degree": 3}, "different temperatures"),
        ({"degree": -1}, "degree"),
        ({"lag_time_s": -1.0}, "lag must be"),
        ({"temperature_c": np.where(np.arange(10) == 4, np.nan, 20.0)}, "has no rate or no temperature"),
    ]:
        with pytest.raises(ValueError, match=sentence):
            fit_thermal_bias(**{"rate": ones, "temperature_c": ones, "sample_interval_s": 1.0, **arguments})
