"""`gradcal optimise`: the plan changes until the predicted residual is as low as sensor, rig and clock allow."""

import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from gradcal_jax.cli.console import columns, complain, is_plain, strong

if TYPE_CHECKING:
    from gradcal_jax.assemble.optimise import Optimised, Step

CONVERGED, NOT_CONVERGED, INTERRUPTED = 0, 1, 130


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(optimise)


def optimise(
    spec: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)],
    json: Annotated[bool, Parameter(name="--json", negative="")] = False,
    plot: Path | None = None,
    steps: int = 240,
    resume: Annotated[bool, Parameter(negative="")] = False,
    force: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Change a plan by gradient descent until it leaves as little as sensor, rig and time allow; write it as a recipe.

    The spec's [design] says what to minimise and what is free. Ctrl-C once keeps the best so far and finishes it; twice
    stops at once. The exit status is 1 where the search did not converge.

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
        Iterations of each start.
    resume
        Go on from where an interrupted search of the same spec stopped; it is kept beside the output.
    force
        Overwrite an existing file.
    """
    from gradcal_jax.cli.precision import use_float64
    from gradcal_jax.cli.specs import read_spec
    from gradcal_jax.files import to_toml
    from gradcal_jax.files.writing import write_whole

    if output.exists() and not (force or resume):
        raise ValueError(f"{output} exists; choose another name, or overwrite it with --force")
    if not output.absolute().parent.is_dir():
        raise ValueError(f"there is no directory {output.parent}; make it first")
    if steps < 20:
        raise ValueError(f"--steps: expected at least 20, got {steps}")
    found = read_spec(spec)
    use_float64()
    from gradcal_jax import assemble
    from gradcal_jax.assemble import checkpoints
    from gradcal_jax.assemble import optimise as room
    from gradcal_jax.assemble.optimise import Optimised
    from gradcal_jax.assemble.quickest import quickest
    from gradcal_jax.files.design import TIMES

    shortest = found.design is not None and found.design.minimise in TIMES
    if shortest and resume:
        raise ValueError("a search for the shortest plan is not kept: start anew, without --resume")
    kept = output.with_name(output.name + ".search.npz")
    checkpoint = checkpoints.read(kept, found) if resume else None
    with _Interrupt() as interrupt:
        best: Optimised | None = None
        options = {"steps": steps, "stop": lambda: interrupt.asked}
        events = quickest(found, **options) if shortest else room.optimise(found, **options, checkpoint=checkpoint)
        for event in events:
            if isinstance(event, Optimised):
                best = event
                continue
            if not shortest:
                checkpoints.write(kept, found, event.checkpoint)
            _show(event)
        assert best is not None
    record = room.record_of(best)
    status = best.sentence if not interrupt.asked else f"interrupted, the best so far: {best.sentence}"
    seed = found.design.seed if found.design is not None else None
    made = assemble.recipe(best.spec, status=status, seed=seed, optimisation=record)
    write_whole(output, to_toml(made, header="Made by gradcal optimise; `gradcal show` prints it as a table."))
    if not interrupt.asked:
        kept.unlink(missing_ok=True)
    if plot is not None:
        from gradcal_jax import plots

        plots.save(plots.draw_comparison([("before", found), ("optimised", made.spec)]), plot)
    if json:
        from json import dumps

        print(dumps(record | {"status": status, "recipe": str(output)}, indent=2))
    else:
        print(text(best))
        print(f"wrote {output}; read it with: gradcal show {output}" + (f"\nwrote {plot}" if plot is not None else ""))
    if interrupt.asked:
        complain("interrupted" + ("" if shortest else f"; go on with: gradcal optimise {spec} -o {output} --resume"))
        return INTERRUPTED
    return CONVERGED if best.converged else NOT_CONVERGED


def text(best: "Optimised") -> str:
    """An optimised plan as people read it."""
    before = "the plan of the spec observes too little" if best.before is None else f"{best.before:.4g} {best.unit}"
    lines = [
        strong(f"{best.name}: {before} -> {best.now:.4g} {best.unit} (rounded to the controllers' steps)"),
        f"{best.structure}; {best.found:.4g} {best.unit} before rounding",
        best.sentence,
    ]
    if len(best.starts) > 1:
        lines.append(
            f"{len(best.starts)} starts ended between {best.starts[0]:.4g} and {best.starts[-1]:.4g} {best.unit}"
        )
    if best.active:
        lines.append("limits that bind: " + "; ".join(best.active))
    if best.prices:
        rows = [("eased by", "the residual changes by")]
        rows += [(f"one {p.per} of {p.limit}", f"{p.change:+.3g} {best.unit}") for p in best.prices]
        lines += ["", columns(rows, indent="")]
    return "\n".join(lines)


def _show(step: "Step") -> None:
    """One line that is written over, on a terminal; else a line now and then."""
    before = "" if step.before is None else f"{step.before:.4g} -> "
    line = f"{step.share:4.0%}  {step.name}: {before}{step.best:.4g} {step.unit}  ({step.words})"
    if is_plain(sys.stderr):
        print(line, file=sys.stderr, flush=True)
    else:
        print("\r\x1b[K" + line, end="" if step.share < 0.949 else "\n", file=sys.stderr, flush=True)


class _Interrupt:
    """The first Ctrl-C asks to stop, the second stops."""

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
