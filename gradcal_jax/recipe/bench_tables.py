"""A plan as text for the operator: the same on a terminal and on a page."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from gradcal_jax.recipe.tracks import ChamberSegment, MotionBlock, TrackMove, Tracks
from gradcal_jax.spec.contracts import outcomes
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.table import Table
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.recipe.recipe import Recipe

MOVES_HEAD: Final = ("at", "axis", "what", "lasts", "angle", "rate", "acceleration", "read")


def show(recipe: "Recipe", *, heading: Callable[[str], str] = str) -> str:
    """A recipe in plain text: the steps of the chamber, those of the table as the controllers take them, and the
    predicted residuals (1σ). `heading` formats headings, as the command does on a terminal."""
    lines = [heading(recipe.title or "recipe"), f"{recipe.made.by}; {recipe.status}"]
    lines += [f"recipe {recipe.fingerprint[:12]}", *(f"note: {note}" for note in recipe.notes), ""]
    lines += [*plan_lines(recipe.tracks, heading), *(f"  {line}" for line in chamber_words(recipe)), ""]
    lines += [heading("What it leaves (1σ)"), outcomes(recipe.prediction.requirements).text(indent="  ")]
    return "\n".join([*lines, *(f"note: {warning}" for warning in recipe.prediction.warnings)])


def plan_lines(tracks: Tracks, heading: Callable[[str], str] = str) -> list[str]:
    """The tracks in plain text; the moves of a block that are those of the block before are not repeated."""
    lines = [heading("Chamber"), chamber_table(tracks).text(indent="  ")]
    before: tuple[TrackMove, ...] = ()
    for block in tracks.motion:
        lines += ["", *([] if block.hang is None else [f"mount the IMU as follows: {block.hang}"])]
        lines.append(heading("Table, " + block_heading(block)))
        if block.moves == before:
            lines.append("  the same moves")
        else:
            lines.append(Table.of(MOVES_HEAD, move_rows(block)).text(indent="  "))
        before = block.moves
    return lines


def clock_text(seconds: float) -> str:
    """``1:05:00`` or ``1:05:00.5``: hours, minutes, seconds on the plan's clock."""
    tenths = round(seconds * 10.0)
    whole, tenth = divmod(tenths, 10)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}" + (f".{tenth}" if tenth else "")


def chamber_table(tracks: Tracks) -> Table:
    """A row for each segment of the chamber's track."""
    rows = [
        (
            segment.name,
            "when stable" if segment.begins == "when stable" else "at once",
            clock_text(segment.start),
            time_text(segment.duration),
            _course(segment),
            "used" if segment.used else "",
        )
        for segment in tracks.chamber
    ]
    return Table.of(["segment", "begins", "plan's clock", "lasts", "what", "data"], rows)


def chamber_words(recipe: "Recipe") -> list[str]:
    """The duration and the conditions of waiting, in sentences."""
    stable = recipe.stability
    lines = [f"{time_text(recipe.duration_s)} in total, plus waiting for stable temperatures"]
    if any(segment.begins == "when stable" for segment in recipe.chamber):
        lines.append(
            f"stable: within {stable.within} of the initial temperature of the segment, and constant to the same "
            f"tolerance, for {stable.for_at_least}; timeout after {stable.timeout} (first segment: "
            f"{stable.first_timeout})"
        )
    return lines


def _course(segment: ChamberSegment) -> str:
    if segment.kind == "soak":
        return f"stay at {segment.temperature_end}"
    way = f"from {segment.temperature_start} to {segment.temperature_end}"
    return f"{way} at {segment.slope}" if segment.slope is not None else f"{way} at the chamber's maximum rate"


def block_heading(block: MotionBlock) -> str:
    """When a block of motion begins and how often it repeats."""
    if block.repeat == 1:
        text = f"{block.name}: begins with {block.begins_with}"
    else:
        text = f"{block.name}: begins with {block.begins_with}, {block.repeat} times, one every {block.period}"
    if any(block.start.values()):
        text += f"; initial angles: {', '.join(f'{name} {angle}' for name, angle in block.start.items())}"
    if block.standing_after > 0.0:
        read = "not read" if block.read_every_after is None else f"read every {block.read_every_after}"
        text += f"; then rest for {time_text(float(block.standing_after))} ({read})"
    return text


def move_rows(block: MotionBlock) -> list[tuple[str, ...]]:
    """A row of `MOVES_HEAD` for each move; times count from the beginning of a repetition. For a whole unit, whose axes
    have absolute angles, the angle of a turn is followed by the final one."""
    rows: list[tuple[str, ...]] = []
    at = {name: math.degrees(angle) for name, angle in block.start.items()}
    for move in block.moves:
        where, standing = "", move.do in ("rest", "wait") and bool(at)
        if move.axis in at and move.angle is not None:
            at[move.axis] += math.degrees(move.angle)
            where = f", to {round(at[move.axis], 6) + 0.0:g} deg"
        rows.append(
            (
                clock_text(move.start),
                "" if standing else move.axis,
                move.do,
                str(move.duration),
                _signed(move.angle) + where,
                _signed(move.rate),
                "" if move.acceleration is None else str(move.acceleration),
                _read(move),
            )
        )
    return rows


def _signed(quantity: Quantity | None) -> str:
    if quantity is None:
        return ""
    return f"+{quantity}" if quantity > 0.0 else str(quantity)


def _read(move: TrackMove) -> str:
    if move.read_every is not None:
        return f"every {move.read_every}"
    return "at the end" if move.read == "end" else ""
