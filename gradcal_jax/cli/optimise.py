"""`gradcal optimise`: the plan of least residual within the limits of sensor, rig and time, for several times
(`--motion`), or as it is (`--steps 0`), as a recipe."""

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
from gradcal_jax.tables.display import amount
from gradcal_jax.tables.table import Table
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.design.optimise import FrontierPoint, Optimised, SearchStep
    from gradcal_jax.spec.spec_sections import Spec


def optimise(
    spec: Path,
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)] = None,
    json: Json = False,
    plot: Plot = None,
    steps: int | None = None,
    until_met: Flag = False,
    motion: str | None = None,
    force: Force = False,
) -> int:
    """Minimise the error that a plan leaves, within the limits of sensor, rig and time; write the new plan as a recipe.

    The search is by gradient descent. For one gyro along the only axis of a table, [design] in the spec states the
    objective and the parts of the plan that may change. For any other IMU, the search changes the turns, poses, rates
    and rests of many cycles. If the spec has a hysteresis, the search also changes the legs, turning points and slopes
    of the temperature programme. After Ctrl-C, the search ends and writes the best plan so far; a second Ctrl-C stops
    at once. The exit status is 1 if the search did not converge.

    The figures of a recipe are rounded to the controllers' steps in [rig.resolution] of the spec. The default steps are
    0.1 K, 0.1 s, 0.01 deg/s and 0.001 deg; temperature slopes are always rounded to 0.01 K/min. `gradcal check` prints
    a recipe as a table.

    Parameters
    ----------
    spec
        The spec file, or a recipe.
    output
        The recipe file to write; with --motion, the folder for the recipes (optional). With --steps 0, "-" prints the
        recipe instead.
    json
        Print the result for other programs.
    plot
        Draw the errors before and after the search (with --motion, the errors for each duration) into this file (.png,
        .svg, .pdf).
    steps
        Number of gradients in all, by default 14000, of a single axis 4500 (some minutes); with a tenth of them, the
        result is within a few per cent of the best. 0: write the plan in the spec as a recipe, without a search.
    until_met
        Stop at the first plan that meets every target with a margin of 10 %. If the plan in the spec already meets
        them, do not search.
    motion
        Find the best residual for each of these durations (not counting soaks), and the shortest plan for each target:
        50min..300min (five durations, with logarithmic spacing), or a list such as 60min,100min,3h.
    """
    drawable(plot)
    if (steps is not None and 0 < steps < 20) or (steps or 0) < 0:
        raise ValueError(f"--steps: expected 0 (write the plan in the spec as a recipe) or at least 20; got {steps}")
    from gradcal_jax.recipe.recipe import spec_in

    specification = spec_in(spec)
    if motion is not None:
        _refuse("with --motion", {"--until-met": until_met})
        times = durations(motion)
        use_float64()
        return show_frontier(specification, str(spec), times, output, steps, json=json, plot=plot)
    if steps == 0:
        _refuse("with --steps 0", {"--until-met": until_met, "--plot": plot})
    if output is None:
        raise ValueError("name the recipe to write, such as -o recipe.toml")
    if str(output) != "-":
        writable(output, force)
    elif steps != 0 or json:
        raise ValueError("-o - prints the recipe: use this option with --steps 0, and without --json")
    use_float64()
    if steps == 0:
        write_recipe(specification, output, json=json)
        return DONE
    from gradcal_jax.design.optimise import record_of
    from gradcal_jax.design.recipe_of_plan import make_recipe
    from gradcal_jax.tables.writing import write_toml

    best, interrupted = search_and_watch(specification, steps=steps, until_met=until_met)
    status = best.sentence if not interrupted else f"interrupted; the best plan so far: {best.sentence}"
    result = make_recipe(best, status=status)
    write_toml(result, output, header="Made by gradcal optimise; `gradcal check` prints it as a table.")
    if json:
        print(as_json(record_of(best) | {"status": status, "recipe": str(output)}))
    else:
        print(optimum_text(best))
        print(f"wrote {output}; read it with: gradcal check {output}")
    drawn = [("before", specification), ("optimised", best.spec)]
    save_figure(lambda plots: plots.draw_comparison(drawn), plot, quiet=json)
    if interrupted:
        complain("interrupted")
        return INTERRUPTED
    return DONE if best.converged else NOT_AS_WISHED


def _refuse(where: str, options: Mapping[str, object]) -> None:
    """Raise `ValueError` for stated options without an effect."""
    if given := [name for name, value in options.items() if value is not None and value is not False]:
        raise ValueError(f"{', '.join(given)}: no effect {where}; leave {'it' if len(given) == 1 else 'them'} out")


def search_and_watch(spec: "Spec", **options: Any) -> tuple["Optimised", bool]:
    """The best plan, with a line of progress; and whether Ctrl-C ended the search. `options`: of
    `design.optimise.run_search`."""
    from gradcal_jax.design.optimise import Optimised, run_search

    best: Optimised | None = None
    with _Interrupt() as interrupt, MovingLine(sys.stderr) as line:
        line.show("compiling the objective and its gradient: 10 to 30 s")
        for event in run_search(spec, stop=lambda: interrupt.asked, **options):
            if isinstance(event, Optimised):
                best = event
            else:
                line.show(progress_of(event), event.share, number=amount(event.best, event.unit))
    assert best is not None
    return best, interrupt.asked


def optimum_text(best: "Optimised") -> str:
    """An optimised plan as text."""
    from gradcal_jax.design.optimise import belief_of

    before = "not observable with the plan in the spec" if best.before is None else amount(best.before, best.unit)
    head = f"{best.name}: {before} -> {amount(best.now, best.unit)} (rounded to the controllers' steps)"
    lines = [strong(head), best.structure, best.sentence, belief_of(best.spec)]
    if len(best.rows) > 1:
        rows = [(row.name, amount(row.before, row.unit), amount(row.now, row.unit)) for row in best.rows]
        lines.append("\n" + Table.of(["requirement", "before", "now"], rows).text())
    return "\n".join(line for line in lines if line)


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


# Durations of a range.
_POINTS: Final = 5
_HEADER: Final = (
    "Made by gradcal; `gradcal check` prints it as a table. To change the plan, change the spec and make the "
    "recipe again."
)


def write_recipe(spec: "Spec", output: Path, *, json: bool) -> None:
    """Write the recipe of a spec's own plan, or print it for the name "-"."""
    from gradcal_jax.design.recipe_of_plan import make_recipe
    from gradcal_jax.tables.writing import to_toml, write_whole

    result = make_recipe(spec)
    text = to_toml(result, header=_HEADER)
    if str(output) == "-":
        print(text, end="")
        return
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
    from gradcal_jax.design.recipe_of_plan import make_recipe
    from gradcal_jax.information import verdicts
    from gradcal_jax.tables.writing import write_toml

    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
    reached: list[FrontierPoint] = []

    def show(motion: float, step: "SearchStep") -> None:
        best = amount(step.best, step.unit)
        line.show(f"{time_text(motion)}: {step.share:4.0%}  {best}", number=(motion, best))

    with MovingLine(sys.stderr) as line:
        for point in room.frontier(spec, times, steps=steps, watch=show):
            reached.append(point)
            if output is not None and point.plan is not None:
                write_toml(make_recipe(point.plan), output / f"{point.motion / 60.0:.4g}min.toml")
    minimised = None if spec.design is None else spec.design.minimise
    limits = {r.name: verdicts.limit_of(r) for r in spec.requirement if r.name == minimised}
    targets = {name: limit[1] for name, limit in limits.items() if limit is not None}
    times_for = {name: room.shortest(reached, target) for name, target in targets.items()}
    if json:
        print(as_json({"points": [_point(p) for p in reached], "shortest_s": times_for}))
    else:
        print(strong(spec.title or source))
        rows = []
        for p in reached:
            rows.append((time_text(p.motion), None if p.plan is None else amount(p.plan.now, p.plan.unit), p.reason))
        print(Table.of(["ramp", "residual", "search"], rows).text())
        for name, time in times_for.items():
            far = "is not reached within these durations"
            result = far if time is None else f"needs a ramp of about {time_text(time)}"
            unit = next((p.plan.unit for p in reached if p.plan), "")
            print(f"{name} at {targets[name]:.4g} {unit} {result}")
    save_figure(lambda plots: plots.draw_frontier(reached, targets), plot, quiet=json)
    return DONE if all(p.plan is not None and p.plan.converged for p in reached) else NOT_AS_WISHED


def _point(point: "FrontierPoint") -> dict[str, Any]:
    """A duration and its plan for other programs."""
    plan = point.plan
    row = {"motion_s": point.motion, "residual": None, "unit": None, "converged": False, "sentence": point.reason}
    return row if plan is None else row | {"residual": plan.now, "unit": plan.unit, "converged": plan.converged}


def durations(text: str) -> list[float]:
    """Durations in s of "50min..300min" or "60min,100min". Errors: `ValueError` that says what was expected."""
    from gradcal_jax.tables.quantity import Quantity

    first, dots, last = text.partition("..")
    times = [float(Quantity.read(part.strip(), "time")) for part in ([first, last] if dots else text.split(","))]
    if min(times) <= 0.0:
        raise ValueError(f"--motion: expected durations longer than zero, got {text!r}")
    if not dots:
        return sorted(times)
    low, high = times
    if low >= high:
        raise ValueError(f"--motion: {text!r}: the second duration must be longer than the first")
    return [low * (high / low) ** (k / (_POINTS - 1)) for k in range(_POINTS)]
