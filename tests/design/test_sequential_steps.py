"""What a device with many cores would wait for: no program goes through the readings one after the other."""

import math

import jax
import pytest
from search_problem import SPEC

import gradcal_jax as gj
from gradcal_jax.information import imu_system, whiten
from gradcal_jax.model.imu_build import build_imu
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec

UNIT = gj.changed(
    gj.parse_spec(gj.presets.text("gradient-three-axes")),
    {"rig.chamber.max_heating": "3 K/min", "plan.gradient": "3 K/min"},
)


def loops(jaxpr, times=1):
    """How many steps each loop within a program makes, one after the other; infinite where nobody knows."""
    for equation in jaxpr.eqns:
        name, steps = equation.primitive.name, times
        if name == "scan":
            steps = times * equation.params["length"]
            yield steps
        elif name == "while":
            yield math.inf
        for part in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "jaxpr")):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield from loops(part, steps)


def steps_of(function, *arguments) -> tuple[float, bool]:
    """The most steps that are made one after the other, and whether a choice is left when the program is lowered: one
    by the platform is none any more."""
    traced = jax.jit(function).trace(*arguments)
    found, text = list(loops(traced.jaxpr.jaxpr)), str(traced.lower().as_text())
    assert math.inf not in found
    return max(found), "stablehlo.case" in text or "stablehlo.if" in text


@pytest.fixture
def blocks(monkeypatch):
    """As where no machine code is: on a GPU, or without a compiler."""
    monkeypatch.setenv("GRADCAL_NATIVE", "0")


def test_a_gradient_waits_for_the_root_of_the_readings(blocks):
    spec = changed(parse_spec(SPEC), {"sensor.rate_random_walk": "2 deg/h/sqrt(h)"})
    residual = gj.differentiable(spec)
    readings = len(gj.timeline(spec).readings)
    assert readings > 100
    # One choice is left, of how the triangular factor is found (`linalg.triangular_factor`): a batch computes all ways.
    longest, _ = steps_of(jax.value_and_grad(lambda q: residual(q)["full range"]), residual.quantities)
    assert 4 < longest < 2.0 * readings**0.5


def test_a_whole_unit_waits_for_the_root_of_its_rows(blocks):
    built = build_imu(UNIT)
    steps, columns = imu_system(built.motion, built.model, built.body_nodes())
    steps, columns = jax.tree.map(jax.numpy.asarray, (steps, columns))
    rows = columns.shape[0]
    assert rows > 500
    longest, chosen = steps_of(lambda s, c: whiten(s, c, block=None), steps, columns)
    assert not chosen
    assert 4 < longest < 2.0 * rows**0.5


def test_a_loop_over_all_readings_would_be_seen():
    def counted(x, length):
        return jax.lax.scan(lambda c, _: (c + 1.0, None), x, None, length=length)[0]

    assert steps_of(lambda x: counted(x, 500), 0.0) == (500, False)
    assert steps_of(lambda x: jax.lax.cond(x > 0.0, lambda y: counted(y, 7), lambda y: y, x), 1.0) == (7, True)
    with pytest.raises(AssertionError):
        steps_of(lambda x: jax.lax.while_loop(lambda y: y < 3.0, lambda y: y + 1.0, x), 0.0)
