"""Sensors and rigs for which a plan is designed: those of [[design.scenario]], and the ends of `uncertain` figures.

The residual never falls when a standard deviation of the noise rises: the covariance of the estimate grows with that of
the readings. So the worst case has every standard deviation at its largest and the best at its smallest. The effect of
a correlation time has no known sign, so both its ends and the written value are tried.
"""

from itertools import product
from typing import Any, Literal

from gradcal_jax.files import changed
from gradcal_jax.files.design import Scenario
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.spec_sections import Spec

# With more uncertain correlation times than this, each end is tried alone, the others as they are written.
_TOGETHER = 2


def scenario_specs(spec: Spec) -> list[tuple[Spec, float]]:
    """The spec of each scenario, with its weight; the spec itself where nothing is uncertain.

    For a design that minimises the worst case, every standard deviation is at its largest. For one that minimises the
    mean, the figures are as written, and each end of each alone, all with the same weight.
    """
    robust = "mean" if spec.design is None else spec.design.robust
    scenarios = spec.design.scenario if spec.design is not None else ()
    chosen = [(changed(spec, overrides(s)), float(s.weight)) for s in scenarios]
    return [
        (changed(one, values) if values else one, weight)
        for one, weight in chosen or [(spec, 1.0)]
        for values in (_corners(one, 1) if robust == "worst" else _star(one))
    ]


def extremes(spec: Spec) -> list[Spec]:
    """Specs that include the best and the worst case of uncertain figures; none where nothing is uncertain."""
    if not spec.sensor.uncertain_figures():
        return []
    return [changed(spec, values) for end in (0, 1) for values in _corners(spec, end)]


def overrides(scenario: Scenario) -> dict[str, Any]:
    """A scenario's values by their dotted keys."""
    return dict(_leaves({"sensor": scenario.sensor, "rig": scenario.rig}, ""))


def _leaves(tables: dict[str, Any], before: str):
    for name, value in tables.items():
        key = f"{before}.{name}" if before else name
        if isinstance(value, dict):
            yield from _leaves(value, key)
        else:
            yield key, value


def _star(spec: Spec) -> list[dict[str, str]]:
    figures = spec.sensor.uncertain_figures()
    return [{}, *({key: ends[k].text} for key, ends in figures.items() for k in (0, 1))]


def _corners(spec: Spec, end: Literal[0, 1]) -> list[dict[str, str]]:
    figures = spec.sensor.uncertain_figures()
    sizes = {key: ends[end].text for key, ends in figures.items() if not _is_time(key)}
    times: dict[str, tuple[Quantity, Quantity]] = {key: ends for key, ends in figures.items() if _is_time(key)}
    if len(times) > _TOGETHER:
        some: list[dict[str, str]] = [{}, *({key: e.text} for key, ends in times.items() for e in ends)]
    else:
        choices = [[None, *(e.text for e in ends)] for ends in times.values()]
        some = [
            {key: text for key, text in zip(times, texts, strict=True) if text is not None}
            for texts in product(*choices)
        ]
    return [sizes | one for one in some]


def _is_time(key: str) -> bool:
    return key.endswith("correlation_time")
