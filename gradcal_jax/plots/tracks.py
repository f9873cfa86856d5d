"""Tracks of a plan, of a recipe and of its run: temperature and rate against time."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from gradcal_jax.files import Timeline
from gradcal_jax.files.recipe import Recipe
from gradcal_jax.files.tracks import TrackMove
from gradcal_jax.plots.style import new_axes, style_of


def draw_temperature(
    timeline: Timeline, *, label: str = "", index: int = 0, ax: Axes | None = None
) -> tuple[Axes, Line2D]:
    """The chamber's temperature against time, from a `gradcal-timeline/2`."""
    axis = timeline.segments[0].axis
    points: list[tuple[float, float]] = []
    for segment in (s for s in timeline.segments if s.axis == axis):
        points.append((segment.start, segment.temperature_start))
        points += segment.temperature_bends or ()
        points.append((segment.start + segment.duration, segment.temperature_end))
    time, temperature = np.array(points).T
    return draw_against_time(time, temperature, "chamber, °C", label, index, ax)


def draw_planned_temperature(recipe: Recipe, *, label: str = "planned", ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """The chamber's track on the plan's clock, without waits."""
    time: list[float] = []
    temperature: list[float] = []
    for segment in recipe.chamber.programme:
        time += [float(segment.start), float(segment.start) + float(segment.duration)]
        temperature += [float(segment.temperature_start), float(segment.temperature_end)]
    return draw_against_time(np.array(time), np.array(temperature), "chamber, °C", label, 0, ax)


def draw_planned_rate(recipe: Recipe, axis: str, *, label: str = "", ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """The rate of an axis as controllers turn it, by trapezoids, on the plan's clock."""
    return draw_against_time(*planned_rate(recipe, axis), "rate, deg/s", label, 0, ax, linewidth=0.8)


def draw_against_time(
    time_s: np.ndarray, values: np.ndarray, what: str, label: str, index: int, ax: Axes | None, **more: Any
) -> tuple[Axes, Line2D]:
    """The index-th curve of values over time in h."""
    ax = new_axes(ax, (6.4, 3.2))
    (line,) = ax.plot(time_s / 3600.0, values, label=label, **style_of(index), **more)
    ax.set(xlabel="time, h", ylabel=what)
    return ax, line


def turned_axes(recipe: Recipe) -> tuple[str, ...]:
    """The axes that any move of a recipe turns."""
    return tuple(sorted({m.axis for b in recipe.motion for m in b.moves if m.do not in ("rest", "wait")}))


def planned_cycle(recipe: Recipe, axis: str) -> tuple[float, float, str]:
    """Begin and end of one cycle that turns an axis (s, on the plan's clock), and its words: the middle one of the
    block with the most cycles."""
    turning = [b for b in recipe.motion if any(m.axis == axis and m.do not in ("rest", "wait") for m in b.moves)]
    block = max(turning, key=lambda b: b.repeat)
    begins = next(float(s.start) for s in recipe.chamber.programme if s.name == block.begins_with)
    begins += block.repeat // 2 * float(block.period)
    which = f"cycle {block.repeat // 2 + 1} of {block.repeat}" if block.repeat > 1 else "the moves"
    return begins, begins + float(block.period), f"{which} of {block.begins_with}"


def planned_rate(recipe: Recipe, axis: str) -> tuple[np.ndarray, np.ndarray]:
    """Times (s) on the plan's clock and rates (deg/s) between which the rate is linear."""
    begins = {segment.name: float(segment.start) for segment in recipe.chamber.programme}
    points: list[tuple[float, float]] = [(0.0, 0.0)]
    for block in recipe.motion:
        for repetition in range(block.repeat):
            start = begins[block.begins_with] + repetition * float(block.period)
            for move in block.moves:
                if move.axis != axis or move.rate is None:
                    continue
                for again in range(move.repeat):
                    begin = start + float(move.start) + again * float(move.duration)
                    points += [(begin + t, rate) for t, rate in _shape(move)]
    points.append((recipe.duration_s, 0.0))
    time, rate = np.array(points).T
    return time, np.degrees(rate)


def _shape(move: TrackMove) -> list[tuple[float, float]]:
    """Times within a move and rates (rad/s)."""
    assert move.rate is not None
    lasting, peak = float(move.duration), float(move.rate)
    ramp = 0.0 if move.acceleration is None else min(abs(peak) / float(move.acceleration), lasting / 2.0)
    # A controller whose accelerations have steps ends a turn a little earlier, and stands for the rest of its time.
    ends = lasting if move.angle is None else min(lasting, abs(float(move.angle) / peak) + ramp)
    return [(0.0, 0.0), (ramp, peak), (ends - ramp, peak), (ends, 0.0), (lasting, 0.0)]
