"""A whole unit's run that was broken off: what is known by what was done, and the plan of the rest."""

import json
from pathlib import Path

import numpy as np
import pytest
from imu_bench import estimated, made, short, stopped_in_its_second_cycle
from scipy.stats import chi2

from gradcal_jax.cli import main
from gradcal_jax.design.optimise import known_so_far, rest_of, with_done
from gradcal_jax.design.plan_limit import limit
from gradcal_jax.design.turn_plan import motion_time
from gradcal_jax.hardware.run_folder import RunFolder, RunFolderError, adopt, stretches_of
from gradcal_jax.information import imu_system, prediction, whiten
from gradcal_jax.model.imu_build import build_imu, executed_motion, executed_parts, imu_posterior
from gradcal_jax.motion import TableMotion, TablePart, body_nodes
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.records import run_log
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.problems import SpecError


@pytest.fixture(scope="module")
def spec() -> Spec:
    return short(4)


def gram(spec: Spec, motion: TableMotion) -> np.ndarray:
    built = build_imu(spec)
    rows = np.asarray(whiten(*imu_system(motion, built.model, body_nodes(motion, built.points))))
    return rows.T @ rows


def executed(spec: Spec, start_s: float, end_s: float) -> TablePart | None:
    plan = tables_of(spec)["plan"]
    done = [{"plan": plan, "start": f"{start_s} s", "end": f"{end_s} s"}]
    return next((part for part, _ in executed_parts(changed(spec, {"done": done}))), None)


def test_of_a_table_that_is_held_whole_moves_count_and_parts_of_rests(spec: Spec) -> None:
    plan = spec.schedule
    begins, period = plan.stretches[0].start, plan.period
    whole = executed(spec, 0.0, plan.duration)
    assert whole is not None
    times = np.asarray(whole.line.start)
    # In the middle of the second cycle's second rest, and of its second turn.
    number = np.asarray(whole.line.segment)
    second = np.flatnonzero(times >= begins + period - 1e-6)
    rest = second[whole.axis[second] < 0][1]
    cut = float(times[rest] + 0.25 * whole.line.duration[rest])
    part = executed(spec, 0.0, cut)
    assert part is not None
    assert part.line.start[-1] + part.line.duration[-1] == pytest.approx(cut)
    assert part.line.duration[-1] == pytest.approx(0.25 * float(whole.line.duration[rest]))
    turn = second[whole.axis[second] >= 0][-1]
    of_turn = np.flatnonzero(number == number[turn])
    part = executed(spec, 0.0, float(times[of_turn[-1]] + 0.5 * whole.line.duration[of_turn[-1]]))
    assert part is not None
    assert part.line.start[-1] + part.line.duration[-1] == pytest.approx(float(times[of_turn[0]]))
    # The part from there on begins at the angles that were reached.
    later = executed(spec, float(times[of_turn[0]]), plan.duration)
    assert later is not None
    net = [sum(s.move.repeat * s.move.angle for s in plan.steps if s.axis == k) for k in range(len(plan.start))]
    turned = np.where(part.axis[:, None] == np.arange(len(net)), part.line.turned()[:, None], 0.0).sum(axis=0)
    np.testing.assert_allclose(later.start, part.start + turned, atol=1e-9)
    assert executed(spec, float(times[of_turn[0]]), float(times[of_turn[0]]) + 0.01) is None


def test_in_a_pause_every_axis_returns_and_nothing_is_read(spec: Spec) -> None:
    both = rest_of(spec, [(0.0, spec.schedule.stretches[0].start + 1.4 * spec.schedule.period)], pause_s=600.0)
    motion, done = build_imu(both).motion, executed_motion(build_imu(both))
    assert done is not None
    count, axes = done.line.piece_count, motion.geometry.axis_count
    pause = slice(count, count + axes)
    assert np.all(motion.line.gap[pause])
    assert float(motion.line.duration[pause].sum()) == pytest.approx(600.0)
    _, after = motion.angles()
    turns = (after[count + axes - 1] - np.asarray(both.schedule.start)) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)


def test_a_prediction_counts_what_was_done(spec: Spec) -> None:
    """After a pause in which all drifts are forgotten, the information of the parts and of the priors adds up."""
    plan = spec.schedule
    half = plan.stretches[0].start + 2.0 * plan.period
    both, forgotten = rest_of(spec, [(0.0, half)]), rest_of(spec, [(0.0, half)], pause_s=1e5)
    ramp = next(s for s in plan.segments if s.used)
    begins = ramp.temperature_start + ramp.slope * 2.0 * plan.period
    assert both.schedule.segments[0].temperature_start == pytest.approx(begins, abs=0.1)
    assert both.schedule.segments[-1].temperature_end == pytest.approx(ramp.temperature_end, abs=0.11)
    built = build_imu(forgotten)
    rows, done = built.model.prior_rows(), executed_motion(built)
    assert done is not None
    total = rows.T @ rows + gram(spec, done) + gram(spec, build_imu(changed(both, {"done": None})).motion)
    size = np.sqrt(np.diag(total))
    known = imu_posterior(built)
    assert not known.hidden.size
    alike = (known.spread @ known.spread.T) * np.outer(size, size)
    np.testing.assert_allclose(alike @ (total / np.outer(size, size)), np.eye(len(total)), atol=1e-6)
    # It is nearly what the plan would have left, whose drifts go on.
    (now, whole) = (prediction.predict(one).requirements for one in (both, spec))
    for a, b in zip(now, whole, strict=True):
        assert a.decisive is not None
        assert b.decisive is not None
        assert a.decisive == pytest.approx(b.decisive, rel=0.1), a.name


@pytest.mark.parametrize("limit", ["max_motion", "max_total"])
def test_limits_of_the_whole_runs_time_do_not_stretch_the_rest(spec: Spec, limit: str) -> None:
    """[design]'s time is that of the run; the search of the rest has the time that is left."""
    limited = changed(spec, {"design": {"minimise": "worst ratio", limit: f"{spec.schedule.duration:.9g} s"}})
    half = spec.schedule.stretches[0].start + 2.0 * spec.schedule.period
    rest = rest_of(limited, [(0.0, half)])
    assert rest.design is not None
    assert rest.design.minimise == "worst ratio"
    assert rest.schedule.motion == pytest.approx(spec.schedule.duration - half, rel=0.01)
    assert motion_time(rest, rest.design) == rest.schedule.motion


def test_what_is_known_by_now_and_at_the_end(spec: Spec) -> None:
    plan = spec.schedule
    starts, whole = plan.stretches[0].start, prediction.predict(spec).requirements
    # Nothing was done, a cycle is under way, three are done and the fourth is made again.
    found = [
        known_so_far(spec, *at)
        for at in (
            ([], 0.0),
            ([(0.0, starts + 1.4 * plan.period)], starts + 1.4 * plan.period),
            ([(0.0, starts + 3.5 * plan.period)], starts + 3.0 * plan.period),
        )
    ]
    for first, second, third, row in zip(*found, whole, strict=True):
        assert first.at_end == pytest.approx(row.decisive, rel=1e-6)
        assert second.at_end == pytest.approx(row.decisive, rel=1e-6)
        assert row.decisive is not None
        assert second.now is not None
        assert third.now is not None
        assert second.now > third.now > row.decisive
        assert third.at_end == pytest.approx(row.decisive, rel=0.1)
        assert first.now is None or first.now > second.now


def test_what_is_known_of_a_plan_with_several_mountings() -> None:
    """Broken off in the second of three mountings; the run goes on there."""
    several = parse_spec(presets.text("one-axis-table"))
    second = several.schedule.stretches[1]
    now_s = second.start + 2.5 * several.schedule.period
    for found, whole in zip(
        known_so_far(several, [(0.0, now_s)], now_s), prediction.predict(several).requirements, strict=True
    ):
        assert found.at_end == pytest.approx(whole.decisive, rel=1e-6), found.name
        assert found.now is not None
        assert found.at_end is not None
        assert found.now > found.at_end, found.name


def test_what_cannot_be_planned_anew_is_a_sentence(spec: Spec) -> None:
    with pytest.raises(ValueError, match="the ramp is complete"):
        rest_of(spec, [(0.0, spec.schedule.duration)])
    several = parse_spec(presets.text("one-axis-table"))
    with pytest.raises(ValueError, match="several mountings cannot be replanned: continue"):
        rest_of(several, [(0.0, 600.0)])
    with pytest.raises(SpecError, match="expected a time after the start of this part"):
        with_done(spec, [(60.0, 30.0)])
    rest = with_done(spec, [(0.0, spec.schedule.duration)])
    with pytest.raises(ValueError, match="a limit needs a plan that starts a run"):
        limit(rest)


@pytest.mark.long
def test_a_run_goes_on_by_the_plan_of_its_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Stopped in its second cycle of three, the rest searched anew: the estimate of both parts is in its band."""
    recipe, run = made(short(3)), tmp_path / "run"
    stopped_in_its_second_cycle(recipe, run)
    folder = RunFolder(run)
    done = [(part.start_s, part.end_s) for part in stretches_of(folder)]
    monkeypatch.setattr("gradcal_jax.design.optimise.QUICK_EVALUATIONS", 30)
    assert main(["rig", "watch", str(run), "--known", "--json"]) == 0
    known = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert main(["optimise", str(run), "-o", str(tmp_path / "rest.toml"), "--quick", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["gain"] >= 1.0
    again = read_recipe(tmp_path / "rest.toml")
    assert isinstance(again.spec, Spec)
    assert "the geometric mean of all residuals is smaller" in again.status
    for row in said["requirements"]:
        # Before: the same cycle, on a ramp of the time that is left.
        assert row["before"] == pytest.approx(known[row["name"]]["at_end"], rel=0.3), row["name"]
    # Whatever it is, it is another cycle, and what was done stands beside it.
    assert again.spec.plan.cycle != recipe.spec.plan.cycle
    spans = [(float(part.start), float(part.end)) for part in again.spec.done]
    np.testing.assert_allclose(spans, done, atol=1e-6)
    with pytest.raises(RunFolderError, match="does not continue the run"):
        adopt(folder, prediction.make_recipe(changed(again.spec, {"done": None})))
    assert main(["run", str(tmp_path / "rest.toml"), "--resume", str(run), "--json"]) == 0
    log = run_log.log(run)
    assert len(log.stretch_starts) == 2
    hidden = json.loads((run / "hidden_truth.json").read_text(encoding="utf-8"))
    squares, degrees, nees, count = estimated(log, again.spec, hidden["units"]["unit1"] | hidden["installation"])
    assert chi2.ppf(1e-4, degrees) < squares < chi2.ppf(1.0 - 1e-4, degrees)
    assert chi2.ppf(1e-4, count) < nees < chi2.ppf(1.0 - 1e-4, count)
