"""Finished chunks on the disk: a folder beside the output, from which a killed sweep goes on."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

from gradcal_jax.files.writing import write_whole
from gradcal_jax.jobs.results import PointResult, results_as_json, results_from_json


class Store:
    """The chunks of one sweep. Errors: `ValueError` where the folder holds another sweep's."""

    def __init__(self, output: Path, identity: dict[str, Any]):
        self.folder = output.with_name(output.name + ".parts")
        self._identity = identity
        mark = self.folder / "sweep.json"
        if mark.is_file():
            try:
                there = json.loads(mark.read_text(encoding="utf-8"))
            except ValueError:
                there = {}
            if there != identity:
                changed = ", ".join(k for k in {**there, **identity} if there.get(k) != identity.get(k))
                raise ValueError(
                    f"{self.folder} holds parts of another sweep (different: {changed}); delete it to begin anew, or "
                    "choose another output"
                )
        elif self.folder.exists() and any(self.folder.iterdir()):
            raise ValueError(f"{self.folder} exists and is not a sweep's; move it away, or choose another output")
        else:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(mark, json.dumps(identity, indent=1))

    def read(self, chunk: int) -> list[PointResult] | None:
        """A finished chunk; None where it is not there, or not whole."""
        path = self._path(chunk)
        try:
            digest, _, body = path.read_text(encoding="utf-8").partition("\n")
            return results_from_json(body) if digest == _digest(body) else None
        except (OSError, ValueError, TypeError):
            return None

    def write(self, chunk: int, results: list[PointResult]) -> None:
        """Keep a finished chunk: wholly or not at all."""
        body = results_as_json(results)
        write_whole(self._path(chunk), f"{_digest(body)}\n{body}")

    def remove(self) -> None:
        """The folder, once its contents are in the output."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, chunk: int) -> Path:
        return self.folder / f"chunk-{chunk:06d}.json"


def _digest(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()
