"""Features of both_kinds.py, of one gyro axis and of an IMU by the same words: plans, predictions and searches; and the
document that shows the table."""

import re

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from both_bench import BY_NAME, Answer, Checks, FeatureBench, benches, drawn, named
from both_kinds import FEATURES, page
from both_specs import ROOT
from test_features_of_runs import CHECKS as OF_RUNS

import gradcal_jax as gj
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec import read_spec
from gradcal_jax.sweeps.dataset import read_dataset

CHECKS = Checks()


@pytest.fixture(scope="module")
def kinds(tmp_path_factory):
    with benches(tmp_path_factory.mktemp("plans"), {}) as made:
        yield made


def test_every_line_of_the_table_has_one_check() -> None:
    assert sorted([*CHECKS, *OF_RUNS]) == sorted(feature.name for feature in FEATURES)
    assert {kind: name for name, feature in BY_NAME.items() for kind in feature.missing} == {
        "IMU": "specs of earlier versions"
    }


def test_the_document_is_what_the_table_says() -> None:
    assert (ROOT / "docs/reference/features.md").read_text(encoding="utf-8") == page(), (
        "python tests/cli/both_kinds.py > docs/reference/features.md"
    )


# --------------------------------------------------------------------------------------------- a plan before it is made


@CHECKS.of("errors of a file")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    error = answers[0].err
    assert "wrong.toml: 2 problems" in error
    assert re.search(r'degre = .*nearest: "degree" \(line \d+\)', error)
    assert re.search(r'quantity = "gyro_bia".*"gyro_bias".*\(line \d+\)', error)


@CHECKS.of("description of a plan")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    out = answers[0].out
    largest = "+720 deg" if bench.of_imu else "+1080 deg"
    for words in (
        "to estimate: gyro x",
        'required: "scale factor"',
        "10 -> 26 degC",
        largest,
        "the spec has no errors",
    ):
        assert words in out
    assert ("to estimate: accelerometer x, y, z: bias (2)" in out) == bench.of_imu


@CHECKS.of("timeline")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = answers[0].json
    times = [reading["time"] for reading in found["readings"]]
    assert times == sorted(times)
    assert 20.0 <= times[0] < times[-1] <= bench.spec.schedule.duration + 1e-6
    assert {channel["name"] for channel in found["channels"]} == bench.channels


@CHECKS.of("prediction")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    for name, value in bench.predicted("spec.toml").items():
        assert re.search(rf"(?m)^{name} .* {value:.4g} .* met$", answers[0].out)


@CHECKS.of("prediction as JSON")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = answers[0].json
    jsonschema.validate(found, bench.say("schema prediction").json, cls=jsonschema.Draft202012Validator)
    assert {name: named(row) for name, row in answers[0].rows.items()} == pytest.approx(bench.predicted("spec.toml"))
    stds = {row["name"]: row["std"] for row in found["parameters"]}
    assert {name.split(".")[0] for name in stds} == bench.channels
    np.testing.assert_allclose(np.sqrt(np.diag(found["covariance"])), list(stds.values()), rtol=1e-9)


@CHECKS.of("omitted terms")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    loose, strict = (answer.rows["bias"] for answer in answers)
    assert "sensor.gyro.bias_temperature_gradient" in [term["key"] for term in answers[0].json["omitted"]]
    assert loose["with_typical"] > 3.0 > named(loose) == pytest.approx(named(strict))
    assert loose["verdict"] == "met"
    assert strict["target"] == pytest.approx(3.0)
    assert (strict["verdict"], answers[1].status) == ("missed", 1)


@CHECKS.of("coverage, risk, chance")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    (row,) = answers[0].rows.values()
    assert (row["coverage"], row["risk"]) == (2.0, 0.02)
    assert row["rule"].startswith("guarded acceptance")
    assert "2 %" in row["rule"]
    assert 0.9 < row["chance_everywhere"] <= row["chance"] <= 1.0
    assert 0.8 < row["check"]["accepted"] <= 1.0
    assert 0.0 <= row["check"]["false_accept"] < 0.02


@CHECKS.of("error budget by source")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    before, after = (share(answer.out, "angle random walk") for answer in answers)
    assert after > 70
    assert after > before
    assert bench.predicted("noisier.toml")["scale factor"] > 5.0 * bench.predicted("spec.toml")["scale factor"]


def share(out: str, source: str, requirement: str = "scale factor") -> int:
    """Of a source in the error budget of a requirement, per cent; 0: it is not among those that are named."""
    (line,) = re.findall(rf"(?m)^{requirement}: limited by (.+)$", out)
    found = re.search(rf"{source} (\d+)%", line)
    return 0 if found is None else int(found[1])


@CHECKS.of("sensitivity")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    rows = answers[0].json["percent_per_percent"]
    found = {row["requirement"]: row["percent"] for row in rows if row["figure"] == "angle random walk"}
    more = gj.predict(changed(bench.spec, {"sensor.gyro.angle_random_walk": walk(bench.spec, 1.001)}))
    before = bench.predicted("spec.toml")
    assert set(found) == set(before)
    for row in more.requirements:
        assert np.log(row.decisive / before[row.name]) / np.log(1.001) == pytest.approx(found[row.name], abs=0.01)


def walk(spec: gj.Spec, factor: float) -> str:
    """So many times the spec's angle random walk."""
    return f"{float(spec.sensor.gyro.angle_random_walk) * factor * 60.0 * 180.0 / np.pi:.12g} deg/sqrt(h)"


@CHECKS.of("ranges of noise figures")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    for row in answers[0].rows.values():
        low, high = row["uncertain"]
        assert low < (row["another_run"] or row["with_typical"]) < high


@CHECKS.of("lower limit of all plans")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    plan = bench.predicted("spec.toml")
    found = {row["name"]: row for row in answers[0].json}
    assert set(found) == set(plan)
    for name, row in found.items():
        assert 0.0 < row["certified"] <= row["value"] == pytest.approx(plan[name])


@CHECKS.of("comparison of plans")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    short, long = answers[0].json
    assert (short["duration_s"], long["duration_s"]) == pytest.approx((bench.spec.schedule.duration, 500.0))
    for a, b in zip(short["requirements"], long["requirements"], strict=True):
        assert named(b) < named(a)


@CHECKS.of("Monte Carlo")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = answers[0].json["monte_carlo"]
    assert found["runs"] == 400
    assert len(found["requirements"]) == len(bench.spec.requirement)
    for row in found["requirements"]:
        assert row["simulated"] == pytest.approx(row["predicted"], rel=0.15)
    assert all(test["consistent"] for test in found["covariance"].values())


@CHECKS.of("plots")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    assert answers[0].status == 0
    assert drawn(bench.folder / "plan.png")


@CHECKS.of("hidden structure (discrepancy)")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    assert share(answers[0].out, "model discrepancy") > 50
    assert bench.predicted("hidden.toml")["scale factor"] > 1.5 * bench.predicted("spec.toml")["scale factor"]


@CHECKS.of("tests that notice structure")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = {(row["quantity"], row["axis"]): row for row in answers[0].json["notices"]}
    for axis in bench.gyros:
        row = found["scale_factor", axis]
        assert row["unit"] == "ppm"
        assert row["components"] > 0
        assert 0.0 < row["sure_from"] < 20_000.0


@CHECKS.of("scale-factor instability")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    assert share(answers[0].out, "scale-factor instability") > 50
    assert 150.0 < bench.predicted("unsteady.toml")["scale factor"] < 600.0


@CHECKS.of("readings on the move")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    still = gj.predict(changed(read_spec(bench.folder / "moving.toml"), still_turns(bench)))
    best = "force" if bench.of_imu else "bias"
    (left,) = (row.decisive for row in still.requirements if row.name == best)
    assert named(answers[0].rows[best]) < left
    times = np.array([reading["time"] for reading in answers[1].json["readings"]])
    turn = next(part for part in answers[1].json["segments"] if part["shape"] == "linear ramps")
    inside = (times > turn["start"] + 1e-6) & (times < turn["start"] + turn["duration"] - 1e-6)
    assert len(np.unique(times[inside])) == 18


def still_turns(bench: FeatureBench) -> dict[str, object]:
    """Changes that leave out the readings on the move."""
    keys: dict[str, object] = {"sensor.accelerometer.read_on_moves_below": None} if bench.of_imu else {}
    moves = tables_of(read_spec(bench.folder / "moving.toml"))["plan"]["cycle"]["moves"]
    slow = [k for k, move in enumerate(moves) if move.get("shape") == "linear ramps"]
    assert len(slow) == 2
    return keys | {f"plan.cycle.moves[{k}].read_every": None for k in slow}


@CHECKS.of("missions and north")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = answers[0].rows
    for name in ("heading", "north"):
        assert found[name]["unit"] == "deg"
        assert found[name]["own"] > 0.0
    (mission,) = found["heading"]["missions"]
    assert (mission["file"], mission["after_s"]) == ("mission.csv", 300.0)
    assert mission["left"] == pytest.approx(named(found["heading"]))


@CHECKS.of("heating and cooling in one plan")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = answers[0].rows
    assert list(found) == ["bias", "heating", "cooling"]
    assert min(named(found[name]) for name in ("heating", "cooling")) > named(found["bias"])
    plays = {row["name"]: row["std"] for row in answers[0].json["parameters"]}
    for axis in bench.gyros:
        # The plan observes the loop, whose prior is 20 deg/h for each K.
        assert np.degrees(plays[f"gyro_{axis}.hysteresis_3K"]) * 3600.0 < 1.0


@CHECKS.of("standard method (held rates)")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    assert answers[0].json["soak_s"] == 1200.0
    assert 0.0 < named(answers[0].rows["scale factor"]) < 10.0
    assert "plan: standard method" in answers[1].out
    assert "-200, -60, 60, 200 deg/s" in answers[1].out


@CHECKS.of("derivatives in Python")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    """Of an IMU, whose function is of its cycle alone, about a per cent of `predict`; the derivative is its own."""
    residual = gj.differentiable(bench.spec)
    name = "peak rates" if bench.of_imu else "angle random walk"
    own = jnp.asarray(residual.quantities[name])

    @jax.jit
    def left(factor):
        return residual({name: own * factor})["bias"]

    value, slope = jax.jit(jax.value_and_grad(left))(1.0)
    tolerance = 0.02 if bench.of_imu else 1e-9
    assert float(value) == pytest.approx(bench.predicted("spec.toml")["bias"], rel=tolerance)
    up, down = (float(left(factor)) for factor in (1.0 + 1e-4, 1.0 - 1e-4))
    assert float(slope) == pytest.approx((up - down) / 2e-4, rel=1e-3)
    assert slope != 0.0


# --------------------------------------------------------------------------------------------------------- better plans


@CHECKS.of("optimisation up to the targets")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    start, now = (bench.predicted(f"{name}.toml")["scale factor"] for name in ("better", "met"))
    target = read_spec(bench.folder / "better.toml").requirement[0].target
    assert "every target is met with a margin of 10%" in answers[0].json["sentence"]
    # (A ratio in the spec, ppm in predictions.)
    assert start > 0.9e6 * float(target) > now


@CHECKS.of("optimisation")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    start, now = (bench.predicted(f"{name}.toml") for name in ("spec", "optimum"))
    assert answers[0].json["gain"] > 1.5
    assert now["scale factor"] < 0.5 * start["scale factor"]
    kept = read_recipe(bench.folder / "optimum.toml").prediction.requirements
    assert {row.name: row.decisive for row in kept} == pytest.approx(now)


@CHECKS.of("optimisation for a mission")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    start, now = (bench.predicted(f"{name}.toml")["heading"] for name in ("missions", "heading"))
    assert now == pytest.approx(answers[0].json["now"])
    assert now < 0.97 * start


@CHECKS.of("optimisation of a plan that notices structure")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    start, now = (bench.predicted(f"{name}.toml")["scale factor"] for name in ("seeing", "seen"))
    assert now < start
    notices = [row for row in read_recipe(bench.folder / "seen.toml").prediction.notices if row.power is not None]
    assert {row.axis for row in notices} == set(bench.gyros)
    assert all(row.power >= 0.9 for row in notices)


@CHECKS.of("shortest plan")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = read_recipe(bench.folder / "shortest-recipe.toml").prediction
    assert found.motion_s < 0.8 * bench.spec.schedule.motion
    assert [row.verdict for row in found.requirements] == ["met"] * len(found.requirements)


@CHECKS.of("residual against duration")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    short, long = answers[0].json["points"]
    assert (short["motion_s"], long["motion_s"]) == (240.0, 360.0)
    assert long["residual"] < short["residual"]
    made = [read_recipe(bench.folder / "frontier" / f"{name}.toml").prediction for name in ("4min", "6min")]
    assert [one.motion_s for one in made] == pytest.approx([240.0, 360.0], abs=1.0)


@CHECKS.of("sweep of predictions")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    assert (answers[0].json["points"], answers[0].json["failed"]) == (4, 0)
    results = read_dataset(bench.folder / "sweep.nc")["scale_factor_mean_of_max"]
    assert results.attrs["units"] == "ppm"
    for name in ("spec.toml", "noisier.toml"):
        spec = changed(read_spec(bench.folder / name), {"plan.gradient": "2 K/min"})
        left = float(results.sel(sensor=name, gradient=2.0))
        assert left == pytest.approx(gj.predict(spec).requirements[0].decisive)


@CHECKS.of("sweep of optimised plans")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    assert (answers[0].json["points"], answers[0].json["failed"]) == (2, 0)
    left = [read_recipe(path).prediction.requirements[0].decisive for path in (bench.folder / "designs").glob("*.toml")]
    before = [bench.predicted(name)["scale factor"] for name in ("spec.toml", "noisier.toml")]
    assert all(now < then for now, then in zip(sorted(left), sorted(before), strict=True))


@pytest.mark.usefixtures("without_prices")
@pytest.mark.parametrize(("name", "kind"), CHECKS.cells())
def test_a_feature_of_plans_is_there_for_both(name, kind, kinds) -> None:
    CHECKS[name](kinds[kind], kinds[kind].done(name))
