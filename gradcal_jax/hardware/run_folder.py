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

from gradcal_jax.hardware.errors import WrongIdentity
from gradcal_jax.hardware.journal import Event, Journal, JournalContents, read_journal
from gradcal_jax.hardware.setup import Bench
from gradcal_jax.hardware.track import Track, track_of
from gradcal_jax.recipe.recipe import Recipe, read_recipe
from gradcal_jax.spec.changes import differences
from gradcal_jax.spec.rig import RigFile, read_rig, rig_of
from gradcal_jax.tables.problems import dotted
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

    def track(self, recipe: Recipe | None = None) -> Track:
        return track_of(recipe or self.recipe(), [axis.name for axis in self.rig().axis])

    def contents(self) -> JournalContents:
        return read_journal(self.journal_path)

    def events(self) -> JournalContents:
        return read_journal(self.journal_path, chunks=False)


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
    if (path / "journal").exists():
        raise RunFolderError(
            f"{path} already has a run: continue it with `gradcal run --resume {path}`, or name another folder."
        )
    if path.exists() and any(path.iterdir()):
        raise RunFolderError(f"{path} is not empty; name a new folder for the run.")
    path.mkdir(parents=True, exist_ok=True)
    write_toml(recipe, path / "recipe.toml")
    write_toml(rig, path / "rig.toml")
    notes: dict[str, Any] = {
        "format": FORMAT,
        "recipe": recipe.fingerprint,
        "rig": rig_tables(rig),
        "version": version("gradcal_jax"),
        "begun": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "simulated": simulated is not None,
        "simulation": simulated,
        "about": dict(about or {}),
    }
    write_whole(path / "run.json", json.dumps(notes, indent=2) + "\n")
    return RunFolder(path)


def rig_tables(rig: RigFile) -> dict[str, Any]:
    return rig.model_dump(mode="json", exclude_unset=True)


def rig_as_run(contents: JournalContents, rig: RigFile) -> RigFile:
    """The rig that the run began with, from its journal; `rig` where the journal has none: a later change of the rig
    file does not change the meaning of the recorded bytes."""
    for event in contents.events:
        if event.name == SESSION and isinstance(event.data.get("rig"), dict):
            return rig_of(event.data["rig"], "the rig in the journal")
    return rig


def begin_session(
    journal: Journal, now_s: float, number: int, rig: RigFile, *, simulated: bool, first_step: int
) -> None:
    """Write the event that begins a session, with the wall clock beside the monotonic one."""
    part: dict[str, Any] = {"number": number, "first_step": first_step, "wall_clock_s": time.time()}
    journal.event(now_s, SESSION, **part, simulated=simulated, version=version("gradcal_jax"), rig=rig_tables(rig))


def sessions(contents: JournalContents) -> int:
    return sum(event.name == SESSION for event in contents.events)


def steps_done(contents: JournalContents) -> int:
    """The step of the recipe at which to resume: one after the last that is done."""
    done = 0
    for event in contents.events:
        if event.name == "step done":
            done = max(done, int(event.data["number"]) + 1)
    return done


def mounting_of(contents: JournalContents) -> int:
    """How the units hang, as `Step.mounting`; 0 where the operator was not asked to hang them."""
    return next((int(event.data["mounting"]) for event in reversed(contents.events) if event.name == "hung"), 0)


def exit_status(contents: JournalContents) -> str:
    """The last session's exit status: "success", "aborted", or "lost" where the journal has no end."""
    ends = [event for event in contents.events if event.name in (SESSION, "end")]
    return str(ends[-1].data.get("exit_status", "lost")) if ends and ends[-1].name == "end" else "lost"


def prepare_resume(folder: RunFolder) -> int:
    """Check that the run can be resumed, and return the first step.

    Raises `RunFolderError`: the recipe or the rig differs from the beginning, another version wrote the run, or
    everything is done.
    """
    notes, here = folder.notes(), version("gradcal_jax")
    restore = f"the one that the run in {folder.path} began with"
    if notes.get("recipe") != folder.recipe().fingerprint:
        raise RunFolderError(f"The recipe is not {restore}: restore it, or begin a new run.")
    changed = differences(notes.get("rig"), rig_tables(folder.rig()), ())
    if texts := [f"{dotted(key)} is {after!r} and was {before!r}" for key, before, after in changed]:
        raise RunFolderError(f"The rig is not {restore}: {'; '.join(texts)}. Restore it, or begin a new run.")
    if notes.get("version") != here:
        raise RunFolderError(
            f"The run was begun by gradcal {notes.get('version')}, but this is {here}: resume the run with the "
            "version that began it."
        )
    contents = folder.events()
    if exit_status(contents) == "success":
        raise RunFolderError(f"The run in {folder.path} is complete; make its log with `gradcal log {folder.path}`.")
    return steps_done(contents)


def require_same_devices(bench: Bench, contents: JournalContents) -> None:
    """Compare the devices with those at the beginning of the run. Raises `WrongIdentity`."""
    # Of several sessions the first counts.
    known = {str(event.data["device"]): event.data for event in reversed(contents.events) if event.name == "identity"}
    names = ("driver", "model", "serial_number", "firmware")
    for device_name, entry, device in bench.devices():
        now, then = vars(device.identify()), known.get(device_name, {})
        if changed := [name for name in names if now[name] != then.get(name, now[name])]:
            words = [" ".join(str(of[name]) for name in changed) for of in (now, then)]
            raise WrongIdentity(
                f"{device_name} at {entry.port} is {words[0]}, but the run began with {words[1]}. Connect "
                "the device that the run began with, or begin a new run."
            )


def breaks_off(event: Event) -> bool:
    """Whether a step is interrupted or the run ends here: from now on a person may be at the rig."""
    return event.name in ("interlock", "ending", "not done")
