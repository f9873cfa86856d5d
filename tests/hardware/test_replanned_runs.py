"""A run that was broken off: what its journal proves was done, and the rest of it planned anew."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_bench import short_recipe
from hardware_evidence import record
from scipy.stats import chi2
from test_end_to_end import distance, gradcal

from gradcal_jax.calibration import read_calibration
from gradcal_jax.hardware.execute import resume, run
from gradcal_jax.hardware.journal import Event, JournalContents
from gradcal_jax.hardware.run_folder import SESSION, RunFolder, RunFolderError, adopt, stretches_done, stretches_of
from gradcal_jax.hardware.runner import Runner, RunProgress
from gradcal_jax.hardware.track import Track, TrackStep
from gradcal_jax.recipe.recipe import Recipe, read_recipe
from gradcal_jax.records.run_log import log
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec import read_spec
from gradcal_jax.tables.writing import write_toml

TRACK = Track(
    (TrackStep("soak", 60.0), *(TrackStep(f"cycle {k}", 100.0, follows=k > 1, read_at_s=(0.0,)) for k in (1, 2, 3)))
)


def journal(*events: tuple[float, str, dict[str, Any]]) -> JournalContents:
    begun = (0.0, SESSION, {"number": 0, "wall_clock_s": 0.0, "simulated": True})
    return JournalContents([Event(time_s, name, data) for time_s, name, data in (begun, *events)])


def begins(number: int, at_s: float) -> tuple[float, str, dict[str, Any]]:
    return at_s, "step begins", {"number": number, "begins_s": at_s, "data": number > 0}


def spans(contents: JournalContents, recipe: int = 0) -> list[tuple[float, float]]:
    return [(part.start_s, part.end_s) for part in stretches_done(contents, TRACK, recipe)]


def test_steps_that_follow_are_one_stretch_and_one_that_is_broken_off_counts_as_far_as_it_came() -> None:
    broken = (240.0, "ending", {})
    contents = journal(begins(0, 10.0), (100.0, "step", {}), begins(1, 100.0), (200.0, "step", {}), begins(2, 200.0))
    assert spans(journal(*[(e.time_s, e.name, dict(e.data)) for e in contents.events[1:]], broken)) == [(60.0, 200.0)]
    # Killed: the last that was written is the last that is known.
    late = (230.0, "chamber", {"air_c": 20.0})
    assert spans(journal(*[(e.time_s, e.name, dict(e.data)) for e in contents.events[1:]], late)) == [(60.0, 190.0)]


def test_what_was_made_again_is_counted_twice_and_what_was_not_done_not_at_all() -> None:
    first = (begins(1, 100.0), (150.0, "state", {"state": "paused"}), (900.0, "step", {}), begins(1, 900.0))
    assert spans(journal(*first, (1000.0, "step", {}))) == [(60.0, 110.0), (60.0, 160.0)]
    wrong = (1005.0, "not done", {"number": 1})
    assert spans(journal(*first, (1000.0, "step", {}), begins(2, 1000.0), wrong)) == []
    second = (1005.0, "not done", {"number": 2})
    assert spans(journal(*first, (1000.0, "step", {}), begins(2, 1000.0), second)) == [(60.0, 110.0), (60.0, 160.0)]


def test_another_recipe_of_the_run_is_another_plan() -> None:
    session = (500.0, SESSION, {"number": 1, "wall_clock_s": 500.0, "simulated": True, "recipe": 1})
    contents = journal(begins(1, 100.0), (160.0, "ending", {}), session, begins(1, 600.0), (630.0, "ending", {}))
    assert spans(contents) == [(60.0, 120.0)]
    assert spans(contents, 1) == [(60.0, 90.0)]


def broken_off(made: Recipe, folder: Path, left_s: float, seed: int = 1) -> RunFolder:
    """A simulated run that is aborted with so much of its track left."""
    runners: list[Runner] = []

    def watch(progress: RunProgress) -> None:
        if progress.track_left_s < left_s:
            runners[0].request("abort", "the power failed, as it were")

    result = run(made, folder, simulate=True, seed=seed, with_runner=runners.append, on_progress=watch)
    assert result.exit_status == "aborted"
    return RunFolder(folder)


def rest(made: Recipe, folder: RunFolder, gradient: str = "2 K/min") -> Recipe:
    """The second half of a short recipe, as `replan` would write it but for the search."""
    done = [
        {
            "plan": tables_of(made.spec)["plan"],
            "start": f"{p.start_s:.9g} s",
            "end": f"{p.end_s:.9g} s",
            "pause": "5 min",
        }
        for p in stretches_of(folder)
    ]
    keys = {"done": done, "plan.temperature": ["26 degC", "28 degC"], "plan.gradient": gradient, "plan.soak": None}
    return short_recipe(changes=keys)


def test_a_run_goes_on_by_the_recipe_that_was_made_for_its_rest(tmp_path: Path) -> None:
    made = short_recipe()
    folder = broken_off(made, tmp_path / "run", 60.0)
    (part,) = stretches_of(folder)
    assert part.start_s == 5.0
    assert part.end_s == pytest.approx(made.spec.schedule.duration - 60.0, abs=6.0)
    with pytest.raises(RunFolderError, match="does not continue the run"):
        adopt(folder, made)
    other = changed(rest(made, folder).spec, {"sensor.gyro.angle_random_walk": "0.2 deg/sqrt(h)"})
    with pytest.raises(RunFolderError, match="does not continue the run"):
        adopt(folder, rest(made, folder).model_copy(update={"spec": other}))
    new = rest(made, folder)
    adopt(folder, new)
    assert folder.recipe().fingerprint == new.fingerprint
    assert read_recipe(folder.path / "recipe.toml").fingerprint == made.fingerprint
    assert resume(folder.path).exit_status == "success"
    # Both parts are one run and one log, each by its own recipe.
    whole = log(folder.path)
    assert len(whole.stretch_starts) == 2
    assert whole.provenance["sessions"] == "2"
    (again,) = stretches_of(folder)
    assert (again.start_s, again.end_s) == pytest.approx((0.0, new.spec.schedule.duration))
    assert whole.temperature_c is not None
    assert float(whole.temperature_c.max()) > 26.7
    with pytest.raises(RunFolderError, match="is complete"):
        adopt(folder, new)


DESIGN = """
[design]
minimise = "full range"
free     = ["peak_rate", "duration", "rest"]
starts   = 4
"""
LOST_S = 300.0


@pytest.mark.evidence
def test_the_rest_of_a_broken_run_is_nearly_as_good_as_if_the_loss_had_been_known(tmp_path: Path) -> None:
    """The paper's case, optimised; broken off at 20, 50, 80 % of its ramp, which costs five minutes of the rest."""
    spec, recipe = tmp_path / "spec.toml", tmp_path / "recipe.toml"
    spec.write_text(presets.text("paper-dynamic-gradient") + DESIGN, encoding="utf-8")
    assert gradcal("optimise", spec, "-o", recipe).returncode in (0, 1)
    made = read_recipe(recipe)
    motion_s = made.spec.gradient_schedule.motion
    shorter = {"design.max_motion": f"{motion_s - LOST_S:g} s", "design.starts": 8}
    known = optimum(changed(read_spec(spec), shorter), tmp_path, "known.toml")
    said: list[str] = []
    statistic, degrees = 0.0, 0
    for number, share in enumerate((0.2, 0.5, 0.8)):
        folder = broken_off(made, tmp_path / f"run{number}", (1.0 - share) * motion_s, seed=number)
        left_s = made.spec.schedule.duration - stretches_of(folder)[-1].end_s - LOST_S
        new = tmp_path / f"new{number}.toml"
        made_new = gradcal("optimise", folder.path, "--time", f"{left_s:.1f} s", "-o", new, "--json")
        assert made_new.returncode in (0, 1), made_new.stderr
        found = json.loads(made_new.stdout)["now"]
        # The same rest, searched from twice as many other plans.
        rest_spec = changed(read_recipe(new).spec, {"design.starts": 8, "design.seed": 11})
        best = optimum(rest_spec, tmp_path, f"best{number}.toml")
        assert gradcal("run", new, "--resume", folder.path).returncode == 0
        assert gradcal("log", folder.path).returncode == 0
        calibration = tmp_path / f"calibration{number}.toml"
        estimate = gradcal("estimate", folder.path / "log.nc", "--recipe", new, "-o", calibration)
        assert estimate.returncode in (0, 1), estimate.stderr
        result = read_calibration(calibration)
        truth = json.loads((folder.path / "hidden_truth.json").read_text(encoding="utf-8"))
        one, count = distance(result, truth)
        statistic, degrees = statistic + one, degrees + count
        row = next(row for row in result.result if row.name.startswith("full range"))
        # By what the spec names, as the prediction.
        reached = row.value if row.named is None else row.named
        assert found <= 1.03 * best, (share, found, best)
        assert reached == pytest.approx(found, rel=0.1)
        said.append(
            f"{share:.0%}: {found:.3f} ppm, best of twice as many starts {best:.3f} ({found / best - 1.0:+.1%}), plan "
            f"that knew of it from the start {known:.3f} ({found / known - 1.0:+.1%}), estimate's {reached:.3f}, "
            f"χ² {one:.1f} of {count}"
        )
        (folder.path / "journal").unlink()
    chance = float(chi2.sf(statistic, degrees))
    assert 0.001 < chance < 0.999
    assert np.isfinite(known)
    record(
        "replan after an abort, 5 min lost (headline, simulated)",
        f"{'; '.join(said)}; χ² of the hidden truth together {statistic:.0f} of {degrees} (chance {chance:.2f})",
        "tests/hardware/test_replan.py",
    )


def optimum(spec: Any, folder: Path, name: str) -> float:
    """What is left by the best plan for a spec, in ppm."""
    write_toml(spec, folder / f"spec of {name}")
    found = gradcal("optimise", folder / f"spec of {name}", "-o", folder / name, "--json")
    assert found.returncode in (0, 1), found.stderr
    return float(json.loads(found.stdout)["now"])
