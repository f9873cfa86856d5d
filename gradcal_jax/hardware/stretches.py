"""The completed part of a recipe, from a run's journal, on the plan's own clock.

That clock adds up the durations of the steps, without waiting. A step that was broken off counts up to the break; a
step that was not executed as written does not count, nor does the data after it.
"""

import json
from dataclasses import dataclass, replace

from ..files.recipe import Recipe
from ..files.writing import write_toml, write_whole
from .journal import Event, JournalContents
from .run_folder import SESSION, RunFolder, RunFolderError, exit_status, prepare_resume, steps_done
from .track import Track

_SAME_S = 1e-3
# A recipe may begin this far from the end of the stretches done.
_PLANNED_S = 0.2


@dataclass(frozen=True)
class StretchDone:
    """Data without a break: from `start_s` to `end_s` of the plan's clock, which began and ended at times of the
    run's."""

    start_s: float
    end_s: float
    began_s: float
    ended_s: float


def breaks_off(event: Event) -> bool:
    """Whether a run is interrupted or ends here: from now on a person may be at the rig."""
    return event.name in ("interlock", "ending", "not done") or (
        event.name == "state" and event.data["state"] == "paused"
    )


def stretches_done(contents: JournalContents, track: Track, recipe: int = 0) -> list[StretchDone]:
    """The stretches of the run's recipe of that number (replanning adds a recipe), in order."""
    starts = [0.0]
    for step in track.steps:
        starts.append(starts[-1] + step.duration_s)
    stretches: list[StretchDone] = []
    open_step: tuple[int, float] | None = None
    current, first, latest_s = 0, 0, 0.0

    def close(time_s: float) -> None:
        nonlocal open_step
        if open_step is not None:
            number, begins_s = open_step
            lasted_s = min(time_s - begins_s, track.steps[number].duration_s)
            part = StretchDone(starts[number], starts[number] + lasted_s, begins_s, begins_s + lasted_s)
            before = stretches[-1] if stretches else None
            flows = before is not None and abs(before.end_s - part.start_s) + abs(before.ended_s - begins_s) < _SAME_S
            if before is not None and flows:
                stretches[-1] = replace(before, end_s=part.end_s, ended_s=part.ended_s)
            elif lasted_s > 0.0:
                stretches.append(part)
        open_step = None

    for event in contents.events:
        if event.name in (SESSION, "step") or breaks_off(event):
            close(latest_s if event.name == SESSION else event.time_s)
        latest_s = max(latest_s, event.time_s)
        if event.name == SESSION:
            current, first, latest_s = int(event.data.get("recipe", 0)), len(stretches), event.time_s
        elif current != recipe:
            continue
        elif event.name == "step begins" and event.data.get("data"):
            number = int(event.data["number"])
            open_step = (number, float(event.data["begins_s"])) if 0 <= number < len(track.steps) else None
        elif event.name == "not done":
            bad_s = starts[min(max(int(event.data["number"]), 0), len(track.steps))]
            parts = [part if part.end_s <= bad_s else _until(part, bad_s) for part in stretches[first:]]
            stretches[first:] = [part for part in parts if part.end_s > part.start_s]
    close(latest_s)
    return stretches


def stretches_of(folder: RunFolder) -> list[StretchDone]:
    """The completed stretches of a run's newest recipe."""
    return stretches_done(folder.events(), folder.track(), len(folder.recipes()) - 1)


def goes_on_at(folder: RunFolder) -> float:
    """Where a run will continue, on its plan's clock (s): while it is under way, the end of its last stretch."""
    contents, recipe = folder.events(), len(folder.recipes()) - 1
    done = stretches_done(contents, folder.track(), recipe)
    if done and exit_status(contents) == "lost":
        return done[-1].end_s
    return sum(step.duration_s for step in folder.track().steps[: steps_done(contents, recipe)])


def _until(part: StretchDone, end_s: float) -> StretchDone:
    return replace(part, end_s=end_s, ended_s=part.ended_s - (part.end_s - end_s))


def adopt(folder: RunFolder, recipe: Recipe) -> None:
    """Make this recipe, by `gradcal optimise RUN`, the run's recipe from now on.

    Raises `RunFolderError` where the run cannot continue, or where the recipe does not begin at the run's present step.
    """
    prepare_resume(folder)
    before = folder.recipe()
    stands = stretches_of(folder)
    parts = recipe.spec.done[-len(stands) :] if stands else ()
    apart = [abs(float(part.end) - one.end_s) for part, one in zip(parts, stands, strict=False)]
    if len(parts) != len(stands) or max(apart, default=0.0) > _PLANNED_S or recipe.spec.sensor != before.spec.sensor:
        raise RunFolderError(
            f"The recipe does not go on from where the run in {folder.path} stands: make it by "
            f"`gradcal optimise {folder.path}`."
        )
    folder.track(recipe)
    names = folder.recipes()
    name = f"recipe-{len(names) + 1}.toml"
    write_toml(recipe, folder.path / name)
    # Atomic: until this file is there, the run uses the recipe before.
    notes = folder.notes() | {"recipe": recipe.fingerprint, "recipes": [*names, name]}
    write_whole(folder.path / "run.json", json.dumps(notes, indent=2) + "\n")
