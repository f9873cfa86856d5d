"""The fit of the rows of one sensor, and of those of a fixture together."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.api.contradictions import refuse_misaligned
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.fit_of_log import Fit, fitted_twice, lag_of_maps, with_chosen_smoothness
from gradcal_jax.api.fitted_lag import Lag
from gradcal_jax.api.imu_build import BuiltImu
from gradcal_jax.estimation import ImuRows, Smoothness, TablePoints
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.formulas import followed


class Recorded(NamedTuple):
    """The rows of one sensor, and messages on them. `points`: they are those of a table of points."""

    rows: ImuRows
    messages: tuple[str, ...]
    points: TablePoints | None = None

    def with_message(self, message: str) -> "Recorded":
        """The same, with a message more."""
        return self._replace(messages=(*self.messages, message))


class FittedRows(NamedTuple):
    """The fit of one sensor's rows, the temperature of its maps (°C) and their lag."""

    built: BuiltImu
    recorded: Recorded
    temperature: np.ndarray
    fit: Fit
    smoothness: Smoothness | None
    lag: Lag


def fit_of(built: BuiltImu, name: str, recorded: Recorded, options: Options) -> FittedRows:
    """The fit of one sensor's rows."""
    rows, messages, points = recorded
    temperature_of = lambda lag: followed(rows.temperature_c, rows.time_s, rows.stretch_starts, lag)  # noqa: E731
    stable = isinstance(built.spec.plan, StandardPlan)
    model = built.model
    refuse_misaligned(name, estimation.coarse_fits(rows, built.motion.geometry), model.channels)
    threshold = options.threshold if options.robust else None
    if options.lag != "fit":
        lag = Lag(float(options.lag))
    elif stable:
        lag = Lag(0.0)
        messages = *messages, "at stable temperatures a lag cannot be estimated: it is taken as zero"
    else:
        lag = lag_of_maps(built, name, rows, temperature_of)
    temperature = temperature_of(lag.seconds)
    fit, smoothness = fitted_twice(built, name, rows, temperature, threshold, points), None
    if options.smoothness == "auto":
        built, fit, smoothness = with_chosen_smoothness(built, fit, threshold)
    return FittedRows(built, recorded._replace(messages=messages), temperature, fit, smoothness, lag)


def together(spec: Spec, fits: Mapping[str, FittedRows]) -> dict[str, FittedRows]:
    """The fits of the IMUs of a fixture, with what all of them say of the table, and messages on it."""
    try:
        joint = estimation.solve_together(
            [of.fit.readings for of in fits.values()],
            [of.fit.solution for of in fits.values()],
            clock=spec.sensor.takes_host_clock,
        )
    except ValueError as error:
        message = f"not estimated together with the other IMUs of the fixture: {error}"
        return {name: of._replace(recorded=of.recorded.with_message(message)) for name, of in fits.items()}
    common = f"estimated together with {len(fits) - 1} other IMUs, which share the table and its encoders"
    found: dict[str, FittedRows] = {}
    for (name, of), solution, test in zip(fits.items(), joint.solutions, joint.agreement, strict=True):
        messages = [common]
        if test is not None and not test.passed:
            messages.append(
                f"contradicts the other IMUs: the table that it sees differs from theirs (χ² {test.statistic:.4g}, "
                f"{test.degrees} degrees of freedom): does it sit firmly, and at the right "
                "place? Estimate the others without it"
            )
        recorded = of.recorded
        for message in messages:
            recorded = recorded.with_message(message)
        found[name] = of._replace(fit=of.fit._replace(solution=solution), recorded=recorded)
    return found
