"""Finished calibrations: the uncertainty of one by the terms of the standards, and what those of several IMUs say of
their type, map by map.

Everything follows from the file's coefficients, their covariance `C` and the errors `v` that no residual shows: a
quantity that is linear in the coefficients, `cᵀβ`, has the standard deviation `√(cᵀCc + Σ(cᵀv)²)`. The names of terms
are those of IEEE 952, 1431 and 1780; each has its exact definition in words, since the standards leave room.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.calibration import CalibratedChannel, CalibratedTerm, Calibration
from gradcal_jax.identify import lots
from gradcal_jax.identify.lots import Floats
from gradcal_jax.information import Posterior
from gradcal_jax.information.imu_residual import UNITS_OF_TERMS
from gradcal_jax.information.plan_sentences import in_words
from gradcal_jax.model import ImuModel
from gradcal_jax.spec.bases import RateBasis, TemperatureBasis
from gradcal_jax.spec.sensor import AccelerometerTriad, GyroTriad
from gradcal_jax.tables.display import summary
from gradcal_jax.tables.writing import tables_to_toml
from gradcal_jax.units import DEG_PER_S

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


_FEW_TEMPERATURES, _FEW_RATES = 41, 9
# Functions that the common range of the IMUs does not show: share of the largest mean square.
_UNSEEN = 1e-12
# A sixth of a lot may be strangers: more of them are a group.
_STRANGERS: Final = 6


class Stranger(NamedTuple):
    """An IMU that all others do not predict; `chance` of one of the type that is as far from them."""

    serial_number: str
    chance: float


class LotMap(NamedTuple):
    """A map of a channel over a lot, in `unit`; intervals are of 95 %, strangers do not count.

    At `temperature_c` `(g,)`, slowly turned: `values` `(n, g)` of the n IMUs `serial_numbers`, their `mean` `(g,)` with
    half its interval `mean_half`, the standard deviation `spread` `(g,)` of the type, its interval `spread_interval`
    `(2, g)`, and the `shapes` `(k, g)` of one standard deviation. `mean_rms`, `spread_rms`: over the whole range, of
    rates, too. `tests` of none, one … shapes; `shares`: of the spread's variance in its principal directions.
    `coefficients` (SI) of the mean, by name; `prior` `(m, q)`: shapes (SI) whose squares add up to the mean square of
    the next IMU's coefficients, None where they do not repeat. `findings`: all of it in sentences.
    """

    channel: str
    term: str
    unit: str
    serial_numbers: tuple[str, ...]
    temperature_c: Floats
    values: Floats
    mean: Floats
    mean_half: Floats
    spread: Floats
    spread_interval: Floats
    mean_rms: float
    spread_rms: float
    tests: tuple[lots.ShapeCount, ...]
    shape_count: int | None
    shapes: Floats
    shares: tuple[float, ...]
    strangers: tuple[Stranger, ...]
    groups: tuple[tuple[str, ...], ...]
    coefficients: dict[str, float]
    prior: Floats | None
    of: CalibratedTerm
    findings: tuple[str, ...]

    @property
    def shapes_in_words(self) -> str:
        """How many shapes repeat, for a table."""
        if self.shape_count is not None:
            return str(self.shape_count)
        return "do not repeat" if self.tests[-1].shapes == len(self.shares) - 1 else "too few IMUs"


class Lot(NamedTuple):
    """The calibrations of a number of IMUs, map by map, and `notes` on all of them."""

    serial_numbers: tuple[str, ...]
    simulated: bool
    maps: tuple[LotMap, ...]
    notes: tuple[str, ...]

    __repr__ = summary

    def _shown(self) -> list[str]:
        lines = [f"Lot of {len(self.serial_numbers)} IMUs" + (", SIMULATED" if self.simulated else "")]
        return lines + [sentence for one in self.maps for sentence in one.findings]


def lot(calibrations: Sequence[Calibration]) -> Lot:
    """What the `calibrations` of three or more IMUs of one type say of the type: of every map the mean, the spread
    without the calibrations' own uncertainty, the number of shapes that repeat, groups, and strangers.

    Values are in the unit that each map names (deg/h, ppm, ug …), temperatures in °C. Errors: `ValueError` for fewer
    than three, for two of one serial number, for maps of different bases, without a covariance or a common range.
    """
    if len(calibrations) < 3:
        raise ValueError(f"a lot needs three or more calibrations, not {len(calibrations)}: add those of other IMUs")
    serials = [one.serial_number for one in calibrations]
    if double := {name for name in serials if serials.count(name) > 1}:
        raise ValueError(f"two calibrations are of the IMU {min(double)}: give one calibration for each IMU")
    names = dict.fromkeys((c.kind, c.axis, t.name) for one in calibrations for c in one.channel for t in c.term)
    chosen = [(key, _with_term(calibrations, *key)) for key in names]
    wanted = [(key, having) for key, (having, _) in chosen if len(having) >= 3]
    if not wanted:
        raise ValueError("no map has a covariance in three or more calibrations: estimate the IMUs again from logs")
    maps = [_map_of(having, *key, tests=len(wanted)) for key, having in wanted]
    notes = [note for _, (_, note) in chosen if note]
    notes += [
        f"{one.serial_number}: its data contradict its model ({', '.join(one.contradicted[:3])}), so neither its "
        "covariance nor any result based on this covariance is valid"
        for one in calibrations
        if one.contradicted
    ]
    if len(calibrations) < lots.FEW:
        notes.append(_few(len(calibrations)))
    return Lot(tuple(serials), any(one.simulated for one in calibrations), tuple(maps), tuple(notes))


def _few(count: int) -> str:
    low, high = (float(np.sqrt(x)) for x in (lots.spread_factor(count, tail) for tail in (0.975, 0.025)))
    return (
        f"{count} IMUs are too few to detect outliers or groups, or to predict the next IMU: the 95 % "
        f"confidence interval of the spread is {low:.2g} to {high:.2g} times the estimated spread, and at most "
        f"{count - 2} shapes can be tested; a prior needs {lots.FEW} IMUs or more"
    )


class _Own(NamedTuple):
    """A term of one IMU: `where` its coefficients are in the covariance."""

    calibration: Calibration
    channel: CalibratedChannel
    term: CalibratedTerm
    covariance: Floats
    unseen: Floats


def _with_term(calibrations: Sequence[Calibration], kind: str, axis: str, name: str) -> tuple[list[_Own], str | None]:
    """The IMUs with a term, all of whose coefficients are observable, and a sentence on those without."""
    having: list[_Own] = []
    lacking: list[str] = []
    for one in calibrations:
        channel = one.channel_of(kind, axis)
        term = None if channel is None else channel.term_of(name)
        known = () if one.covariance is None else one.covariance.names
        names = [] if channel is None or term is None else [f"{channel.name}.{n}" for n in term.coefficients]
        if channel is None or term is None or one.covariance is None or not set(names) <= set(known):
            lacking.append(one.serial_number)
            continue
        places = [known.index(n) for n in names]
        unseen = np.array([[e.coefficients.get(n, 0.0) for n in names] for e in one.unseen]).reshape(-1, len(names))
        own = np.array(one.covariance.matrix)[np.ix_(places, places)] + unseen.T @ unseen
        having.append(_Own(one, channel, term, own, unseen))
    for one in having[1:]:
        if not all(_same(getattr(one.term, k), getattr(having[0].term, k)) for k in ("temperature", "rate")):
            raise ValueError(
                f"{kind}_{axis}: the calibrations of {having[0].calibration.serial_number} and "
                f"{one.calibration.serial_number} have different bases for the {name.replace('_', ' ')}: estimate all "
                "IMUs of a lot with the same spec"
            )
    note = f"{kind}_{axis}: {', '.join(lacking)} without an observable {name.replace('_', ' ')}" if lacking else None
    return having, note


def _same(one: TemperatureBasis | RateBasis | None, other: TemperatureBasis | RateBasis | None) -> bool:
    """Whether two bases have the same reported functions."""
    if one is None or other is None or type(one) is not type(other):
        return one is other
    return all(getattr(one, key) == getattr(other, key) for key in type(one).model_fields if key != "internal")


def _map_of(having: list[_Own], kind: str, axis: str, name: str, *, tests: int) -> LotMap:
    first, what = having[0], f"{kind}_{axis} {name.replace('_', ' ')}"
    spans = [(*one.channel.valid_temperature, *one.channel.valid_rate) for one in having]
    cold, warm = max(s[0] for s in spans), min(s[1] for s in spans)
    slow, fast = max(s[2] for s in spans), min(s[3] for s in spans)
    if cold > warm or slow > fast:
        raise ValueError(
            f"{what}: the calibrations have no range of temperature and rate in common; leave out those with other "
            "ranges"
        )
    temperatures = np.linspace(float(cold), float(warm), _FEW_TEMPERATURES if first.term.temperature else 1)
    rates = np.linspace(float(slow), float(fast), _FEW_RATES if first.term.rate else 1)
    grid = (x.ravel() for x in np.meshgrid(temperatures, rates, indexing="ij"))
    everywhere = term_map(first.calibration, first.channel, name, *grid).rows
    slowly = term_map(first.calibration, first.channel, name, temperatures, np.zeros_like(temperatures)).rows
    unit, factor = UNITS_OF_TERMS.get(first.term.unit, (first.term.unit, 1.0))
    # Functions whose mean square over the range is the square of their coefficients' norm.
    size, vectors = np.linalg.eigh(everywhere.T @ everywhere / len(everywhere) * factor**2)
    seen = size > _UNSEEN * size[-1]
    forth, back = (vectors[:, seen] * np.sqrt(size[seen])).T, vectors[:, seen] / np.sqrt(size[seen])
    values = np.array([list(one.term.coefficients.values()) for one in having]) @ forth.T
    own = forth @ np.stack([one.covariance for one in having]) @ forth.T
    # No calibration is without any error.
    own = own + 1e-12 * np.einsum("ijj->i", own)[:, None, None] * np.eye(len(forth)) + 1e-300 * np.eye(len(forth))
    serials = np.array([one.calibration.serial_number for one in having])
    kept, found = _strangers(values, own, serials, tests)
    x, c = values[kept], own[kept]
    shape_tests, fit = lots.count_shapes(x, c)
    whole = lots.restricted_likelihood(x, c)
    parted = lots.groups(x, c, whole, tests=tests)
    rows = slowly @ back * factor
    of_type = np.einsum("gi,ij,gj->g", rows, whole.covariance, rows)
    variances = np.einsum("gi,nij,gj->ng", rows, c, rows)
    mean, half, between = lots.intervals(x @ rows.T, variances, of_type)
    # What no residual shows may be common to all, so that no mean removes it.
    common = [np.sum((slowly @ one.unseen.T * factor) ** 2, axis=1) for one in having]
    half = np.hypot(half, lots.NORMAL * np.sqrt(np.mean(common, axis=0)))
    shares = np.sort(np.maximum(np.linalg.eigvalsh(whole.covariance), 0.0))[::-1]
    members = () if parted is None else tuple(
        tuple(serials[kept][parted.members == k].tolist()) for k in range(int(parted.members.max()) + 1)
    )  # fmt: skip
    count, prior = None if fit is None else fit.shapes.shape[1], None
    curves = np.zeros((0, len(temperatures)))
    beyond: str | None = None
    if fit is not None:
        spread = lots.restricted_likelihood(fit.amplitudes, fit.noise).covariance if count else np.zeros((0, 0))
        sizes, turned = np.linalg.eigh(spread)
        curves = (rows @ fit.shapes @ (turned * np.sqrt(np.maximum(sizes, 0.0)))).T[::-1]
        rest = lots.rest_bound(fit, x, c)
        explained = float(fit.mean @ fit.mean + np.maximum(sizes, 0.0).sum())
        if len(x) < max(lots.FEW, (count or 0) + 4):
            beyond = "few"
        elif parted is not None:
            beyond = "groups"
        elif explained <= len(forth) * rest**2 or not seen.all():
            beyond = "unclear"
        else:
            squares, directions = np.linalg.eigh(lots.next_covariance(fit, x, c))
            prior = (back @ (directions * np.sqrt(np.maximum(squares, 0.0)))).T[::-1]
    total = max(float(shares.sum()), 1e-300)
    result = LotMap(
        f"{kind}_{axis}", name, unit, tuple(serials.tolist()), temperatures, values @ rows.T, mean, half,
        np.sqrt(np.maximum(of_type, 0.0)), between, float(np.linalg.norm(whole.mean)),
        float(np.sqrt(shares.sum())), tuple(shape_tests), count, curves, tuple((shares / total).tolist()),
        tuple(found), members, dict(zip(first.term.coefficients, (back @ whole.mean).tolist(), strict=True)), prior,
        first.term, (),
    )  # fmt: skip
    return result._replace(findings=tuple(_findings(result, beyond)))


def _strangers(values: Floats, own: Floats, serials: np.ndarray, tests: int) -> tuple[np.ndarray, list[Stranger]]:
    """Which IMUs are none, and those that are: the clearest first, then again among the others."""
    kept, found = np.arange(len(values)), list[Stranger]()
    while len(found) < max(1, len(values) // _STRANGERS):
        level = lots.LEVEL / (len(values) * tests)
        counted, fit = lots.count_shapes(values[kept], own[kept])
        # An IMU may be what keeps the shapes of the others from repeating.
        tried = [lots.low_rank(values[kept], own[kept], counted[-1].shapes)] if fit is None else []
        for model in (*tried, fit):
            compared = lots.strangers(values[kept], own[kept], model, scaled=model is not fit)
            if compared is None:
                continue
            chances, left = compared
            # Where the shapes do not repeat, a stranger is whom the others' shapes do without.
            worst = int(np.argmin(chances if model is fit else left))
            others = np.delete(kept, worst)
            repeat = model is fit or lots.count_shapes(values[others], own[others])[1] is not None
            if chances[worst] < level / (1 + len(tried)) and repeat:
                found.append(Stranger(str(serials[kept[worst]]), float(chances[worst])))
                kept = others
                break
        else:
            break
    return kept, found


def _findings(of: LotMap, beyond: str | None) -> Iterator[str]:
    """What a map says of the type, in sentences."""
    what, last = f"{of.channel} {of.term.replace('_', ' ')}", of.tests[-1]
    test = f"the remainder has χ² {last.chi_squared:.4g}, {last.degrees} degrees of freedom"
    size = len(of.shares)
    n = len(of.serial_numbers) - len(of.strangers)
    place = int(np.argmax(np.abs(of.mean) / np.maximum(of.mean_half, 1e-300)))
    if abs(of.mean[place]) <= of.mean_half[place]:
        yield f"{what}: its mean does not differ significantly from zero"
    if of.shape_count is None:
        most = last.shapes
        shapes = f"{in_words(most)} shape{'' if most == 1 else 's'}" if most else "one map"
        yield (
            f"{what}: the shapes do not repeat (with {shapes} for {n} IMUs, {test}), so the lot predicts only the size "
            "of the next IMU's map; no prior is written"
            if of.shapes_in_words == "do not repeat"
            else f"{what}: {n} IMUs are too few to decide whether the shapes repeat (with {shapes}, {test})"
        )
    elif size == 1:
        alike = (
            "all IMUs are equal within the uncertainty of their calibrations"
            if of.shape_count == 0
            else "a constant, with a spread"
        )
        yield f"{what}: {alike} ({test})"
    elif of.shape_count == 0:
        yield f"{what}: no spread is visible beyond the uncertainty of the calibrations (with one map for all, {test})"
    else:
        repeat = "shape repeats and explains" if of.shape_count == 1 else "shapes repeat and explain"
        share = 100.0 * sum(of.shares[: of.shape_count])
        yield f"{what}: {in_words(of.shape_count)} {repeat} {share:.3g} % of the spread's variance ({test})"
    if beyond == "few" and len(of.serial_numbers) >= lots.FEW:
        yield f"{what}: {n} IMUs are too few for a prior"
    elif beyond == "unclear":
        yield (
            f"{what}: the allowance for other deviations is as large as the repeating part, because the "
            "calibrations are too uncertain or have different ranges; no prior is written"
        )
    if of.groups:
        sizes = ", ".join(str(len(group)) for group in of.groups)
        yield f"{what}: {len(of.groups)} groups, of {sizes} IMUs: make a lot of each group; no prior is written"
    for one in of.strangers:
        yield (
            f"{what}: {one.serial_number} is an outlier (probability that an IMU of this type differs as "
            f"much from all others: {one.chance:.2g}); it is not used for mean, spread and shapes"
        )


_HEADER: Final = """\
Priors for a type of IMU, from a lot of {n} calibrations{simulated}. In the spec of the next IMU, replace the tables of
the same names by these. A shape is a function with a random factor of mean 0 and variance 1 for each IMU; the first
shape is the mean map, and the last shapes allow for other deviations."""


def lot_priors(of: Lot) -> str:
    """The maps of a lot whose shapes repeat as tables of a spec, in TOML. Errors: `ValueError` where none does,
    or where a spec has no key for those that do."""
    tables: dict[str, dict[str, dict[str, Any]]] = {}
    for kind, triad in (("gyro", GyroTriad), ("accelerometer", AccelerometerTriad)):
        for key in triad.model_fields:
            # "g_squared_x" is of [sensor.gyro.g_squared], and "cross_xy" of cross_coupling.
            starts = "cross_" if key == "cross_coupling" else key
            own = [m for m in of.maps if m.channel.startswith(kind) and m.term.startswith(starts)]
            if own and (table := _prior_table(own)) is not None:
                tables.setdefault(kind, {})[key] = table
    if not tables:
        raise ValueError("no prior is written: " + "; ".join(f for m in of.maps if m.prior is None for f in m.findings))
    simulated = ", SIMULATED" if of.simulated else ""
    return tables_to_toml({"sensor": tables}, header=_HEADER.format(n=len(of.serial_numbers), simulated=simulated))


def _prior_table(maps: list[LotMap]) -> dict[str, Any] | None:
    """The table of a spec of maps of all channels; None where it has no key for them, or where they do not repeat."""
    first, factor = maps[0].of, UNITS_OF_TERMS.get(maps[0].of.unit, (maps[0].unit, 1.0))[1]
    bases = {
        key: getattr(first, key).model_dump(mode="json", exclude_unset=True)
        for key in ("temperature", "rate")
        if getattr(first, key)
    }
    if first.size == 1:
        if any(m.prior is None for m in maps):
            return None
        largest = max(float(np.linalg.norm(m.prior)) for m in maps if m.prior is not None)
        return bases | {"prior": f"{largest * factor:.6g} {maps[0].unit}"}
    shapes = [
        {"axis": m.channel[-1], "coefficients": [f"{value * factor:.12g} {m.unit}" for value in shape.tolist()]}
        for m in maps if m.prior is not None and m.term in ("bias", "scale_factor")
        for shape in m.prior
    ]  # fmt: skip
    return bases | {"shape": shapes} if shapes else None


def lot_tables(of: Lot) -> dict[str, Any]:
    """A lot for JSON: each map with its curves over temperature, its tests and what they find."""
    rows = [
        {
            "channel": m.channel,
            "term": m.term,
            "unit": m.unit,
            "imus": list(m.serial_numbers),
            "temperature_c": m.temperature_c.tolist(),
            "mean": m.mean.tolist(),
            "mean_half_95": m.mean_half.tolist(),
            "spread": m.spread.tolist(),
            "spread_95": m.spread_interval.tolist(),
            "mean_rms": m.mean_rms,
            "spread_rms": m.spread_rms,
            "tests": [test._asdict() for test in m.tests],
            "shapes": m.shape_count,
            "shape_curves": m.shapes.tolist(),
            "spread_shares": list(m.shares),
            "strangers": [one._asdict() for one in m.strangers],
            "groups": [list(group) for group in m.groups],
            "mean_coefficients_si": m.coefficients,
            "prior": m.prior is not None,
            "findings": list(m.findings),
        }
        for m in of.maps
    ]
    return {
        "imus": list(of.serial_numbers),
        "simulated": of.simulated,
        "level": lots.LEVEL,
        "maps": rows,
        "notes": of.notes,
    }
