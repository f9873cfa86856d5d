"""A recipe's tracks as rows of text for the operator: the same on a terminal and on a page."""

import math
from typing import Final

from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.recipe.tracks import ChamberSegment, MotionBlock, TrackMove
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.units import time_text

CHAMBER_HEAD: Final = ("", "begins", "plan's clock", "lasts", "what", "data")
MOVES_HEAD: Final = ("at", "axis", "what", "lasts", "angle", "rate", "acceleration", "read")


def clock_text(seconds: float) -> str:
    """``1:05:00`` or ``1:05:00.5``: hours, minutes, seconds on the plan's clock."""
    tenths = round(seconds * 10.0)
    whole, tenth = divmod(tenths, 10)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}" + (f".{tenth}" if tenth else "")


def chamber_rows(recipe: Recipe) -> list[tuple[str, ...]]:
    """A row of `CHAMBER_HEAD` for each segment of the chamber's track."""
    return [
        (
            segment.name,
            "when stable" if segment.begins == "when stable" else "at once",
            clock_text(segment.start),
            time_text(segment.duration),
            _course(segment),
            "used" if segment.used else "",
        )
        for segment in recipe.chamber.programme
    ]


def chamber_words(recipe: Recipe) -> list[str]:
    """The duration and the conditions of waiting, in sentences."""
    stable = recipe.stability
    lines = [f"{time_text(recipe.duration_s)} in total, plus waiting for stable temperatures"]
    if any(segment.begins == "when stable" for segment in recipe.chamber.programme):
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
