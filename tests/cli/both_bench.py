"""A folder in which the command lines of features are run, in this process, for one gyro axis or for an IMU."""

import contextlib
import io
import json
import shlex
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.image
import numpy as np
import pytest
from both_kinds import FEATURES, KINDS
from both_specs import write_files

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.spec.spec import read_spec
from gradcal_jax.sweeps.pool import Task, TaskRunner
from gradcal_jax.sweeps.worker import do

BY_NAME = {feature.name: feature for feature in FEATURES}


class Answer(NamedTuple):
    """What one command line gave."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)

    @property
    def rows(self) -> dict[str, dict[str, Any]]:
        """The requirements of a prediction, by name."""
        return {row["name"]: row for row in self.json["requirements"]}


class InThisProcess(TaskRunner):
    """Does the tasks of a sweep here, where searches are short (see `benches`)."""

    workers = 1

    def __init__(self, *_: object) -> None:
        pass

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[int, Any]]:
        """One after the other."""
        return ((task.key, do(task.name, task.arguments)) for task in tasks)

    def close(self) -> None:
        pass


class FeatureBench:
    """The folder of one kind, and the answers so far: a feature that others need is run once.

    `prepared`: of features, what has to lie in the folder before their commands, and no command makes.
    """

    def __init__(self, kind: str, folder: Path, prepared: dict[str, Callable[["FeatureBench"], None]]) -> None:
        self.kind, self.folder, self.prepared = kind, folder, prepared
        self.answers: dict[str, list[Answer]] = {}
        write_files(kind, folder)

    @property
    def spec(self) -> gj.Spec:
        return read_spec(self.folder / "spec.toml")

    @property
    def of_imu(self) -> bool:
        return self.kind == "IMU"

    @property
    def gyros(self) -> str:
        """Their axes."""
        return "xyz" if self.of_imu else "x"

    @property
    def channels(self) -> set[str]:
        """The sensors, as coefficients name them."""
        kinds = ("gyro", "accelerometer") if self.of_imu else ("gyro",)
        return {f"{kind}_{axis}" for kind in kinds for axis in self.gyros}

    def predicted(self, name: str) -> dict[str, float]:
        """What `gj.predict` says of a spec or recipe: each requirement's statistic with the terms of the spec."""
        path = self.folder / name
        is_recipe = 'format = "gradcal-recipe' in path.read_text(encoding="utf-8")
        spec = read_recipe(path).spec if is_recipe else read_spec(path)
        return {row.name: row.decisive for row in gj.predict(spec).requirements if row.decisive is not None}

    def say(self, line: str) -> Answer:
        """A command line in the folder. Whether a target is met is the test's business."""
        out, err = io.StringIO(), io.StringIO()
        words = shlex.split(line.replace("PRESET", "drone-imu" if self.of_imu else "drone-gyro"))
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main(words)
        assert status == 2 if "wrong.toml" in words else status in (0, 1), (line, out.getvalue(), err.getvalue())
        return Answer(status, out.getvalue(), err.getvalue())

    def done(self, name: str) -> list[Answer]:
        """The answers of a feature's commands."""
        if name not in self.answers:
            for before in BY_NAME[name].after:
                self.done(before)
            if name in self.prepared:
                self.prepared[name](self)
            self.answers[name] = [self.say(line) for line in BY_NAME[name].commands]
        return self.answers[name]


Check = Callable[[FeatureBench, list[Answer]], None]


class Checks(dict[str, Check]):
    """Checks by the name of their feature."""

    def of(self, name: str) -> Callable[[Check], Check]:
        """Decorator: the check of a feature."""

        def register(check: Check) -> Check:
            assert name not in self
            self[name] = check
            return check

        return register

    def cells(self) -> list[Any]:
        """Parameters of a test: name and kind of every cell that works."""
        return [
            pytest.param(name, kind, id=f"{kind}, {name}", marks=[pytest.mark.long] if kind in feature.long else [])
            for kind in KINDS
            for name, feature in BY_NAME.items()
            if name in self and kind not in feature.missing
        ]


@contextlib.contextmanager
def benches(folder: Path, prepared: dict[str, Callable[[FeatureBench], None]]):
    """A bench of each kind; what is compiled stays out of the user's cache, and searches of poses are short."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        for number in ("EVALUATIONS", "QUICK_EVALUATIONS"):
            patch.setattr(f"gradcal_jax.design.optimise.{number}", 60)
        patch.setattr("gradcal_jax.sweeps.pool.LocalPool", InThisProcess)
        made: dict[str, FeatureBench] = {}
        for kind in KINDS:
            (folder / kind).mkdir()
            made[kind] = FeatureBench(kind, folder / kind, prepared)
        yield made


def named(row: dict[str, Any]) -> float:
    """A requirement's deciding statistic with the terms of the spec alone."""
    return float(row[row["statistic"].replace(" ", "_")])


def drawn(path: Path) -> bool:
    """Whether a picture has more than a few colours."""
    pixels = matplotlib.image.imread(path)
    return len(np.unique(pixels.reshape(-1, pixels.shape[-1]), axis=0)) > 20
