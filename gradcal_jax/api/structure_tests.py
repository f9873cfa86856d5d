"""Tests of an estimate's maps for more structure than their polynomials have, and the size of what they lack."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from gradcal_jax.api.tested_maps import hidden_maps, tested_maps
from gradcal_jax.api.verdicts import UNIT_OF
from gradcal_jax.estimation import ImuEstimate, ImuReadings, StructureTest, size_of, structure_test
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.model import BIAS


class MeasuredDiscrepancy(NamedTuple):
    """The discrepancy of one map and axis, from `units` units together: standard deviation (`unit`) of the coefficients
    beyond the structure, with its 95 % interval (`high` None: unbounded). `block`: its table in a spec."""

    quantity: str
    axis: str
    units: int
    unit: str
    standard_deviation: float
    low: float
    high: float | None
    block: str


def structure_tests(spec: Spec, readings: ImuReadings, solution: ImuEstimate) -> Iterator[tuple[str, StructureTest]]:
    """The test of each polynomial map of each gyro of an estimate, with the name of its channel."""
    model = readings.model
    for number, channel in enumerate(model.channels):
        if channel.kind != "gyro":
            continue
        for term, level in hidden_maps(spec, channel.model):
            white = solution.white.without(model.where("gyro", channel.axis, term.name))
            # A discrepancy that the spec states is no contradiction of it, up to its size.
            stated = 0.0 if channel.model.term(term.name) is None else float(term.std)
            test = structure_test(white, readings.whitened_term(number, term), term, level, stated)
            if test is not None:
                yield channel.name, test


def structure_in_words(test: StructureTest) -> str:
    """A sentence on the degrees of a map that the data need."""
    assert test.asked is not None
    of_temperature, of_rate = test.asked
    degree = f"degree {of_temperature} in temperature" + (f" and {of_rate} in rate" if test.quantity != BIAS else "")
    return (
        f"the {test.quantity.replace('_', ' ')} has more structure than the model (chance "
        f"{test.test.probability:.1g}): {degree} fits significantly better"
    )


def discrepancies(spec: Spec, tests: Iterable[tuple[str, StructureTest]]) -> Iterator[MeasuredDiscrepancy]:
    """The discrepancy of each map and channel, from all units together; `tests` with the names of their channels."""
    of_map: dict[tuple[str, str], list[StructureTest]] = {}
    for channel, test in tests:
        of_map.setdefault((channel, test.quantity), []).append(test)
    for (channel, quantity), own in of_map.items():
        size = size_of([test.components for test in own])
        if size is None:
            continue
        of = tested_maps(spec)[quantity]
        unit, factor = UNIT_OF[quantity]
        high = None if size.high is None else size.high * factor
        degrees = f"temperature_degree = {of.temperature_degree}"
        degrees += "" if quantity == BIAS else f", rate_degree = {of.rate_degree}"
        std = f'standard_deviation = "{size.std * factor:.3g} {unit}"'
        block = f"[sensor.gyro.{quantity}]\ndiscrepancy = {{ {std}, {degrees} }}"
        stated = (size.std * factor, size.low * factor, high)
        yield MeasuredDiscrepancy(quantity, channel[-1], len(own), unit, *stated, block if size.std else "")
