"""`gradcal optimise`: minimise the predicted residual over plans within the limits of sensor, rig and time."""

import math
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from gradcal_jax.cli.console import complain, strong
from gradcal_jax.cli.output import Flag, Force, Json, Output, Plot, as_json, drawable, save_figure, writable
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.cli.status import DONE, INTERRUPTED, NOT_AS_WISHED
from gradcal_jax.pages.plain_text import amount, columns

if TYPE_CHECKING:
    from gradcal_jax.api.optimise import Optimised, SearchStep
    from gradcal_jax.api.unit_optimise import UnitOptimum
    from gradcal_jax.files.unit_spec import UnitSpec


def optimise(
    spec: Path,
    /,
    *,
    output: Output,
    json: Json = False,
    plot: Plot = None,
    steps: int | None = None,
    quick: Flag = False,
    until_met: Flag = False,
    resume: Flag = False,
    force: Force = False,
) -> int:
    """Minimise a plan's residual by gradient descent, within the limits of sensor, rig and time; write it as a recipe.

    The spec's [design] says what to minimise and what is free. For a whole unit, the poses, rates and rests of many
    cycles are changed along the gradient, and the best cycle is written as a spec. Ctrl-C once finishes with the best
    plan so far; twice stops at once. The exit status is 1 where the search did not converge.

    Parameters
    ----------
    spec
        The spec file, with a [design].
    output
        The recipe file to write.
    json
        Print the result for other programs.
    plot
        Draw the residual before and after into this file (.png, .svg, .pdf).
    steps
        Iterations of each start, by default 240; for a whole unit, gradients that are computed in all, by default
        12000: some minutes.
    quick
        Few starts, or gradients: within some per cent of the best, in seconds.
    until_met
        Stop at the first plan that meets every target with a margin of 10 %; no search where the spec's own plan does.
    resume
        Go on with an interrupted search of the same spec, which is kept beside the output.
    """
    from gradcal_jax.files import write_toml
    from gradcal_jax.files.recipe import any_spec_in
    from gradcal_jax.files.unit_spec import UnitSpec

    writable(output, force or resume)
    drawable(plot)
    if steps is not None and steps < 20:
        raise ValueError(f"--steps: expected at least 20, got {steps}")
    specification = any_spec_in(spec)
    use_float64()
    if isinstance(specification, UnitSpec):
        if resume:
            raise ValueError("a search of a whole unit is not kept: start anew, without --resume")
        return _of_unit(
            specification, output, json=json, plot=plot, evaluations=steps, quick=quick, until_met=until_met
        )
    from gradcal_jax import api
    from gradcal_jax.api import checkpoints
    from gradcal_jax.api import optimise as room
    from gradcal_jax.api.minimise_time import NO_UNTIL_MET, minimise_time
    from gradcal_jax.api.optimise import Optimised
    from gradcal_jax.files.design import TIMES

    shortest = specification.design is not None and specification.design.minimise in TIMES
    if shortest and resume:
        raise ValueError("a search for the shortest plan is not kept: start anew, without --resume")
    if shortest and until_met:
        raise ValueError(NO_UNTIL_MET)
    kept = output.with_name(output.name + ".search.npz")
    checkpoint = checkpoints.read(kept, specification) if resume else None
    with _Interrupt() as interrupt, MovingLine(sys.stderr) as line:
        best: Optimised | None = None
        options = {"steps": steps or room.STEPS, "quick": quick, "stop": lambda: interrupt.asked}
        if shortest:
            events = minimise_time(specification, **options)
        else:
            events = room.optimise(specification, **options, until_met=until_met, checkpoint=checkpoint)
        for event in events:
            if isinstance(event, Optimised):
                best = event
                continue
            if not shortest:
                checkpoints.write_checkpoint(kept, specification, event.checkpoint)
            line.show(progress_of(event), event.share)
        assert best is not None
    status = best.sentence if not interrupt.asked else f"interrupted, the best so far: {best.sentence}"
    result = api.recipe(best, status=status)
    write_toml(result, output, header="Made by gradcal optimise; `gradcal show` prints it as a table.")
    if not interrupt.asked:
        kept.unlink(missing_ok=True)
    if json:
        print(as_json(room.record_of(best) | {"status": status, "recipe": str(output)}))
    else:
        print(optimum_text(best))
        print(f"wrote {output}; read it with: gradcal show {output}")
    drawn = [("before", specification), ("optimised", result.axis_spec)]
    save_figure(lambda plots: plots.draw_comparison(drawn), plot, quiet=json)
    if interrupt.asked:
        complain("interrupted" + ("" if shortest else f"; go on with: gradcal optimise {spec} -o {output} --resume"))
        return INTERRUPTED
    return DONE if best.converged else NOT_AS_WISHED


def optimum_text(best: "Optimised") -> str:
    """An optimised plan as text."""
    from gradcal_jax.api.optimise import belief_of

    before = "the plan of the spec observes too little" if best.before is None else amount(best.before, best.unit)
    lines = [
        strong(f"{best.name}: {before} -> {amount(best.now, best.unit)} (rounded to the controllers' steps)"),
        f"{best.structure}; {amount(best.optimum, best.unit)} before rounding",
        best.sentence,
    ]
    if len(best.starts) > 1:
        kept = [value for value in best.starts if value < math.inf]
        those = f"{len(best.starts)} starts"
        if len(kept) < len(best.starts):
            those = f"{len(kept)} of {those} kept the limits and" if kept else f"none of {those} kept the limits"
        lines.append(those + (f" ended between {kept[0]:.4g} and {kept[-1]:.4g} {best.unit}" if kept else ""))
    if belief := belief_of(best.spec):
        lines.append(belief)
    if best.active:
        lines.append("limits that bind: " + "; ".join(best.active))
    if best.prices:
        rows = [("eased by", "the residual changes by", "in proportion up to")]
        for p in best.prices:
            # One unit may be more than the range in which the price holds.
            by = 1.0 if p.linear is None else min(p.linear, 1.0)
            most = "" if p.linear is None else f"{p.linear:g} {p.per}"
            changes = f"{p.change * by:+.3g} {best.unit}" if p.change else "nothing"
            rows.append((f"{by:g} {p.per} of {p.limit}", changes, most))
        lines += ["", columns(rows, indent="")]
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
        complain("stopping with the best so far; Ctrl-C again stops at once")
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _of_unit(
    spec: "UnitSpec",
    output: Path,
    *,
    json: bool,
    plot: Path | None,
    evaluations: int | None,
    quick: bool,
    until_met: bool,
) -> int:
    """Search a unit's cycle and write the spec with the best one."""
    from gradcal_jax.files import write_toml

    best, interrupted = search_unit(spec, evaluations=evaluations, quick=quick, until_met=until_met)
    write_toml(best.spec, output, header="Made by gradcal optimise, from the poses and moves of a unit's plan.")
    if json:
        print(as_json(record_of_unit(best) | {"spec": str(output)}))
    else:
        print(f"{text_of_unit(best)}\nwrote {output}; see it with: gradcal check {output}")
    save_figure(lambda plots: plots.draw_prediction(best.spec), plot, quiet=json)
    if interrupted:
        complain("interrupted: the best so far was written")
        return INTERRUPTED
    return DONE


def record_of_unit(best: "UnitOptimum") -> dict[str, object]:
    """The result of a search of a whole unit, for --json."""
    rows = [dict(zip(("name", "unit", "before", "now"), row, strict=True)) for row in best.rows]
    return {"requirements": rows, "gain": best.gain, "evaluations": best.evaluations, "kept": best.kept}


def text_of_unit(best: "UnitOptimum") -> str:
    """An optimised plan of a whole unit as text."""
    shown = [(name, amount(before, unit), amount(now, unit)) for name, unit, before, now in best.rows]
    return columns([("requirement", "before", "now"), *shown], indent="") + "\n" + gain_of_unit(best)


def gain_of_unit(best: "UnitOptimum") -> str:
    """The gain of a search of a whole unit, in a sentence."""
    if best.kept:
        return f"nothing better than the plan as it was after {best.evaluations} gradients: it is kept"
    return f"{best.gain:.2f} times better in the geometric mean, after {best.evaluations} gradients"


def search_unit(
    spec: "UnitSpec", *, evaluations: int | None = None, quick: bool = False, until_met: bool = False
) -> tuple["UnitOptimum", bool]:
    """The best cycle of a whole unit, with a line of progress; and whether Ctrl-C ended the search."""
    import time

    from gradcal_jax.api.unit_optimise import EVALUATIONS, QUICK_EVALUATIONS, UnitOptimum, optimise_unit

    best: UnitOptimum | None = None
    begun = time.monotonic()
    with _Interrupt() as interrupt, MovingLine(sys.stderr) as line:
        line.show("compiling the objective and its gradient: 10 to 30 s")
        for event in optimise_unit(
            spec,
            evaluations=evaluations or (QUICK_EVALUATIONS if quick else EVALUATIONS),
            until_met=until_met,
            stop=lambda: interrupt.asked,
        ):
            if isinstance(event, UnitOptimum):
                best = event
                continue
            left = (time.monotonic() - begun) * (1.0 / event.share - 1.0)
            gain = math.exp(event.first - event.value)
            line.show(
                f"{event.share:4.0%}  {gain:.2f} times better  ({len(event.best.turns)} turns, {left:.0f} s left)"
            )
    assert best is not None
    return best, interrupt.asked
