"""Which hidden maps a plan is tested for: the polynomials after a map's structure, and what the test will notice."""

from typing import Any, NamedTuple, cast

import equinox as eqx
import numpy as np

from gradcal_jax.api.build import Assembled, basis
from gradcal_jax.api.posterior_of_plan import UNIT_OF
from gradcal_jax.files import Spec
from gradcal_jax.files.bases import RatePolynomial, TemperaturePolynomial
from gradcal_jax.files.contracts import NoticeRow
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.sensor import ScaleFactor
from gradcal_jax.information import (
    SquareRootInformation,
    gains_of_shares,
    information,
    kept,
    noticed_from,
    power,
    square_root,
    where_hidden,
)
from gradcal_jax.model import BIAS, DISCREPANCY, SCALE_FACTOR, Discrepancy, SensorModel, make_map

FALSE_ALARM = 0.01
"""Level of the test where the spec has no design that says another."""
_POWER = 0.9
# So many degrees beyond the structure are tested where the spec does not say.
_MORE = 2
# A standard deviation for maps that have none of their own: any does, for what the plan sees does not depend on it.
NOTIONAL = {BIAS: 10.0 / UNIT_OF["bias"][1], SCALE_FACTOR: 100.0 / UNIT_OF["scale_factor"][1]}


class TestedMap(NamedTuple):
    """The polynomials up to these degrees beyond the structure; `std` (1, rad/s) of each where the spec says one."""

    temperature_degree: int
    rate_degree: int
    std: float | None
    false_alarm: float = FALSE_ALARM
    power: float = _POWER

    __test__ = False


def tested_maps(spec: Spec) -> dict[str, TestedMap]:
    """By quantity: of every map that is a polynomial. A discrepancy says degrees and size, a [design] `notice` too."""
    found: dict[str, TestedMap] = {}
    bias, scale = spec.sensor.bias, spec.sensor.scale_factor
    if bias is not None and isinstance(bias.temperature, TemperaturePolynomial):
        of = bias.discrepancy
        degree = bias.temperature.degree + _MORE if of is None else of.temperature_degree
        found[BIAS] = TestedMap(degree, 0, None if of is None else float(of.standard_deviation))
    if scale is None or not isinstance(scale.temperature, TemperaturePolynomial):
        return found
    if not isinstance(scale.rate, RatePolynomial):
        return found
    of, notice = scale.discrepancy, None if spec.design is None else spec.design.notice
    degrees = [scale.temperature.degree + _MORE, scale.rate.degree + _MORE]
    if of is not None:
        degrees = [of.temperature_degree, of.rate_degree]
    elif notice is not None:
        asked = (notice.temperature_degree, notice.rate_degree)
        degrees = [own if a is None else a for own, a in zip(degrees, asked, strict=True)]
    said = notice if notice is not None else of
    found[SCALE_FACTOR] = TestedMap(
        degrees[0],
        degrees[1],
        None if said is None else float(said.standard_deviation),
        *(() if notice is None else (float(notice.false_alarm), float(notice.power))),
    )
    return found


def with_hidden(spec: Spec, model: SensorModel, quantity: str) -> SensorModel:
    """The model with the hidden map of a quantity as its last term, where it has no discrepancy of its own.

    No criterion counts it: it is there to be tested for.
    """
    if where_hidden(model, quantity) is not None:
        return model
    of = tested_maps(spec)[quantity]
    section = spec.sensor.bias if quantity == BIAS else spec.sensor.scale_factor
    assert section is not None
    beyond = make_map(
        basis(section.temperature),
        basis(section.rate) if isinstance(section, ScaleFactor) else None,
        discrepancy=(NOTIONAL[quantity], of.temperature_degree, of.rate_degree),
    ).beyond
    assert beyond is not None
    return eqx.tree_at(lambda m: m.terms, model, (*model.terms, beyond))


def hidden_maps(spec: Spec, model: SensorModel) -> list[tuple[Discrepancy, float]]:
    """The hidden maps that a log of the spec's sensor is tested for, and the level of false alarms of each test."""
    found = [(where_hidden(with_hidden(spec, model, name), name), of) for name, of in tested_maps(spec).items()]
    return [(hidden[0], of.false_alarm) for hidden, of in found if hidden is not None]


def noticing(built: Assembled) -> tuple[NoticeRow, ...]:
    """What the plan notices of hidden maps: for each axis and each map that is a polynomial."""
    tested = tested_maps(built.spec)
    if not tested:
        return ()
    model = built.model
    for quantity in tested:
        model = with_hidden(built.spec, model, quantity)
    std = lambda name: lambda m: next(t for t in m.terms if t.name == DISCREPANCY.format(name)).std  # noqa: E731
    rows: list[NoticeRow] = []
    for channel in built.channels:
        for quantity, of in tested.items():
            # What is seen of the map does not depend on the size of its prior; a small one would hide it in rounding.
            asked = eqx.tree_at(std(quantity), model, np.asarray(NOTIONAL[quantity]))
            info = information(built.trajectory(channel), asked)
            # The other map counts as the spec has it: a hidden one that was only added to be tested is not there.
            others = [q for q in tested if q != quantity and where_hidden(built.model, q) is None]
            term, where, believed = _without(info, asked, others, quantity)
            rows.append(_row(quantity, channel, of, gains_of_shares(kept(believed, where, term.std), float(term.std))))
    return tuple(rows)


def _without(info: SquareRootInformation, model: SensorModel, others: list[str], quantity: str):
    """The discrepancy of a quantity, where it stands, and the information with those of `others` known to be zero."""
    found = where_hidden(model, quantity)
    assert found is not None
    term, where = found
    keep = np.ones(model.size, bool)
    for other in others:
        gone = where_hidden(model, other)
        assert gone is not None
        keep[gone[1]] = False
    begin = int(keep[: where.start].sum())
    rows = (info.factor * info.scale[None, :])[:, keep]
    return term, slice(begin, begin + term.size), square_root(rows)


def _row(quantity: str, axis: Axis, of: TestedMap, gain: np.ndarray) -> NoticeRow:
    unit, factor = UNIT_OF[quantity]
    least = noticed_from(gain, of.power, of.false_alarm)
    return NoticeRow(
        quantity=cast("Any", quantity),
        axis=axis,
        temperature_degree=of.temperature_degree,
        rate_degree=None if quantity == BIAS else of.rate_degree,
        unit=cast("Any", unit),
        components=len(gain),
        false_alarm=of.false_alarm,
        standard_deviation=None if of.std is None else of.std * factor,
        power=None if of.std is None else power(gain, of.std, of.false_alarm),
        sure_power=of.power,
        sure_from=None if least is None else least * factor,
    )
