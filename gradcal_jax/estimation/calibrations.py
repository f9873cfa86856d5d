"""A finished calibration: its maps with their uncertainty, and its terms by the standards.

Everything follows from the file's coefficients, their covariance `C` and the errors `v` that no residual shows: a
quantity that is linear in the coefficients, `cᵀβ`, has the standard deviation `√(cᵀCc + Σ(cᵀv)²)`. The names of terms
are those of IEEE 952, 1431 and 1780; each has its exact definition in words, since the standards leave room.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.calibration import CalibratedChannel, CalibratedTerm, Calibration
from gradcal_jax.information import Posterior
from gradcal_jax.information.imu_residual import UNITS_OF_TERMS
from gradcal_jax.model import ImuModel
from gradcal_jax.units import DEG_PER_S

Floats = Float[np.ndarray, "..."]

# The temperature for figures of one temperature (°C), where the data cover it.
_ROOM = 25.0
_TEMPERATURES, _RATES = 101, 121


class IeeeTerm(NamedTuple):
    """A term of the standards. `std`: one sigma, None where it is not observable; `computed`: its definition."""

    name: str
    value: float
    std: float | None
    unit: str
    computed: str


class Box(NamedTuple):
    """Temperatures (°C) and rates (deg/s) of a residual map `(n_T, n_ω)` in `unit`; inf: not observable."""

    temperature_c: Floats
    rate_dps: Floats
    values: Floats
    unit: str


class TermMap(NamedTuple):
    """A term of a calibration at `n` places: `rows` `(n, p)` are the functions that its coefficients multiply."""

    calibration: Calibration
    channel: CalibratedChannel
    term: CalibratedTerm
    rows: Floats

    def weighted(self, weights: Floats) -> "TermMap":
        """Linear combinations of the places by `weights` `(m, n)`."""
        return self._replace(rows=weights @ self.rows)

    @property
    def values(self) -> Floats:
        """The term at every place, in SI."""
        return self.rows @ np.array(list(self.term.coefficients.values()))

    @property
    def deviations(self) -> Floats:
        """One sigma of each value, in SI; `inf` where it involves a coefficient that is not observable."""
        names = [f"{self.channel.name}.{name}" for name in self.term.coefficients]
        known = self.calibration.covariance
        place = {} if known is None else {name: k for k, name in enumerate(known.names)}
        seen = [k for k, name in enumerate(names) if name in place]
        variance = np.zeros(len(self.rows))
        if known is not None and seen:
            where, part = [place[names[k]] for k in seen], self.rows[:, seen]
            block = np.array(known.matrix)[np.ix_(where, where)]
            variance = np.maximum(np.einsum("gi,ij,gj->g", part, block, part), 0.0)
        for error in self.calibration.unseen:
            variance = variance + (self.rows @ np.array([error.coefficients.get(name, 0.0) for name in names])) ** 2
        unseen = np.delete(self.rows, seen, axis=1)
        return np.where(np.any(unseen != 0.0, axis=1), np.inf, np.sqrt(variance))


def term_map(
    calibration: Calibration, channel: CalibratedChannel, name: str, temperature_c: Floats, rate: Floats
) -> TermMap:
    """A term at temperatures (°C) and rates (rad/s), both `(n,)`. Errors: `ValueError` for a term that is not there."""
    if (term := channel.term_of(name)) is None:
        raise ValueError(f"the calibration of {channel.label} has no {name.replace('_', ' ')}")
    one = np.ones((len(temperature_c), 1))
    cold = one if term.temperature is None else term.temperature.values(temperature_c)
    fast = one if term.rate is None else term.rate.values(rate)
    return TermMap(calibration, channel, term, (cold[:, :, None] * fast[:, None, :]).reshape(len(one), -1))


def calibration_map(
    calibration: Calibration, channel: CalibratedChannel, name: str, temperature_c: Floats, rate_dps: Floats
) -> tuple[Box, Box]:
    """A term of a calibration and its standard deviation on a grid. Errors: `ValueError` for a term that it lacks."""
    grid_t, grid_w = np.meshgrid(temperature_c, rate_dps / DEG_PER_S, indexing="ij")
    of = term_map(calibration, channel, name, grid_t.ravel(), grid_w.ravel())
    unit, factor = UNITS_OF_TERMS.get(of.term.unit, (of.term.unit, 1.0))
    maps = (values.reshape(grid_t.shape) * factor for values in (of.values, of.deviations))
    first, second = (Box(temperature_c, rate_dps, values, unit) for values in maps)
    return first, second


def grid_of(channel: CalibratedChannel, name: str) -> tuple[Floats, Floats]:
    """Temperatures (°C) and rates (deg/s) of all that the data cover for a term."""
    cold, warm = channel.valid_temperature
    slow, fast = channel.valid_rate
    temperatures = np.linspace(float(cold), float(warm), _TEMPERATURES)
    term = channel.term_of(name)
    if term is None or term.rate is None:
        return temperatures, np.zeros(1)
    return temperatures, np.linspace(float(slow), float(fast), _RATES) * DEG_PER_S


def calibrated_parameters(model: ImuModel, calibration: Calibration) -> np.ndarray:
    """The parameters of a model by a calibration file; zero for what it does not carry."""
    carried = calibration.values()
    return np.linalg.solve(model.to_reported, [carried.get(name, 0.0) for name in model.names()])


def calibrated_posterior(model: ImuModel, calibration: Calibration) -> Posterior:
    """The posterior of a model's parameters by a calibration file: the covariance of its coefficients, and the errors
    that no residual shows. Coefficients without a variance are hidden; what the file does not carry has no error."""
    names, carried, known = model.names(), calibration.values(), calibration.covariance
    place = {name: k for k, name in enumerate(names)}
    seen = () if known is None else known.names
    columns = [np.zeros((model.size, 0))]
    if known is not None and any(name in place for name in seen):
        own = [k for k, name in enumerate(seen) if name in place]
        matrix = np.array(known.matrix)[np.ix_(own, own)]
        size = np.sqrt(np.diag(matrix))
        values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
        root = np.zeros((model.size, len(own)))
        root[[place[seen[k]] for k in own]] = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        columns.append(root)
    for error in calibration.unseen:
        columns.append(np.array([[error.coefficients.get(name, 0.0)] for name in names]))
    # Of the engine's own parameters.
    back = np.linalg.inv(model.to_reported)
    hidden = back[:, [place[name] for name in carried if name in place and name not in seen]]
    return Posterior(back @ np.concatenate(columns, axis=1), hidden / np.linalg.norm(hidden, axis=0))


_NAMES = {
    "scale_factor": "scale factor error",
    "bias_temperature_gradient": "bias temperature gradient sensitivity",
}


def standard_terms(calibration: Calibration, channel: CalibratedChannel) -> list[IeeeTerm]:
    """The calibration of a channel in the vocabulary of IEEE 952, 1431 and 1780."""
    cold, warm = (float(end) for end in channel.valid_temperature)
    at = _ROOM if cold <= _ROOM <= warm else 0.5 * (cold + warm)
    return [row for term in channel.term for row in _terms_of(calibration, channel, term, at)]


def _terms_of(
    calibration: Calibration, channel: CalibratedChannel, term: CalibratedTerm, at: float
) -> Iterator[IeeeTerm]:
    """A term at one temperature, its change over temperature and, of a map over rate, over rate."""
    plain = term.name.replace("_", " ")
    if term.name == "bias_temperature_gradient":
        of = term_map(calibration, channel, term.name, np.array([at]), np.zeros(1))
        yield _term(of, _NAMES[term.name], "bias for each °C/min of temperature change")
        return
    rates = np.zeros(1)
    if term.rate is not None:
        slow, fast = channel.valid_rate
        rates = np.linspace(float(slow), float(fast), _RATES)
    here = term_map(calibration, channel, term.name, np.full_like(rates, at), rates)
    mean = np.full((1, len(rates)), 1.0 / len(rates))
    words = "B" if term.name == "bias" else "mean of M over all rates" if term.rate is not None else plain
    yield _term(here.weighted(mean), _NAMES.get(term.name, plain), f"{words} at {at:g} °C")
    if term.rate is not None:
        yield from _over_rate(here, rates, at)
    low, high = (float(end) for end in channel.valid_temperature)
    if high > low and term.temperature is not None and term.temperature.size > 1:
        temperatures = np.linspace(low, high, _TEMPERATURES)
        grid_t, grid_w = (x.ravel() for x in np.meshgrid(temperatures, rates, indexing="ij"))
        everywhere = term_map(calibration, channel, term.name, grid_t, grid_w)
        centred = temperatures - temperatures.mean()
        slope = np.kron(centred / (centred @ centred), mean)
        what = "the mean of M over all rates" if term.rate is not None else words
        words = f"slope of the best straight line through {what}, {low:g} … {high:g} °C"
        yield _term(everywhere.weighted(slope), f"{plain} temperature sensitivity", words, "/°C")


def _over_rate(here: TermMap, rates: Floats, at: float) -> Iterator[IeeeTerm]:
    slow, fast = float(rates[0]), float(rates[-1])
    if slow < 0.0 < fast:
        positive, negative = (sign * rates > 0.0 for sign in (1.0, -1.0))
        difference = positive / positive.sum() - negative / negative.sum()
        words = f"mean of M over positive rates minus mean of M over negative rates, at {at:g} °C"
        yield _term(here.weighted(difference[None]), "scale factor asymmetry", words)
    if fast > slow:
        # Output error M·ω less its best straight line, over the largest rate.
        line = np.stack([np.ones_like(rates), rates], axis=1)
        away = here.weighted((np.eye(len(rates)) - line @ np.linalg.pinv(line)) * rates / max(abs(slow), abs(fast)))
        worst = int(np.argmax(np.abs(away.values)))
        words = (
            f"largest distance of the output from its best straight line, divided by the largest rate, at {at:g} °C "
            f"(reached at {rates[worst] * DEG_PER_S:.0f} deg/s)"
        )
        yield _term(away._replace(rows=away.rows[worst][None]), "scale factor nonlinearity", words)


def _term(of: TermMap, name: str, computed: str, per: str = "") -> IeeeTerm:
    unit, factor = UNITS_OF_TERMS.get(of.term.unit, (of.term.unit, 1.0))
    std = float(of.deviations[0]) * factor
    return IeeeTerm(name, float(of.values[0]) * factor, std if np.isfinite(std) else None, unit + per, computed)
