"""`gradcal frontier`: the best residual for each duration."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from gradcal_jax.cli.console import columns, is_plain, strong, time_text

if TYPE_CHECKING:
    from gradcal_jax.assemble.frontier import Point
    from gradcal_jax.assemble.optimise import Step


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(frontier)


def frontier(
    spec: Path,
    /,
    *,
    motion: str,
    points: int = 5,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    steps: int = 240,
    json: Annotated[bool, Parameter(name="--json", negative="")] = False,
    plot: Path | None = None,
) -> int:
    """Find the best residual for each duration of the ramp, and the shortest plan for each target.

    Parameters
    ----------
    spec
        The spec file, with a [design].
    motion
        Durations without soaks: 50min..300min, or a list such as 60min,100min,3h.
    points
        How many durations a range is divided into, ends included, evenly in their logarithm.
    output
        Write a recipe for each duration into this directory.
    steps
        Iterations of each start.
    json
        Print the frontier for other programs.
    plot
        Draw the frontier into this file.
    """
    from gradcal_jax.cli.precision import use_float64
    from gradcal_jax.cli.specs import read_spec

    found = read_spec(spec)
    times = durations(motion, points)
    use_float64()
    from gradcal_jax import assemble
    from gradcal_jax.assemble import frontier as room
    from gradcal_jax.assemble.optimise import record_of
    from gradcal_jax.files import to_toml
    from gradcal_jax.files.writing import write_whole

    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
    reached: list[Point] = []
    for point in room.frontier(found, times, steps=steps, watch=_show):
        reached.append(point)
        if output is not None and point.plan is not None:
            made = assemble.recipe(point.plan.spec, status=point.plan.sentence, optimisation=record_of(point.plan))
            write_whole(output / f"{point.motion / 60.0:.4g}min.toml", to_toml(made))
    targets = {
        r.name: float(r.target) * assemble.UNIT_OF[r.quantity][1]
        for r in found.requirement
        if r.target is not None and found.design is not None and r.name == found.design.minimise
    }
    times_for = {name: room.shortest(reached, target) for name, target in targets.items()}
    if plot is not None:
        from gradcal_jax import plots

        plots.save(plots.draw_frontier(reached, targets), plot)
    if json:
        from json import dumps

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
        print(dumps({"points": rows, "shortest_s": times_for}, indent=2))
    else:
        print(strong(found.title or str(spec)))
        print(columns([("ramp", "residual", "search"), *(_row(p) for p in reached)], indent=""))
        for name, target in targets.items():
            time = times_for[name]
            said = "is not reached in these durations" if time is None else f"takes a ramp of about {time_text(time)}"
            print(f"{name} at {target:.4g} {next((p.plan.unit for p in reached if p.plan), '')} {said}")
        if plot is not None:
            print(f"wrote {plot}")
    return 0 if all(p.plan is not None and p.plan.converged for p in reached) else 1


def durations(text: str, points: int) -> list[float]:
    """Durations in s of "50min..300min" or "60min,100min". Errors: `ValueError` that says what was expected."""
    from gradcal_jax.files import Quantity

    def one(part: str) -> float:
        value = float(Quantity.read(part.strip(), "time"))
        if value <= 0.0:
            raise ValueError(f"--motion: {part.strip()!r} is no duration")
        return value

    if ".." in text:
        ends = text.split("..")
        if len(ends) != 2 or points < 2:
            raise ValueError(f"--motion: expected a range such as 50min..300min with 2 points or more, got {text!r}")
        low, high = one(ends[0]), one(ends[1])
        if low >= high:
            raise ValueError(f"--motion: {text!r} does not rise")
        return [low * (high / low) ** (k / (points - 1)) for k in range(points)]
    return sorted(one(part) for part in text.split(","))


def _row(point: "Point") -> tuple[str, str, str]:
    residual = "none" if point.plan is None else f"{point.plan.now:.4g} {point.plan.unit}"
    return time_text(point.motion), residual, point.reason


def _show(motion: float, step: "Step") -> None:
    line = f"{time_text(motion)}: {step.share:4.0%}  {step.best:.4g} {step.unit}"
    if is_plain(sys.stderr):
        print(line, file=sys.stderr, flush=True)
    else:
        print("\r\x1b[K" + line, end="", file=sys.stderr, flush=True)
