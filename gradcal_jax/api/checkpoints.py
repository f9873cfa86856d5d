"""Checkpoint files of interrupted optimisations; each belongs to one spec."""

import hashlib
import zipfile
from pathlib import Path

import numpy as np

from gradcal_jax.api.optimise import Checkpoint
from gradcal_jax.design import SearchState
from gradcal_jax.files import Spec, to_toml
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.files.writing import whole

_FORMAT = "gradcal-search/1"


def write_checkpoint(path: Path, spec: Spec | UnitSpec, checkpoint: Checkpoint) -> None:
    """Write a checkpoint, atomically."""
    arrays: dict[str, np.ndarray] = {"format": np.array(_FORMAT), "spec": np.array(_fingerprint(spec))}
    arrays["at"] = np.array([checkpoint.structure, checkpoint.best_structure])
    for name, state in (("state", checkpoint.state), ("best", checkpoint.best)):
        arrays |= {f"{name}_{field}": np.asarray(entry) for field, entry in state._asdict().items()}
    with whole(path) as passing, passing.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def read(path: Path, spec: Spec | UnitSpec) -> Checkpoint:
    """Read the checkpoint of a spec. Errors: `ValueError` for a file of another spec or format."""
    if not path.exists():
        raise ValueError(f"there is no interrupted search to go on from: {path} does not exist")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if str(arrays["format"]) != _FORMAT:
            raise ValueError(f"{path} is not a search kept by optimise")
        if str(arrays["spec"]) != _fingerprint(spec):
            raise ValueError(f"{path} was kept for another spec: start anew, without --resume")
        states = []
        for name in ("state", "best"):
            of = {field: arrays[f"{name}_{field}"] for field in SearchState._fields}
            numbers = int(of["step"]), float(of["first"]), float(of["best"])
            states.append(SearchState(of["points"], of["values"], *numbers, of["best_point"]))
        at = [int(k) for k in arrays["at"]]
    except (OSError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"{path} cannot be read as a search kept by optimise: start anew, without --resume") from error
    return Checkpoint(at[0], states[0], at[1], states[1])


def _fingerprint(spec: Spec | UnitSpec) -> str:
    return hashlib.sha256(to_toml(spec).encode()).hexdigest()
