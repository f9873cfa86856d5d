"""`gradcal optimise`: the plan of least residual within the limits of sensor, rig and time, or as it is (`--steps 0`),
as a recipe."""

import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.output import INTERRUPTED, Force, Json, Output, Switch, complain, show, strong, writable
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.tables.display import amount
from gradcal_jax.tables.table import Table

if TYPE_CHECKING:
    from gradcal_jax.design.optimise import Optimised
    from gradcal_jax.spec.spec_sections import Spec

_HEADER = (
    "Made by gradcal; `gradcal check` prints it as a table. To change the plan, change the spec and make the "
    "recipe again."
)


def optimise(
    spec: Path,
    /,
    *,
    output: Output,
    json: Json = False,
    steps: int | None = None,
    until_met: Switch = False,
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
    a recipe as a table, and `gradcal predict SPEC RECIPE --plot FILE` draws both.

    Parameters
    ----------
    spec
        The spec file, or a recipe.
    output
        The recipe file to write.
    json
        Print the result for other programs.
    steps
        Number of gradients in all, by default 14000, of a single axis 4500 (some minutes). 0: write the plan in the
        spec as a recipe, without a search.
    until_met
        Stop at the first plan that meets every target with a margin of 10 %. If the plan in the spec already meets
        them, do not search.
    """
    from gradcal_jax.recipe.recipe import spec_in

    if steps is not None and steps < 20 and (steps != 0 or until_met):
        raise ValueError(f"--steps: expected at least 20, or 0 to write the plan in the spec as a recipe; got {steps}")
    specification = spec_in(spec)
    writable(output, force)
    use_float64()
    from gradcal_jax.design.optimise import record_of
    from gradcal_jax.design.recipe_of_plan import make_recipe
    from gradcal_jax.tables.writing import write_toml

    best, interrupted, status = None, False, ""
    if steps != 0:
        best, interrupted = search_and_watch(specification, steps=steps, until_met=until_met)
        status = f"interrupted; the best plan so far: {best.sentence}" if interrupted else best.sentence
    result = make_recipe(best or specification, status=status)
    write_toml(result, output, header=_HEADER)
    rows = [row.model_dump(mode="json") for row in result.prediction.requirements]
    record: dict[str, Any] = {"recipe": str(output), "fingerprint": result.fingerprint, "requirements": rows}
    lines = [*([] if best is None else [optimum_text(best)]), *(f"note: {note}" for note in result.notes)]
    lines.append(f"wrote {output}; read it with: gradcal check {output}")
    record |= {"notes": list(result.notes)} | ({} if best is None else record_of(best) | {"status": status})
    done = show("\n".join(lines), record, json=json, wished=best is None or best.converged)
    if interrupted:
        complain("interrupted")
        return INTERRUPTED
    return done


def search_and_watch(spec: "Spec", *, steps: int | None, until_met: bool) -> tuple["Optimised", bool]:
    """The best plan, with a line of progress; and whether Ctrl-C ended the search. Options: of
    `design.optimise.run_search`."""
    from gradcal_jax.design.optimise import Optimised, run_search

    best: Optimised | None = None
    with _Interrupt() as interrupt, MovingLine(sys.stderr) as line:
        compiling = "compiling the objective and its gradient: 10 to 30 s"
        line.show(f"checking the targets; for a search, {compiling}" if until_met else compiling)
        for event in run_search(spec, steps=steps, until_met=until_met, stop=lambda: interrupt.asked):
            if isinstance(event, Optimised):
                best = event
                continue
            before = "" if event.before is None else f"{event.before:.4g} -> "
            missed, now = f", but {event.missed}" if event.missed else "", amount(event.best, event.unit)
            text = f"{event.share:4.0%}  {event.name}: {before}{now}{missed}  ({event.words})"
            line.show(text, event.share, number=now)
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
