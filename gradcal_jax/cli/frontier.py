"""`gradcal optimise --motion`: the best residual for each duration."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import as_json, save_figure
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED
from gradcal_jax.pages.plain_text import amount, columns
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.api.frontier import FrontierPoint
    from gradcal_jax.api.search_results import SearchStep
    from gradcal_jax.files.spec_sections import Spec


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
    from gradcal_jax import api
    from gradcal_jax.api import frontier as room
    from gradcal_jax.files import write_toml

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
                write_toml(api.recipe(point.plan), output / f"{point.motion / 60.0:.4g}min.toml")
    targets = {
        r.name: limit[1]
        for r in spec.requirement
        if (limit := api.limit_of(r)) is not None
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
            result = "is not reached in these durations" if time is None else f"takes a ramp of about {time_text(time)}"
            print(f"{name} at {target:.4g} {next((p.plan.unit for p in reached if p.plan), '')} {result}")
    save_figure(lambda plots: plots.draw_frontier(reached, targets), plot, quiet=json)
    return DONE if all(p.plan is not None and p.plan.converged for p in reached) else NOT_AS_WISHED


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
