"""The folder of a run: recipe and rig as executed, the journal, and what resuming needs to know.

    recipe.toml, rig.toml    at the beginning of the run
    run.json                 time, version, simulated or not, the recipe's fingerprint, the rig, operator and notes
    status.json              the status of the run, or how it ended (see `supervision`)
    journal                  raw bytes and events of all sessions of the run
    hidden_truth.json        of a simulated run: the true parameters

A run consists of *sessions*: an event with its number begins each. A run that ended without its "end" event was lost
(killed, or the power failed); the next session notes it.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from gradcal_jax.hardware.journal import Event, Journal, JournalContents, read_journal
from gradcal_jax.hardware.track import Track, track_of
from gradcal_jax.recipe.recipe import Recipe, read_recipe
from gradcal_jax.spec.rig import RigFile, read_rig, rig_of
from gradcal_jax.tables.writing import write_toml, write_whole

FORMAT: Final = "gradcal-run/1"
SESSION: Final = "session"


class RunFolderError(ValueError):
    """A folder that cannot be used for the requested action."""


@dataclass(frozen=True)
class RunFolder:
    path: Path

    @property
    def journal_path(self) -> Path:
        return self.path / "journal"

    def recipe(self) -> Recipe:
        return read_recipe(self.path / "recipe.toml")

    def rig(self) -> RigFile:
        return read_rig(self.path / "rig.toml")

    def rig_begun(self) -> RigFile:
        """The rig that the run began with: a later change of the rig file does not change what its bytes mean."""
        return rig_of(self.notes()["rig"], f"the rig in {self.path}/run.json")

    def notes(self) -> dict[str, Any]:
        """The contents of run.json. Raises `RunFolderError` where this is no run's folder."""
        try:
            notes = json.loads((self.path / "run.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            what = "is not the folder of a run: there is no run.json that can be read."
            raise RunFolderError(f"{self.path} {what}") from None
        if not isinstance(notes, dict) or notes.get("format") != FORMAT:  # pyright: ignore[reportUnknownMemberType]
            raise RunFolderError(
                f"{self.path}/run.json is not of the format {FORMAT}: another version may have recorded the run."
            )
        return notes  # pyright: ignore[reportUnknownVariableType]

    def track(self) -> Track:
        return track_of(self.recipe(), [axis.name for axis in self.rig().axis])

    def contents(self) -> JournalContents:
        return read_journal(self.journal_path)

    def events(self) -> JournalContents:
        """Without the bytes; empty before the first session."""
        return read_journal(self.journal_path, chunks=False) if self.journal_path.exists() else JournalContents()


def new_folder(
    path: Path,
    recipe: Recipe,
    rig: RigFile,
    *,
    simulated: dict[str, Any] | None = None,
    about: Mapping[str, str] | None = None,
) -> RunFolder:
    """Make the folder of a new run. `about`: operator, unit and notes to keep.

    Raises `RunFolderError` where the folder holds a run or other files; `HardwareError`, before it is made, where the
    rig lacks an axis that the recipe turns.
    """
    track_of(recipe, [axis.name for axis in rig.axis])
    if path.exists() and any(path.iterdir()):
        raise RunFolderError(
            f"{path} is not empty: continue a run that it has with `gradcal run --resume {path}`, or name a new folder."
        )
    path.mkdir(parents=True, exist_ok=True)
    write_toml(recipe, path / "recipe.toml")
    write_toml(rig, path / "rig.toml")
    notes: dict[str, Any] = {
        "format": FORMAT,
        "recipe": recipe.fingerprint,
        "rig": _tables(rig),
        "version": version("gradcal_jax"),
        "begun": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "simulated": simulated is not None,
        "simulation": simulated,
        "about": dict(about or {}),
    }
    write_whole(path / "run.json", json.dumps(notes, indent=2) + "\n")
    return RunFolder(path)


def _tables(rig: RigFile) -> dict[str, Any]:
    return rig.model_dump(mode="json", exclude_unset=True)


def begin_session(journal: Journal, now_s: float, number: int, *, simulated: bool, first_step: int) -> None:
    """Write the event that begins a session, with the wall clock beside the monotonic one."""
    part: dict[str, Any] = {"number": number, "first_step": first_step, "wall_clock_s": time.time()}
    journal.event(now_s, SESSION, **part, simulated=simulated, version=version("gradcal_jax"))


def sessions(contents: JournalContents) -> int:
    return sum(event.name == SESSION for event in contents.events)


def steps_done(contents: JournalContents) -> int:
    """The step of the recipe at which to resume: one after the last that is done."""
    return max((int(event.data["number"]) + 1 for event in contents.events if event.name == "step done"), default=0)


def mounting_of(contents: JournalContents) -> int:
    """How the units hang, as `Step.mounting`; 0 where the operator was not asked to hang them."""
    return next((int(event.data["mounting"]) for event in reversed(contents.events) if event.name == "hung"), 0)


def identities_of(contents: JournalContents) -> dict[str, dict[str, Any]]:
    """The devices of the first session, by name."""
    return {str(event.data["device"]): event.data for event in reversed(contents.events) if event.name == "identity"}


def exit_status(contents: JournalContents) -> str:
    """The last session's exit status: "success", "aborted", or "lost" where the journal has no end."""
    ends = [event for event in contents.events if event.name in (SESSION, "end")]
    return str(ends[-1].data.get("exit_status", "lost")) if ends and ends[-1].name == "end" else "lost"


def prepare_resume(folder: RunFolder) -> int:
    """Check that the run can be resumed, and return the first step.

    Raises `RunFolderError`: the recipe or the rig differs from the beginning, another version wrote the run, or
    everything is done.
    """
    notes, contents = folder.notes(), folder.events()
    now = {"recipe": folder.recipe().fingerprint, "rig": _tables(folder.rig()), "version": version("gradcal_jax")}
    if others := [name for name, value in now.items() if notes.get(name) != value]:
        raise RunFolderError(
            f"The run in {folder.path} began with another {' and '.join(others)}: restore it, or begin a new run."
        )
    if exit_status(contents) == "success":
        raise RunFolderError(f"The run in {folder.path} is complete; make its log with `gradcal log {folder.path}`.")
    return steps_done(contents)


def breaks_off(event: Event) -> bool:
    """Whether a step is interrupted or the run ends here: from now on a person may be at the rig."""
    return event.name in ("interlock", "ending", "not done")
