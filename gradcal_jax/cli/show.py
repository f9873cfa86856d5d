"""`gradcal show`: a recipe as a table, for whoever stands at the bench with only the paper in hand."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from gradcal_jax.cli.console import columns, strong, time_text

if TYPE_CHECKING:
    from gradcal_jax.files.contracts import RequirementRow
    from gradcal_jax.files.quantity import Quantity
    from gradcal_jax.files.recipe import Recipe
    from gradcal_jax.files.tracks import ChamberSegment, MotionBlock, TrackMove


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(show)


def show(recipe: Path, /, *, json: Annotated[bool, Parameter(name="--json", negative="")] = False) -> int:
    """Print a recipe as a table: what the chamber does, what the table does, and what it will leave.

    Parameters
    ----------
    recipe
        The recipe file.
    json
        Print it as JSON instead.
    """
    from gradcal_jax.files.recipe import read_recipe

    found = read_recipe(recipe)
    print(found.model_dump_json(indent=2, exclude_none=True) if json else text(found, str(recipe)))
    return 0


def text(recipe: "Recipe", name: str) -> str:
    """The whole table."""
    lines = [strong(recipe.title or name)]
    lines += [f"{recipe.made.by}; {recipe.status}", f"recipe {recipe.fingerprint[:12]}"]
    lines += [f"note: {note}" for note in recipe.notes]
    lines += ["", strong("Chamber"), *_chamber(recipe), ""]
    for block in recipe.motion:
        lines += [strong("Table, " + _heading(block)), columns(_moves(block)), ""]
    lines += [strong("What it leaves (1σ)"), columns([_left(row) for row in recipe.prediction.requirements])]
    lines += [f"note: {warning}" for warning in recipe.prediction.warnings]
    if recipe.optimisation is not None:
        lines += ["", strong("Optimisation"), *_free(recipe.optimisation, "  ")]
    if recipe.rounded:
        lines += ["", strong("Rounded to the controllers' steps"), *(f"  {change}" for change in recipe.rounded)]
    return "\n".join(lines)


def clock_text(seconds: float) -> str:
    """``1:05:00`` or ``1:05:00.5``: hours, minutes, seconds on the plan's clock."""
    tenths = round(seconds * 10.0)
    whole, tenth = divmod(tenths, 10)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}" + (f".{tenth}" if tenth else "")


def _chamber(recipe: "Recipe") -> list[str]:
    rows: list[tuple[str, ...]] = [("", "begins", "plan's clock", "lasts", "what", "data")]
    segments = recipe.chamber.programme
    for segment in segments:
        rows.append(
            (
                segment.name,
                "when stable" if segment.begins == "when stable" else "at once",
                clock_text(segment.start),
                time_text(segment.duration),
                _course(segment),
                "used" if segment.used else "",
            )
        )
    stable = recipe.stability
    lines = [columns(rows), f"  in all {time_text(recipe.duration_s)}, and what is waited for stable temperatures"]
    if any(segment.begins == "when stable" for segment in segments):
        lines.append(
            f"  stable: within {stable.within} of the temperature where the segment begins, and steady by as much, "
            f"for {stable.for_at_least}; give up after {stable.timeout}, at the first after {stable.first_timeout}"
        )
    return lines


def _course(segment: "ChamberSegment") -> str:
    if segment.kind == "soak":
        return f"stay at {segment.temperature_end}"
    way = f"from {segment.temperature_start} to {segment.temperature_end}"
    return f"{way} at {segment.slope}" if segment.slope is not None else f"{way} as fast as the chamber can"


def _heading(block: "MotionBlock") -> str:
    if block.repeat == 1:
        said = f"{block.name}: begins with {block.begins_with}"
    else:
        said = f"{block.name}: begins with {block.begins_with}, {block.repeat} times, one every {block.period}"
    if block.standing_after > 0.0:
        read = "not read" if block.read_every_after is None else f"read every {block.read_every_after}"
        said += f"; then stand for {block.standing_after} ({read})"
    return said


def _moves(block: "MotionBlock") -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("at", "axis", "what", "lasts", "angle", "rate", "acceleration", "read")]
    for move in block.moves:
        times = f"{move.repeat} × " if move.repeat > 1 else ""
        rows.append(
            (
                clock_text(move.start),
                move.axis,
                f"{times}{move.do}",
                str(move.duration),
                _signed(move.angle),
                _signed(move.rate),
                "" if move.acceleration is None else str(move.acceleration),
                _read(move),
            )
        )
    return rows


def _signed(quantity: "Quantity | None") -> str:
    if quantity is None:
        return ""
    return f"+{quantity}" if quantity > 0.0 else str(quantity)


def _read(move: "TrackMove") -> str:
    if move.read_every is not None:
        return f"every {move.read_every}"
    return "at the end" if move.read == "end" else ""


def _left(row: "RequirementRow") -> tuple[str, ...]:
    from gradcal_jax.cli.predict import value

    target = "" if row.target is None else f"target {row.target:.4g} {row.unit}: {row.verdict}"
    return (row.name, f"axis {row.axis}", row.statistic, value(row), target, row.limited_by or "")


def _free(table: dict[str, Any], indent: str) -> list[str]:
    lines: list[str] = []
    for name, entry in table.items():
        if isinstance(entry, dict):
            lines += [f"{indent}{name}:", *_free(entry, indent + "  ")]
        elif isinstance(entry, list) and entry and isinstance(entry[0], dict):
            rows = [tuple(f"{key} {_short(value)}" for key, value in row.items()) for row in entry]
            lines += [f"{indent}{name}:", columns(rows, indent=indent + "  ")]
        else:
            lines.append(f"{indent}{name}: {_short(entry)}")
    return lines


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_short(entry) for entry in value)
    return str(value)
