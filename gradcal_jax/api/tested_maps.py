"""Tests for hidden structure of a map, by polynomials of higher degree, and the power of these tests."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import equinox as eqx
import numpy as np

from gradcal_jax.api.build import basis
from gradcal_jax.api.imu_build import BuiltImu
from gradcal_jax.api.verdicts import UNIT_OF
from gradcal_jax.design import Missed
from gradcal_jax.files.bases import RatePolynomial, TemperaturePolynomial
from gradcal_jax.files.contracts import NoticeRow
from gradcal_jax.files.design import Notice
from gradcal_jax.files.sensor import ScaleFactor
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import (
    SquareRootInformation,
    gains_of_shares,
    imu_information,
    kept,
    noticed_from,
    power,
    quantiles,
    square_root,
    where_hidden,
)
from gradcal_jax.model import AXIS_NAMES, BIAS, DISCREPANCY, SCALE_FACTOR, Discrepancy, ImuModel, SensorModel, make_map

FALSE_ALARM = 0.01
"""Level of the test where the spec's [design] has no other."""
_POWER = 0.9
# Number of degrees beyond the structure that are tested by default.
_MORE = 2
# A standard deviation for maps that have none of their own; the result does not depend on it.
NOTIONAL = {BIAS: 10.0 / UNIT_OF["bias"][1], SCALE_FACTOR: 100.0 / UNIT_OF["scale_factor"][1]}


class TestedMap(NamedTuple):
    """The polynomials beyond the structure, up to these degrees; `std` (1, rad/s) of each where the spec has one."""

    temperature_degree: int
    rate_degree: int
    std: float | None
    false_alarm: float = FALSE_ALARM
    power: float = _POWER

    __test__ = False


def tested_maps(spec: Spec) -> dict[str, TestedMap]:
    """The test of every polynomial map, by quantity, with degrees and size of its discrepancy or `notice`."""
    maps: dict[str, TestedMap] = {}
    gyro = spec.sensor.gyro
    if gyro is None:
        return maps
    bias, scale = gyro.bias, gyro.scale_factor
    if bias is not None and isinstance(bias.temperature, TemperaturePolynomial):
        of = bias.discrepancy
        degree = bias.temperature.degree + _MORE if of is None else of.temperature_degree
        maps[BIAS] = TestedMap(degree, 0, None if of is None else float(of.standard_deviation))
    if scale is None or not isinstance(scale.temperature, TemperaturePolynomial):
        return maps
    if not isinstance(scale.rate, RatePolynomial):
        return maps
    of = scale.discrepancy
    notice = spec.design.notice if spec.design is not None else None
    degrees = [scale.temperature.degree + _MORE, scale.rate.degree + _MORE]
    if of is not None:
        degrees = [of.temperature_degree, of.rate_degree]
    elif notice is not None:
        notice_degrees = (notice.temperature_degree, notice.rate_degree)
        degrees = [own if a is None else a for own, a in zip(degrees, notice_degrees, strict=True)]
    stated = notice if notice is not None else of
    maps[SCALE_FACTOR] = TestedMap(
        degrees[0],
        degrees[1],
        None if stated is None else float(stated.standard_deviation),
        *(() if notice is None else (float(notice.false_alarm), float(notice.power))),
    )
    return maps


def with_hidden(spec: Spec, model: SensorModel, quantity: str) -> SensorModel:
    """The model with the hidden map of a quantity as its last term, where it has no discrepancy of its own.

    No criterion includes that term: it is only tested for.
    """
    if where_hidden(model, quantity) is not None:
        return model
    of = tested_maps(spec)[quantity]
    gyro = spec.sensor.gyro
    assert gyro is not None
    section = gyro.bias if quantity == BIAS else gyro.scale_factor
    assert section is not None
    beyond = make_map(
        basis(section.temperature),
        basis(section.rate) if isinstance(section, ScaleFactor) else None,
        discrepancy=(NOTIONAL[quantity], of.temperature_degree, of.rate_degree),
    ).beyond
    assert beyond is not None
    return eqx.tree_at(lambda m: m.terms, model, (*model.terms, beyond))


def imu_with_hidden(spec: Spec, model: ImuModel) -> ImuModel:
    """The IMU with the hidden scale-factor map of each gyro."""
    hidden = (with_hidden(spec, c.model, SCALE_FACTOR) if c.kind == "gyro" else c.model for c in model.channels)
    channels = tuple(replace(c, model=of) for c, of in zip(model.channels, hidden, strict=True))
    return ImuModel(channels, model.installation, model.encoder)


def hidden_test(model: SensorModel, notice: Notice, begin: int) -> Missed:
    """The test of a `model` for its hidden scale-factor map; its parameters begin at `begin`."""
    term, where = cast("Any", where_hidden(model, SCALE_FACTOR))
    below = quantiles(term.size, float(notice.false_alarm))
    return Missed(
        term.std, np.asarray(float(notice.standard_deviation)), below, (begin + where.start, begin + where.stop)
    )


def hidden_maps(spec: Spec, model: SensorModel) -> list[tuple[Discrepancy, float]]:
    """The hidden maps that a log of the spec's sensor is tested for, with the false-alarm level of each test."""
    maps = [(where_hidden(with_hidden(spec, model, name), name), of) for name, of in tested_maps(spec).items()]
    return [(hidden[0], of.false_alarm) for hidden, of in maps if hidden is not None]


def _knowing(info: SquareRootInformation, own: slice, others: Sequence[slice]) -> tuple[slice, SquareRootInformation]:
    """Where `own` parameters stand in the information with those of `others` known to be zero, and that information."""
    keep = np.ones(len(info.scale), bool)
    for other in others:
        keep[other] = False
    begin = int(keep[: own.start].sum())
    rows = (info.factor * info.scale[None, :])[:, keep]
    return slice(begin, begin + own.stop - own.start), square_root(rows)


def noticing(unit: BuiltImu) -> tuple[NoticeRow, ...]:
    """The power of the plan's tests for hidden structure, for each gyro and each polynomial map."""
    tested, spec = tested_maps(unit.spec), unit.spec
    gyros = [c for c in unit.model.channels if c.kind == "gyro"]
    if not tested or not gyros:
        return ()
    channels, added = list(unit.model.channels), list[tuple[int, str]]()
    for number, channel in enumerate(channels):
        of = channel.model
        for quantity in tested if channel.kind == "gyro" else ():
            if where_hidden(of, quantity) is None:
                added.append((channel.axis, quantity))
            of = with_hidden(spec, of, quantity)
            place = next(k for k, t in enumerate(of.terms) if t.name == DISCREPANCY.format(quantity))
            of = eqx.tree_at(lambda m, k=place: m.terms[k].std, of, np.asarray(NOTIONAL[quantity]))
        channels[number] = replace(channel, model=of)
    model = ImuModel(tuple(channels), unit.model.installation, unit.model.encoder)
    info = imu_information([(unit.motion, unit.body_nodes())], model)
    where = lambda axis, quantity: model.where("gyro", axis, DISCREPANCY.format(quantity))  # noqa: E731
    rows: list[NoticeRow] = []
    for channel in gyros:
        for quantity, of in tested.items():
            others = [where(*other) for other in added if other != (channel.axis, quantity)]
            own, believed = _knowing(info, where(channel.axis, quantity), others)
            shares = kept(believed, own, np.asarray(NOTIONAL[quantity]))
            gains = gains_of_shares(np.asarray(shares), NOTIONAL[quantity])
            rows.append(_row(quantity, AXIS_NAMES[channel.axis], of, gains))
    return tuple(rows)


def _row(quantity: str, axis: str, of: TestedMap, gain: np.ndarray) -> NoticeRow:
    unit, factor = UNIT_OF[quantity]
    least = noticed_from(gain, of.power, of.false_alarm)
    return NoticeRow(
        quantity=cast("Any", quantity),
        axis=cast("Any", axis),
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
