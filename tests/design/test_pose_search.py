"""`optimise` of a whole unit: what it claims is what its plan is predicted to leave."""

import json
import math
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.design.cycle_moves import Neighbourhood
from gradcal_jax.design.cycle_plan import CyclePlan, RepeatedCycle
from gradcal_jax.design.optimise import run_search
from gradcal_jax.design.searching import Optimised, SearchStep
from gradcal_jax.information.verdicts import UNIT_OF
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.tables import writing

EXPERIMENTS = Path(__file__).parents[2] / "experiments" / "imu"
# The objective's value alone is compiled in a third of the time without XLA's optimisations.
QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


pytestmark = pytest.mark.usefixtures("without_prices")


def small(**changes) -> gj.Spec:
    return gj.changed(gj.parse_spec(gj.presets.text("accelerometer-six-positions-toured")), changes)


def left_by(plan: CyclePlan, cycle: RepeatedCycle) -> tuple[np.ndarray, RepeatedCycle]:
    """As `left_and_value`, without the value."""
    return left_and_value(plan, cycle, valued=False)[:2]


def left_and_value(
    plan: CyclePlan, cycle: RepeatedCycle, *, valued: bool = True
) -> tuple[np.ndarray, RepeatedCycle, float]:
    """What the minimised requirements leave by the search's objective, `(s, m)` in the units of reports for each model
    of the noise, the cycle as its coordinates hold it, and the objective's value, of one program."""
    of = plan.structure(cycle)
    z = plan.coordinates.encode(cycle.turns, of)
    args = (jax.tree.map(jnp.asarray, of), plan.course(cycle.cycles).ramps, np.inf)

    def both(z, of, *args):
        logs = plan.objective.logs(plan.coordinates.decode(z, of), of, *args)
        return logs, plan.objective.value(z, of, *args) if valued else jnp.nan

    logs, value = jax.jit(both, compiler_options=QUICKLY)(z, *args)
    rows = [
        r for r in plan.spec.requirement if plan.exact.worst or plan.design.minimise in ("all requirements", r.name)
    ]
    limits = [1.0 if r.target is None else float(r.target) * UNIT_OF[r.quantity][1] for r in rows]
    return np.exp(np.asarray(logs)) * limits, cycle._replace(turns=plan.coordinates.cycle(z, of)), float(value)


@pytest.fixture(scope="module")
def searched() -> tuple[gj.Spec, list[SearchStep], Optimised]:
    spec = small()
    *states, best = run_search(spec, steps=300)
    return spec, states, best


@pytest.mark.long
def test_the_optimum_is_what_its_plan_leaves(searched):
    spec, states, best = searched
    assert isinstance(best, Optimised)
    assert [s.best for s in states] == sorted((s.best for s in states), reverse=True)
    before, after = gj.predict(spec), gj.predict(best.spec)
    for row, old, new in zip(best.rows, before.requirements, after.requirements, strict=True):
        assert row[2] == pytest.approx(old.decisive, rel=1e-8)
        assert row[3] == pytest.approx(new.decisive, rel=1e-8)
    gain = math.exp(sum(math.log(row[2] / row[3]) for row in best.rows) / len(best.rows))
    assert best.gain == pytest.approx(gain, rel=1e-9)
    assert best.gain > 1.03


@lru_cache
def turning() -> str:
    """A gyro and its accelerometers on a ramp, small enough to compile quickly."""
    spec = gj.read_spec(EXPERIMENTS / "hand2.toml")
    line = {"basis": "polynomial", "degree": 1, "centre": "20 degC", "scale": "50 K"}
    turns = [("spin", 720), ("spin", -720), ("tilt", 50), ("spin", 40), ("tilt", 450), ("tilt", -380), ("spin", 55)]
    turns += [("tilt", -135), ("spin", 130), ("tilt", 180), ("spin", 135), ("tilt", -165)]
    moves = [
        m for axis, t in turns for m in ({"turn": f"{t} deg", "axis": axis, "peak_rate": "200 deg/s"}, {"rest": "17 s"})
    ]
    return writing.to_toml(
        gj.changed(
            spec,
            {
                "sensor.gyro.axes": ["x", "z"],
                "sensor.gyro.bias.temperature": line,
                "sensor.gyro.scale_factor.temperature": line,
                "sensor.gyro.scale_factor.rate": {"basis": "polynomial", "degree": 1, "scale": "300 deg/s"},
                "sensor.accelerometer.bias.temperature": line,
                "sensor.accelerometer.scale_factor.temperature": line,
                "plan.cycle.moves": moves,
                # So that the plan of a cycle is hardly rounded.
                "rig.resolution": {"time": "1 ms"},
                "requirement": [
                    r.model_dump(mode="json", exclude_unset=True) | {"grid": [21] * len(r.grid)}
                    for r in spec.requirement
                    if r.name in ("gyro scale factor", "gyro bias", "accelerometer scale factor")
                ],
            },
        )
    )


BOTH_WAYS = {
    "plan.temperature": None,
    "plan.gradient": None,
    "plan.programme": [
        {"soak": "30 min", "at": "-30 degC", "used": True},
        {"ramp_to": "70 degC", "rate": "2 K/min"},
        {"ramp_to": "-30 degC", "rate": "1 K/min"},
    ],
}
PATH = {
    "sensor.gyro.hysteresis": [{"width": "10 K", "prior": "2 deg/h/K"}],
    "sensor.gyro.scale_factor_hysteresis": [{"width": "10 K", "prior": "5 ppm/K"}],
    "requirement[0].branch": "both",
    "requirement[1].branch": "both",
}
PLANS = {
    "one ramp": ({}, 4e-3),
    "both ways": (BOTH_WAYS, 0.03),
    # The state of a play at twelve temperatures of a slope stands for that at all others.
    "a path": (BOTH_WAYS | PATH, 0.1),
    "bins": (
        {
            "sensor.accelerometer.bias.temperature": {
                "basis": "bins",
                "edges": ["-30 degC", "0 degC", "30 degC", "70 degC"],
            }
        },
        0.15,
    ),
    "a discrepancy": (
        {
            "sensor.gyro.scale_factor.discrepancy": {
                "standard_deviation": "20 ppm",
                "temperature_degree": 2,
                "rate_degree": 2,
            }
        },
        4e-3,
    ),
    "a lag": ({"sensor.thermal_lag": "2 min"}, 0.01),
    "slow moves": ({"sensor.accelerometer.read_on_moves_below": "250 deg/s"}, 3e-3),
    "limited travel": ({"rig.table.axis[0].travel": "520 deg"}, 4e-3),
}


@pytest.mark.long
def test_the_objective_is_that_of_the_whole_plan():
    """Though it filters two cycles of each slope; of the cycle of its coordinates, as `predict` says."""
    check_objective("one ramp")


@pytest.mark.evidence
@pytest.mark.parametrize("name", [name for name in PLANS if name != "one ramp"])
def test_the_objective_is_that_of_the_whole_plan_whatever_its_course(name):
    check_objective(name)


def check_objective(name: str) -> None:
    changes, within = PLANS[name]
    spec = gj.changed(gj.parse_spec(turning()), changes)
    plan = CyclePlan(spec)
    (left,), cycle = left_by(plan, plan.start)
    found = plan.spec_of(cycle)
    assert found.schedule.stretches[0].cycles == plan.start.cycles
    assert left == pytest.approx([r.decisive for r in gj.predict(found).requirements], rel=within)


@pytest.mark.evidence
@pytest.mark.parametrize("preset", gj.presets.names())
def test_the_objective_is_that_of_every_preset(preset):
    """On the coarse grid of a search."""
    spec = gj.parse_spec(gj.presets.text(preset))
    if spec.turns_one_gyro or spec.rig.table.drive == "hand":
        pytest.skip("searched by its turns (tests/design/test_optimise.py), or not at all")
    rows = [r.model_dump(mode="json", exclude_unset=True) for r in spec.requirement]
    grids = [[min(g, 21) for g in r.grid] for r in spec.requirement]
    coarse = [row | {"grid": grid} for row, grid in zip(rows, grids, strict=True)]
    plan = CyclePlan(gj.changed(spec, {"requirement": coarse}))
    (left,), cycle = left_by(plan, plan.start)
    assert left == pytest.approx([r.decisive for r in gj.predict(plan.spec_of(cycle)).requirements], rel=0.03)


@pytest.mark.long
def test_its_derivative_is_that_of_differences_in_every_coordinate():
    """Poses, rates and rests, near bounds too; central differences of two sizes, of which the smaller is nearer."""
    plan = CyclePlan(gj.parse_spec(turning()))
    of = jax.tree.map(jnp.asarray, plan.structure(plan.start))
    z = plan.coordinates.encode(plan.start.turns, plan.structure(plan.start))
    z[1, 0] = 0.4
    args = (of, plan.course(plan.start.cycles).ramps, 30.0)
    of_z = lambda z: plan.objective.value(z, *args)  # noqa: E731
    slope = np.asarray(jax.jit(jax.grad(of_z), compiler_options=QUICKLY)(z))
    value = jax.jit(of_z, compiler_options=QUICKLY)
    scale = np.max(np.abs(slope))
    for k in range(z.size):
        errors = []
        for step in (1e-3, 1e-5):
            there = np.zeros(z.size)
            there[k] = step
            there = there.reshape(z.shape)
            errors.append(abs((float(value(z + there)) - float(value(z - there))) / (2.0 * step) - slope.flat[k]))
        assert errors[1] < 1e-7 * scale + 1e-8, (np.unravel_index(k, z.shape), errors, slope.flat[k])
    assert np.count_nonzero(slope) > 20


@pytest.mark.long
@pytest.mark.parametrize("robust", ["mean", "worst"])
def test_the_value_of_a_cycle_is_the_mean_or_the_worst_over_scenarios(robust):
    noise = {"velocity_random_walk": "0.3 m/s/sqrt(h)"}
    scenarios = [{}, {"sensor": {"accelerometer": noise}}]
    plan = CyclePlan(small(**{"design.scenario": scenarios, "design.robust": robust, "design.minimise": "worst ratio"}))
    left, cycle, value = left_and_value(plan, plan.start)
    found = tables_of(plan.spec_of(cycle))["plan"]
    cases = {}, {"sensor.accelerometer.velocity_random_walk": noise["velocity_random_walk"]}
    for row, texts in zip(left, cases, strict=True):
        assert row == pytest.approx([r.decisive for r in gj.predict(small(plan=found, **texts)).requirements], rel=0.02)
    worst = np.max(np.log(left / [float(r.target) * UNIT_OF[r.quantity][1] for r in plan.spec.requirement]), axis=1)
    assert np.ptp(worst) > 0.1
    assert value == pytest.approx(max(worst) if robust == "worst" else np.mean(worst), rel=1e-9)


def minimising(name: str, **targets: str) -> dict:
    """A design for one requirement, with targets for those of a quantity."""
    rows = [r.model_dump(mode="json", exclude_unset=True) for r in small().requirement]
    rows = [{k: v for k, v in row.items() if k != "target"} for row in rows]
    limited = [row | ({"target": targets[row["quantity"]]} if row["quantity"] in targets else {}) for row in rows]
    return {"design.minimise": name, "requirement": limited}


@pytest.mark.long
def test_scenarios_count_by_their_weights():
    """The mean over two scenarios is that of the predictions of both, and the objective that descends agrees."""
    noise = {"accelerometer": {"velocity_random_walk": "0.3 m/s/sqrt(h)"}}
    scenarios = [{"weight": 3.0}, {"sensor": noise}]
    plan = CyclePlan(small(**{"design.minimise": "all requirements", "design.scenario": scenarios}))
    left, cycle, value = left_and_value(plan, plan.start)
    found = tables_of(plan.spec_of(cycle))["plan"]
    changes = ({}, {"sensor.accelerometer.velocity_random_walk": "0.3 m/s/sqrt(h)"})
    predicted = [[r.decisive for r in gj.predict(small(plan=found, **c)).requirements] for c in changes]
    assert left == pytest.approx(np.array(predicted), rel=0.02)
    assert np.min(np.ptp(np.log(predicted), axis=0)) > 0.05
    targets = [1.0 if r.target is None else float(r.target) * UNIT_OF[r.quantity][1] for r in plan.spec.requirement]
    logs = np.mean(np.log(np.array(predicted) / targets), axis=1)
    assert plan.exact.value_of(plan.exact.residuals(plan.spec_of(cycle))) == pytest.approx(
        0.75 * logs[0] + 0.25 * logs[1], abs=1e-6
    )
    assert value == pytest.approx(0.75 * logs[0] + 0.25 * logs[1], abs=0.02)
    with pytest.raises(ValueError, match="changes the set of parameters"):
        CyclePlan(small(**{"design.scenario": [{}, {"sensor": {"accelerometer": {"axes": ["x", "y"]}}}]}))


@pytest.mark.long
def test_the_targets_of_other_requirements_limit_a_search():
    """A search for one requirement alone may exceed the other's target; with the target it is met, at some cost."""
    name, other = small().requirement[0].name, small().requirement[1]
    alone = CyclePlan(small(**minimising(name)))
    left = alone.exact.residuals(alone.spec)[0][1].statistic()
    unit = UNIT_OF[other.quantity][0]
    limited = CyclePlan(small(**minimising(name, **{other.quantity: f"{0.5 * left} {unit}"})))
    before = limited.exact.residuals(limited.spec)
    assert limited.exact.exceeded(before) == {other.name: pytest.approx(math.log(2.0), rel=1e-9)}
    own = math.log(before[0][0].statistic())
    assert limited.exact.without_limits(before) == pytest.approx(own, rel=1e-12)
    of = jax.tree.map(jnp.asarray, limited.structure(limited.start))
    z, ramps = limited.coordinates.encode(limited.start.turns, of), limited.course(limited.start.cycles).ramps
    value = jax.jit(limited.objective.value, compiler_options=QUICKLY)
    assert float(value(z, of, ramps, np.inf)) == pytest.approx(own + 10.0 * math.log(2.0), abs=0.4)
    assert float(value(z, of, ramps, 30.0)) > float(value(z, of, ramps, np.inf))
    *_, free = run_search(alone.spec, steps=200)
    target = 0.97 * min(free.rows[1].now, left)
    *_, best = run_search(small(**minimising(name, **{other.quantity: f"{target} {unit}"})), steps=200)
    assert best.converged
    assert best.rows[1].now <= target < free.rows[1].now
    *_, never = run_search(small(**minimising(name, **{other.quantity: f"{1e-6 * target} {unit}"})), steps=40)
    assert not never.converged
    assert f"meets the target of {other.name}" in never.sentence


@pytest.mark.long
def test_the_result_is_never_worse_than_the_plan_as_it_was(searched):
    """A search from an optimum that may do nothing finds nothing, and says so."""
    _, _, best = searched
    *_, again = run_search(best.spec, steps=20, stop=lambda: True)
    if again.kept:
        assert again.spec == best.spec
        assert [row[2] for row in again.rows] == [row[3] for row in again.rows]
        assert again.gain == 1.0
    else:
        assert again.gain > 1.0


def test_targets_are_met_only_where_every_scenario_meets_them():
    """Noise as it is written meets targets of 1.2 times what it leaves, that of a scenario does not."""
    plain = CyclePlan(small())
    left = [r.statistic() for r in plain.exact.residuals(plain.spec)[0]]
    units = [UNIT_OF[r.quantity][0] for r in plain.spec.requirement]
    rows = [r.model_dump(mode="json", exclude_unset=True) for r in plain.spec.requirement]
    wide = [row | {"target": f"{1.2 * now} {unit}"} for row, now, unit in zip(rows, left, units, strict=True)]
    scenarios = [{}, {"sensor": {"accelerometer": {"velocity_random_walk": "0.3 m/s/sqrt(h)"}}}]
    certain = CyclePlan(small(requirement=wide))
    doubtful = CyclePlan(small(requirement=wide, **{"design.scenario": scenarios}))
    assert certain.exact.met(certain.exact.residuals(certain.spec))
    residuals = doubtful.exact.residuals(doubtful.spec)
    assert [r.statistic() for r in residuals[0]] == pytest.approx(left, rel=1e-12)
    assert not doubtful.exact.met(residuals)


def test_a_target_counts_by_its_rule():
    """Twice the standard deviation within the target is met where one is within half of it."""
    plain = CyclePlan(small())
    rows = [r.model_dump(mode="json", exclude_unset=True) for r in plain.spec.requirement]
    left = {r.requirement.name: r for r in plain.exact.residuals(plain.spec)[0]}

    def met(share: float, of: str, **keys: object) -> bool:
        wide = [r | {"target": f"{share * left[r['name']].statistic(of)} {left[r['name']].unit}"} | keys for r in rows]
        plan = CyclePlan(small(requirement=wide))
        return plan.exact.met(plan.exact.residuals(plan.spec))

    own = rows[0].get("statistic", "mean")
    assert met(1.2, own)
    assert not met(1.2, own, coverage=2.0)
    assert met(2.4, own, coverage=2.0)


def test_a_table_turned_by_hand_is_refused_before_anything_is_computed():
    spec = gj.parse_spec(gj.presets.text("gimbal-by-hand"))
    with pytest.raises(ValueError, match=r'drive is "hand".*drive = "motor"'):
        next(run_search(spec))


@pytest.mark.long
def test_the_command_writes_a_recipe_that_is_worth_what_is_said(tmp_path, capsys, searched):
    source, goal = tmp_path / "unit.toml", tmp_path / "better.toml"
    gj.write_toml(small(), source)
    picture = tmp_path / "both.png"
    assert main(["optimise", str(source), "-o", str(goal), "--steps", "300", "--json", "--plot", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    told = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in told["requirements"]] == [r.name for r in small().requirement]
    # The same numbers for the same seed, and no rounding is left.
    made = gj.read_recipe(goal)
    assert searched[2].spec.plan == made.spec.plan
    now = gj.predict(made.spec).requirements
    assert [row["now"] for row in told["requirements"]] == pytest.approx([r.decisive for r in now], rel=1e-8)
    assert main(["check", str(goal)]) == 0


@pytest.mark.long
def test_turns_of_whole_angle_steps(searched):
    spec, _, _ = searched
    stepped = gj.changed(spec, {"design.angle_step": "15 deg"})
    *_, best = run_search(stepped, steps=200)
    turned = [math.degrees(s.move.angle) / 15.0 for s in best.spec.schedule.steps if s.axis >= 0]
    assert turned == pytest.approx(np.round(turned), abs=1e-9)
    assert best.gain > 1.0


def test_requirements_are_needed():
    with pytest.raises(ValueError, match="to minimise: add one"):
        next(run_search(small(requirement=[])))
    with pytest.raises(ValueError, match="expected the name of a requirement"):
        small(**{"design.minimise": "the bias"})


def test_a_gyro_beyond_its_full_scale_is_refused_and_turns_are_searched_within():
    spec = gj.read_spec(EXPERIMENTS / "hand.toml")
    with pytest.raises(gj.SpecError, match="reaches 300 deg/s, which exceeds the sensor's full scale, 250 deg/s"):
        gj.changed(spec, {"sensor.gyro.full_scale": "250 deg/s", "sensor.gyro.full_scale_margin": "10 %"})
    narrow = gj.changed(spec, {"sensor.gyro.full_scale": "350 deg/s", "sensor.gyro.full_scale_margin": "10 %"})
    plan = CyclePlan(narrow)
    most = min(315.0, *(math.degrees(float(axis.max_rate)) for axis in spec.rig.table.axis))
    assert np.degrees(plan.limits.rates) == pytest.approx([most, most])


@pytest.mark.long
def test_an_axis_of_limited_travel_is_searched():
    """Within its travel, which turns that are inserted at its ends would leave."""
    spec = gj.changed(gj.parse_spec(turning()), {"rig.table.axis[0].travel": "520 deg"})
    *_, best = run_search(spec, steps=400)
    assert best.gain > 1.05
    angles = np.cumsum([s.move.angle for s in best.spec.plain_schedule.steps if s.axis == 0])
    assert np.max(np.abs(angles)) <= math.radians(520.0)


@pytest.mark.evidence
def test_a_frontier_and_the_shortest_plan_of_an_imu():
    """Half the ramp has fewer cycles and leaves more; between both lies a target, which a plan of that time meets."""
    spec = gj.parse_spec(turning())
    lasts = spec.gradient_schedule.motion
    short, long = (point.plan for point in gj.frontier(spec, [0.6 * lasts, lasts], steps=40))
    assert short.spec.gradient_schedule.motion == pytest.approx(0.6 * lasts, rel=0.02)
    assert short.unit == long.unit
    assert short.now > 1.1 * long.now
    rows = [r.model_dump(mode="json", exclude_unset=True) for r in spec.requirement]
    aims = [f"{(a.now * b.now) ** 0.5} {a.unit}" for a, b in zip(short.rows, long.rows, strict=True)]
    asked = [row | {"target": aim} for row, aim in zip(rows, aims, strict=True)]
    keys = {"requirement": asked, "design": {"minimise": "motion time", "max_motion": f"{1.5 * lasts} s"}}
    found = gj.optimise(gj.changed(spec, keys), steps=40)
    assert (found.name, found.unit) == ("motion time", "min")
    assert 0.5 * lasts < 60.0 * found.now < 1.5 * lasts
    assert found.spec.gradient_schedule.motion == pytest.approx(60.0 * found.now, rel=0.01)
    for row, (_, _, _, left), aim in zip(asked, found.rows, aims, strict=True):
        assert left <= 1.001 * float(aim.split()[0]), row["name"]


@pytest.mark.evidence
def test_searches_from_random_cycles_end_alike(tmp_path, capsys):
    """The two-axis headline by the command as it is, from cycles that are nothing but chance: within 2 % of one another
    and of the plan that is kept, which is 1.6 times better than the one by hand."""
    by_hand, gains = gj.read_spec(EXPERIMENTS / "hand2.toml"), []
    plan, before = CyclePlan(by_hand), [row.decisive for row in gj.predict(by_hand).requirements]
    for seed in range(3):
        drawn = Neighbourhood(plan.limits, 40).random(30, np.random.default_rng(seed))
        begins = tmp_path / f"random{seed}.toml"
        writing.write_toml(plan.spec_of(plan.start._replace(turns=drawn)), begins)
        assert main(["optimise", str(begins), "-o", str(tmp_path / f"found{seed}.toml"), "--json"]) == 0
        now = [row["now"] for row in json.loads(capsys.readouterr().out)["requirements"]]
        gains.append(math.exp(np.mean(np.log(np.array(before) / np.array(now)))))
        with capsys.disabled():
            print(f"from a random cycle: {gains[-1]:.3f} times better than by hand")
    kept = [row.decisive for row in gj.predict(gj.read_spec(EXPERIMENTS / "descended.toml")).requirements]
    gains.append(math.exp(np.mean(np.log(np.array(before) / np.array(kept)))))
    assert gains[-1] > 1.6
    assert max(gains) / min(gains) < 1.02


@pytest.mark.long
@pytest.mark.parametrize("every", ["1 s", "3 s", "1000 s"])
def test_the_objective_counts_the_readings_of_rests_as_a_prediction_does(every):
    """At infinite sharpness exactly; at a large one, a few readings that stand for all of a rest nearly so."""
    headline = gj.read_spec(EXPERIMENTS.parent / "designs" / "headline.toml")
    requirement = headline.requirement[0].model_dump(mode="json", exclude_unset=True)
    turns = [
        ("5400 deg", "300 deg/s"),
        ("-5400 deg", "300 deg/s"),
        ("3600 deg", "150 deg/s"),
        ("-3600 deg", "150 deg/s"),
    ]
    moves = [
        move
        for angle, rate in turns
        for move in ({"turn": angle, "axis": "x", "peak_rate": rate, "shape": "linear ramps"}, {"rest": "7.3 s"})
    ]
    spec = gj.changed(
        headline,
        {
            "plan.temperature": ["-30 degC", "-26 degC"],
            "sensor.gyro.scale_factor.temperature.degree": 1,
            "plan.cycle": {"moves": moves},
            "requirement": [requirement | {"grid": [31, 31]}],
            "rig.table.axis[0].angle.read_every": every,
            "design": {"minimise": "full range", "free": ["cycle"]},
        },
    )
    plan = CyclePlan(spec)
    assert plan._window >= plan.start.cycles
    of = plan.structure(plan.start)
    ramps = plan.course(plan.start.cycles).ramps

    @jax.jit
    def left(z, of, ramps):
        decoded = plan.coordinates.decode(z, of)
        exact = plan.objective.logs(decoded, of, ramps, math.inf)
        return jnp.exp(exact), jnp.exp(plan.objective.logs(decoded, of, ramps, jnp.asarray(1e6)))

    for random in (0.0, 0.02):
        z = plan.coordinates.encode(plan.start.turns, of)
        z = z + random * np.random.default_rng(0).standard_normal(z.shape)
        exact, soft = (float(x[0, 0]) for x in left(jnp.asarray(z), jax.tree.map(jnp.asarray, of), ramps))
        written = []
        for t in plan.coordinates.cycle(z, of):
            duration = abs(t.angle) / t.rate + t.rate / float(plan.limits.accelerations[0])
            turn = {"turn": f"{math.degrees(t.angle)!r} deg", "axis": "x", "shape": "linear ramps"}
            written.append(turn | {"peak_rate": f"{math.degrees(t.rate)!r} deg/s", "duration": f"{duration!r} s"})
            written.append({"rest": f"{t.rest!r} s"})
        (row,) = gj.predict(gj.changed(spec, {"plan.cycle.moves": written})).requirements
        assert exact == pytest.approx(row.decisive, rel=1e-9)
        assert soft == pytest.approx(row.decisive, rel=3e-3)


@pytest.mark.long
@pytest.mark.parametrize("preset", ["accelerometer-six-positions"])
def test_the_objective_of_a_plan_of_one_cycle_is_its_prediction(preset, monkeypatch):
    """At infinite sharpness, at the file's plan and at a random point; without the time that is left for rounding."""
    monkeypatch.setattr("gradcal_jax.design.cycle_plan._LEFT", 0.0)
    spec = gj.parse_spec(gj.presets.text(preset))
    rows = [r.model_dump(mode="json", exclude_unset=True) for r in spec.requirement]
    rows = [row | {"grid": [min(g, 21) for g in row["grid"]]} if "grid" in row else row for row in rows]
    spec = gj.changed(spec, {"requirement": rows})
    plan = CyclePlan(spec)
    assert plan._window == 1
    of = plan.structure(plan.start)
    ramps = plan.course(plan.start.cycles).ramps

    def logs(z, of, ramps):
        return plan.objective.logs(plan.coordinates.decode(z, of), of, ramps, math.inf)

    program = jax.jit(logs, compiler_options=QUICKLY)
    names = [aim.name for aim in plan.exact.aims]
    limits = np.array([aim.limit for aim in plan.exact.aims])
    start = plan.coordinates.encode(plan.start.turns, of)
    for random in (0.0, 0.02):
        z = start + random * np.random.default_rng(0).standard_normal(start.shape)
        left = np.exp(np.asarray(program(jnp.asarray(z), jax.tree.map(jnp.asarray, of), ramps)))[0] * limits
        written = []
        for t in plan.coordinates.cycle(z, of):
            if t.axis >= 0:
                duration = abs(t.angle) / t.rate + t.rate / float(plan.limits.accelerations[t.axis])
                turn = {"turn": f"{math.degrees(t.angle)!r} deg", "axis": plan.rounding.axes[t.axis]}
                turn |= {"peak_rate": f"{math.degrees(t.rate)!r} deg/s", "duration": f"{duration!r} s"}
                written.append(turn | {"shape": "linear ramps"})
            if t.rest:
                written.append({"rest": f"{t.rest!r} s"})
        predicted = gj.predict(gj.changed(spec, {"plan.cycle.moves": written})).requirements
        decisive = {row.name: row.decisive for row in predicted}
        assert left == pytest.approx([decisive[name] for name in names], rel=1e-9)
