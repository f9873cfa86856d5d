"""The polynomials beyond the maps of a gyro, for which a log is tested."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.model import BIAS, DISCREPANCY, SCALE_FACTOR, Discrepancy, SensorModel, make_map
from gradcal_jax.model.build import basis
from gradcal_jax.spec.bases import RatePolynomial, TemperaturePolynomial
from gradcal_jax.spec.sensor import ScaleFactor
from gradcal_jax.spec.spec_sections import Spec

FALSE_ALARM = 0.01
"""Level of the test."""
# Number of degrees beyond the structure that are tested if the spec states no discrepancy.
_MORE = 2


class TestedMap(NamedTuple):
    """The polynomials beyond the structure, up to these degrees; `std` (1, rad/s) of each where the spec has one."""

    temperature_degree: int
    rate_degree: int
    std: float | None

    __test__ = False


def tested_maps(spec: Spec) -> dict[str, TestedMap]:
    """The test of every polynomial map, by quantity, with degrees and size of its discrepancy."""
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
    if of is None:
        maps[SCALE_FACTOR] = TestedMap(scale.temperature.degree + _MORE, scale.rate.degree + _MORE, None)
    else:
        maps[SCALE_FACTOR] = TestedMap(of.temperature_degree, of.rate_degree, float(of.standard_deviation))
    return maps


def hidden_maps(spec: Spec, model: SensorModel) -> list[Discrepancy]:
    """The hidden maps that a log of the spec's sensor is tested for."""
    return [_hidden_map(spec, model, quantity) for quantity in tested_maps(spec)]


def _hidden_map(spec: Spec, model: SensorModel, quantity: str) -> Discrepancy:
    term = model.term(DISCREPANCY.format(quantity))
    if isinstance(term, Discrepancy):
        return term
    of = tested_maps(spec)[quantity]
    gyro = spec.sensor.gyro
    assert gyro is not None
    section = gyro.bias if quantity == BIAS else gyro.scale_factor
    assert section is not None
    # The result of a test does not depend on the size.
    size = np.radians(10.0) / 3600.0 if quantity == BIAS else 1e-4
    beyond = make_map(
        basis(section.temperature),
        basis(section.rate) if isinstance(section, ScaleFactor) else None,
        discrepancy=(size, of.temperature_degree, of.rate_degree),
    ).beyond
    assert beyond is not None
    return beyond
