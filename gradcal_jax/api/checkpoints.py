"""Checkpoint files of interrupted optimisations; each belongs to one spec."""

import hashlib
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gradcal_jax.files import to_toml
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.files.writing import whole

_FORMAT = "gradcal-search/1"


def write_checkpoint(path: Path, spec: Spec, checkpoint: Mapping[str, np.ndarray]) -> None:
    """Write a checkpoint, atomically."""
    arrays = {**checkpoint, "format": np.array(_FORMAT), "spec": np.array(_fingerprint(spec))}
    with whole(path) as passing, passing.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def read(path: Path, spec: Spec) -> dict[str, np.ndarray]:
    """Read the checkpoint of a spec. Errors: `ValueError` for a file of another spec or format."""
    if not path.exists():
        raise ValueError(f"there is no interrupted search to continue: {path} does not exist")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if str(arrays["format"]) != _FORMAT:
            raise ValueError(f"{path} is not a search saved by optimise")
        if str(arrays["spec"]) != _fingerprint(spec):
            raise ValueError(f"{path} was saved for another spec: start again, without --resume")
        return arrays
    except (OSError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(
            f"{path} cannot be read as a search saved by optimise: start again, without --resume"
        ) from error


def _fingerprint(spec: Spec) -> str:
    return hashlib.sha256(to_toml(spec).encode()).hexdigest()
