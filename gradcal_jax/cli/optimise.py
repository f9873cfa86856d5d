"""`gradcal optimise`: the plan of least residual within the limits of sensor, rig and time, for several times
(`--motion`), for the rest of a run, or as it is (`--steps 0`), as a recipe."""

import math
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Final

from cyclopts import Parameter

from gradcal_jax.cli.output import (
    DONE,
    INTERRUPTED,
    NOT_AS_WISHED,
    Flag,
    Force,
    Json,
    Plot,
    as_json,
    complain,
    drawable,
    save_figure,
    strong,
    writable,
)
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.tables.display import amount, columns
from gradcal_jax.units import parse, time_text

if TYPE_CHECKING:
    from gradcal_jax.design.optimise import FrontierPoint
    from gradcal_jax.design.searching import Optimised, SearchStep
    from gradcal_jax.recipe.tracks import Stability
    from gradcal_jax.spec.spec_sections import Spec


def optimise(
    spec: Path,
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)] = None,
    json: Json = False,
    plot: Plot = None,
    steps: int | None = None,
    quick: Flag = False,
    until_met: Flag = False,
    resume: Flag = False,
    motion: str | None = None,
    points: int | None = None,
    keep_shapes: Flag = False,
    stable_within: str | None = None,
    stable_for: str | None = None,
    timeout: str | None = None,
    time: str | None = None,
    pause: str | None = None,
    force: Force = False,
) -> int:
    """Minimise the error that a plan leaves, within the limits of sensor, rig and time; write the new plan as a recipe.

    The search is by gradient descent. For one gyro along the only axis of a table, [design] in the spec states the
    objective and the parts of the plan that may change. For any other IMU, the search changes the turns, poses, rates
    and rests of many cycles. If the spec has a hysteresis, the search also changes the legs, turning points and slopes
    of the temperature programme. After Ctrl-C, the search ends and writes the best plan so far; a second Ctrl-C stops
    at once. The exit status is 1 if the search did not converge.

    If SPEC is the folder of an interrupted run, plan its remaining part: every prediction includes the data of the part
    that was executed, and the temperature ramp begins where the chamber stopped. The IMU must not have been switched
    off since the interruption, because both parts are assumed to have the same turn-on bias. To continue the run:
    gradcal run NEW --resume RUN.

    The figures of a recipe are rounded to the controllers' steps in [rig.resolution] of the spec. The default steps are
    0.1 K, 0.1 s, 0.01 deg/s and 0.001 deg; temperature slopes are always rounded to 0.01 K/min. `gradcal check` prints
    a recipe as a table.

    Parameters
    ----------
    spec
        The spec file, a recipe, or the folder of an interrupted run.
    output
        The recipe file to write; with --motion, the folder for the recipes (optional). With --steps 0, "-" prints the
        recipe instead.
    json
        Print the result for other programs.
    plot
        Draw the errors before and after the search (with --motion, the errors for each duration) into this file (.png,
        .svg, .pdf).
    steps
        Number of iterations from each start, by default 240; if the search changes poses, the total number of
        gradients, by default 14000 (some minutes). 0: write the plan in the spec as a recipe, without a search.
    quick
        Use only a few starts or gradients; this takes seconds, and the result is within a few per cent of the best.
    until_met
        Stop at the first plan that meets every target with a margin of 10 %. If the plan in the spec already meets
        them, do not search.
    resume
        Continue an interrupted search of the same spec; the state of the search is saved next to the output.
    motion
        Find the best residual for each of these durations (not counting soaks), and the shortest plan for each target:
        50min..300min, or a list such as 60min,100min,3h.
    points
        If --motion is a range: the number of durations in it, including both ends, with logarithmic spacing; by default
        5.
    keep_shapes
        Keep the shapes of the turns, for a table that can follow any shape; by default, every turn in the recipe is a
        trapezoid.
    stable_within
        When a step of the recipe waits for a stable temperature, the temperature must stay within this tolerance of its
        goal, such as "0.5 K".
    stable_for
        The time for which the temperature must stay within the tolerance, such as "5 min".
    timeout
        If the first temperature of the recipe is not stable after this time, such as "4 h", the run ends.
    time
        For an interrupted run: the duration of its remaining part, not counting waits for stable temperatures, such as
        "40 min"; by default the remaining time of the recipe.
    pause
        For an interrupted run: the time between its interruption and its continuation, by default "30 min"; the drifts
        continue through this pause.
    """
    drawable(plot)
    if (steps is not None and 0 < steps < 20) or (steps or 0) < 0:
        raise ValueError(f"--steps: expected 0 (write the plan in the spec as a recipe) or at least 20; got {steps}")
    of_recipe = {"--keep-shapes": keep_shapes, "--stable-within": stable_within, "--stable-for": stable_for}
    of_recipe |= {"--timeout": timeout}
    of_search = {"--until-met": until_met, "--resume": resume}
    if spec.is_dir():
        others = {"--steps": steps, "--motion": motion, "--points": points, "--plot": plot}
        _refuse("if SPEC is the folder of a run", of_recipe | of_search | others)
        if output is None:
            raise ValueError("name the recipe to write, such as -o rest.toml")
        writable(output, force)
        return plan_the_rest(spec, output, time=time, pause=pause or "30 min", quick=quick, json=json)
    specification = _read(spec)
    _refuse("unless SPEC is the folder of a run", {"--time": time, "--pause": pause})
    if motion is not None:
        _refuse("with --motion", of_recipe | of_search | {"--quick": quick})
        times = durations(motion, 5 if points is None else points)
        use_float64()
        return show_frontier(specification, str(spec), times, output, steps, json=json, plot=plot)
    _refuse("without --motion", {"--points": points})
    if steps == 0:
        _refuse("with --steps 0", of_search | {"--quick": quick, "--plot": plot})
    if output is None:
        raise ValueError("name the recipe to write, such as -o recipe.toml")
    stability = stability_of(
        {
            "within": ("temperature difference", stable_within),
            "for_at_least": ("time", stable_for),
            "first_timeout": ("time", timeout),
        }
    )
    if str(output) != "-":
        writable(output, force or resume)
    elif steps != 0 or json:
        raise ValueError("-o - prints the recipe: use this option with --steps 0, and without --json")
    use_float64()
    if steps == 0:
        write_recipe(specification, output, stability, keep_shapes=keep_shapes, json=json)
        return DONE
    from gradcal_jax.design import searching
    from gradcal_jax.design.searching import record_of
    from gradcal_jax.information import prediction
    from gradcal_jax.tables.writing import write_toml

    kept = output.with_name(output.name + ".search.npz")
    checkpoint = searching.read_checkpoint(kept, specification) if resume else None
    best, interrupted = search_and_watch(
        specification, kept, steps=steps, quick=quick, until_met=until_met, checkpoint=checkpoint
    )
    status = best.sentence if not interrupted else f"interrupted; the best plan so far: {best.sentence}"
    result = prediction.make_recipe(best, status=status, stability=stability, keep_shapes=keep_shapes)
    write_toml(result, output, header="Made by gradcal optimise; `gradcal check` prints it as a table.")
    if not interrupted:
        kept.unlink(missing_ok=True)
    if json:
        print(as_json(record_of(best) | {"status": status, "recipe": str(output)}))
    else:
        print(optimum_text(best))
        print(f"wrote {output}; read it with: gradcal check {output}")
    drawn = [("before", specification), ("optimised", best.spec)]
    save_figure(lambda plots: plots.draw_comparison(drawn), plot, quiet=json)
    if interrupted:
        again = f"; to continue: gradcal optimise {spec} -o {output} --resume" if kept.exists() else ""
        complain(f"interrupted{again}")
        return INTERRUPTED
    return DONE if best.converged else NOT_AS_WISHED


def _read(path: Path) -> "Spec":
    """The spec in a file or recipe; moves beyond the table's travel are made to fit."""
    import tomllib

    from gradcal_jax.recipe.recipe import spec_in
    from gradcal_jax.spec.mission import missions_from
    from gradcal_jax.spec.spec import spec_of
    from gradcal_jax.spec.travel import lies_in_travel, within_travel
    from gradcal_jax.tables.problems import SpecError

    try:
        return spec_in(path)
    except SpecError as error:
        if not lies_in_travel(error):
            raise
        with missions_from(path.parent):
            mended = spec_of(within_travel(tomllib.loads(path.read_text(encoding="utf-8"))), str(path))
        complain(
            f"{error}\n"
            "The search starts from a plan in which these moves were changed to fit: turns go in the other direction, "
            "or only as far as the travel allows; a start angle beyond the travel is moved to its end; and a last turn "
            "goes back to the start angle."
        )
        return mended


def _refuse(where: str, options: Mapping[str, object]) -> None:
    """Raise `ValueError` for stated options without an effect."""
    if given := [name for name, value in options.items() if value is not None and value is not False]:
        raise ValueError(f"{', '.join(given)}: no effect {where}; leave {'it' if len(given) == 1 else 'them'} out")


def search_and_watch(
    spec: "Spec", kept: Path | None = None, *, quick: bool = False, **options: Any
) -> tuple["Optimised", bool]:
    """The best plan, with a line of progress; and whether Ctrl-C ended the search. `kept`: file of its checkpoints;
    `options`: of `optimise.optimise.run_search`."""
    from gradcal_jax.design import searching
    from gradcal_jax.design.optimise import run_search
    from gradcal_jax.design.searching import Optimised

    best: Optimised | None = None
    of_spec = "" if kept is None else searching.fingerprint(spec)
    with _Interrupt() as interrupt, MovingLine(sys.stderr) as line:
        if not spec.turns_one_gyro:
            line.show("compiling the objective and its gradient: 10 to 30 s")
        for event in run_search(spec, quick=quick, stop=lambda: interrupt.asked, **options):
            if isinstance(event, Optimised):
                best = event
                continue
            if kept is not None and event.checkpoint:
                searching.write_checkpoint(kept, of_spec, event.checkpoint)
            line.show(progress_of(event), event.share, number=amount(event.best, event.unit))
    assert best is not None
    return best, interrupt.asked


def optimum_text(best: "Optimised") -> str:
    """An optimised plan as text."""
    from gradcal_jax.design.turn_search import belief_of

    before = "not observable with the plan in the spec" if best.before is None else amount(best.before, best.unit)
    lines = [
        strong(f"{best.name}: {before} -> {amount(best.now, best.unit)} (rounded to the controllers' steps)"),
        f"{best.structure}; {amount(best.optimum, best.unit)} before rounding",
        best.sentence,
    ]
    if len(best.starts) > 1:
        kept = [value for value in best.starts if value < math.inf]
        those = f"{len(best.starts)} starts"
        if len(kept) < len(best.starts):
            those = f"{len(kept)} of {those} met the limits and" if kept else f"none of {those} met the limits"
        lines.append(those + (f" ended between {kept[0]:.4g} and {kept[-1]:.4g} {best.unit}" if kept else ""))
    if belief := belief_of(best.spec):
        lines.append(belief)
    if best.active:
        lines.append("limits that restrict the plan: " + "; ".join(best.active))
    if best.prices:
        rows = [("if this limit is relaxed by", "the residual changes by", "proportionally up to")]
        for p in best.prices:
            # One unit may be more than the range in which the price holds.
            by = 1.0 if p.linear is None else min(p.linear, 1.0)
            most = "" if p.linear is None else f"{p.linear:g} {p.per}"
            changes = f"{p.change * by:+.3g} {best.unit}" if p.change else "nothing"
            rows.append((f"{by:g} {p.per} of {p.limit}", changes, most))
        lines += ["", columns(rows, indent="")]
    if len(best.rows) > 1:
        shown = [(row.name, amount(row.before, row.unit), amount(row.now, row.unit)) for row in best.rows]
        lines += ["", columns([("requirement", "before", "now"), *shown], indent="")]
    return "\n".join(lines)


def progress_of(step: "SearchStep") -> str:
    """The progress of a search, in one line."""
    before = "" if step.before is None else f"{step.before:.4g} -> "
    missed = f", but {step.missed}" if step.missed else ""
    return f"{step.share:4.0%}  {step.name}: {before}{amount(step.best, step.unit)}{missed}  ({step.words})"


class _Interrupt:
    """The first Ctrl-C requests a stop, the second stops at once."""

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> "_Interrupt":
        self._before = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self.asked = True
        complain("stopping with the best plan so far; Ctrl-C again stops at once")
        signal.signal(signal.SIGINT, signal.default_int_handler)


def plan_the_rest(run: Path, output: Path, *, time: str | None, pause: str, quick: bool, json: bool) -> int:
    """Search for the best plan of the rest of an interrupted run, and write it as a recipe. The part that was done by
    the journal counts in every prediction. `time`, `pause`: options of the command."""
    from gradcal_jax.hardware.run_folder import RunFolder, prepare_resume, stretches_of
    from gradcal_jax.tables.writing import write_toml

    folder = RunFolder(run)
    left_s, pause_s = None if time is None else parse(time, "time"), parse(pause, "time")
    prepare_resume(folder)
    recipe = folder.recipe()
    done = stretches_of(folder)
    use_float64()
    from gradcal_jax.design.optimise import rest_of
    from gradcal_jax.design.searching import record_of
    from gradcal_jax.information import prediction

    spans = [(part.start_s, part.end_s) for part in done]
    rest = rest_of(recipe.spec, spans, left_s=left_s, pause_s=pause_s)
    best, interrupted = search_and_watch(rest, quick=quick)
    status = f"interrupted; the best plan so far: {best.sentence}" if interrupted else ""
    code = INTERRUPTED if interrupted else DONE if best.converged else NOT_AS_WISHED
    seconds = sum(end - begin for begin, end in spans)
    remark = f"after {time_text(float(round(seconds)))} with data; the prediction includes these data"
    notes = (f"a plan for the remaining part of a run, {remark}",)
    result = prediction.make_recipe(best, stability=recipe.stability, status=status, notes=notes)
    write_toml(result, output, header="Made by gradcal optimise; `gradcal check` prints it as a table.")
    if json:
        print(as_json(record_of(best) | {"done": spans, "recipe": str(output)}))
    else:
        print(optimum_text(best))
        print(
            f"wrote {output}, a plan for the remaining part, {remark}; next step: gradcal run {output} --resume {run}"
        )
    return code


_HEADER: Final = (
    "Made by gradcal; `gradcal check` prints it as a table. To change the plan, change the spec and make the "
    "recipe again."
)


def stability_of(wishes: Mapping[str, tuple[str, str | None]]) -> "Stability":
    """When a temperature counts as stable: for each key the kind of quantity, and its text or None."""
    from gradcal_jax.recipe.tracks import Stability
    from gradcal_jax.tables.quantity import Quantity

    given = {name: Quantity.read(text, kind) for name, (kind, text) in wishes.items() if text is not None}
    return Stability.model_validate(given)


def write_recipe(spec: "Spec", output: Path, stability: "Stability", *, keep_shapes: bool, json: bool) -> None:
    """Write the recipe of a spec's own plan, or print it for the name "-"."""
    from gradcal_jax.information import prediction
    from gradcal_jax.tables.writing import to_toml

    result = prediction.make_recipe(spec, stability=stability, keep_shapes=keep_shapes)
    text = to_toml(result, header=_HEADER)
    if str(output) == "-":
        print(text, end="")
        return
    from gradcal_jax.tables.writing import write_whole

    write_whole(output, text)
    if json:
        rows = [row.model_dump() for row in result.prediction.requirements]
        record = {"recipe": str(output), "fingerprint": result.fingerprint, "requirements": rows}
        print(as_json(record | {"rounded": list(result.rounded), "notes": list(result.notes)}))
        return
    for note in result.notes:
        print(f"note: {note}")
    if result.rounded:
        print(f"rounded {len(result.rounded)} keys of the plan to the controllers' steps; the recipe lists them")
    print(f"wrote {output}; read it with: gradcal check {output}")


def show_frontier(
    spec: "Spec",
    source: str,
    times: list[float],
    output: Path | None,
    steps: int | None,
    *,
    json: bool,
    plot: Path | None,
) -> int:
    """Search for a plan of each duration of the ramp (s), with a line of progress; print them, and the shortest plan
    for each target. `output`: a folder for their recipes."""
    from gradcal_jax.design import optimise as room
    from gradcal_jax.information import prediction, verdicts
    from gradcal_jax.tables.writing import write_toml

    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
    reached: list[FrontierPoint] = []

    def show(motion: float, step: "SearchStep") -> None:
        best = amount(step.best, step.unit)
        line.show(f"{time_text(motion)}: {step.share:4.0%}  {best}", number=(motion, best))

    with MovingLine(sys.stderr) as line:
        for point in room.frontier_points(spec, times, steps=steps, watch=show):
            reached.append(point)
            if output is not None and point.plan is not None:
                write_toml(prediction.make_recipe(point.plan), output / f"{point.motion / 60.0:.4g}min.toml")
    targets = {
        r.name: limit[1]
        for r in spec.requirement
        if (limit := verdicts.limit_of(r)) is not None
        and limit[0] == r.statistic
        and spec.design
        and r.name == spec.design.minimise
    }
    times_for = {name: room.shortest(reached, target) for name, target in targets.items()}
    if json:
        rows = [
            {
                "motion_s": p.motion,
                "residual": None if p.plan is None else p.plan.now,
                "unit": None if p.plan is None else p.plan.unit,
                "converged": p.plan is not None and p.plan.converged,
                "sentence": p.reason,
            }
            for p in reached
        ]
        print(as_json({"points": rows, "shortest_s": times_for}))
    else:
        print(strong(spec.title or source))
        shown = [("ramp", "residual", "search")]
        for p in reached:
            residual = "none" if p.plan is None else amount(p.plan.now, p.plan.unit)
            shown.append((time_text(p.motion), residual, p.reason))
        print(columns(shown, indent=""))
        for name, target in targets.items():
            time = times_for[name]
            far = "is not reached within these durations"
            result = far if time is None else f"needs a ramp of about {time_text(time)}"
            print(f"{name} at {target:.4g} {next((p.plan.unit for p in reached if p.plan), '')} {result}")
    save_figure(lambda plots: plots.draw_frontier(reached, targets), plot, quiet=json)
    return DONE if all(p.plan is not None and p.plan.converged for p in reached) else NOT_AS_WISHED


def durations(text: str, points: int) -> list[float]:
    """Durations in s of "50min..300min" or "60min,100min". Errors: `ValueError` that says what was expected."""
    from gradcal_jax.tables.quantity import Quantity

    def one(part: str) -> float:
        value = float(Quantity.read(part.strip(), "time"))
        if value <= 0.0:
            raise ValueError(f"--motion: {part.strip()!r} is not a duration")
        return value

    if ".." in text:
        ends = text.split("..")
        if len(ends) != 2 or points < 2:
            raise ValueError(f"--motion: expected a range such as 50min..300min with 2 points or more, got {text!r}")
        low, high = one(ends[0]), one(ends[1])
        if low >= high:
            raise ValueError(f"--motion: {text!r}: the second duration must be longer than the first")
        return [low * (high / low) ** (k / (points - 1)) for k in range(points)]
    return sorted(one(part) for part in text.split(","))
