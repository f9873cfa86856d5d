"""The results of a sweep's points: plain data, without JAX, for the process that distributes the tasks."""

import json
from typing import NamedTuple


class Residual(NamedTuple):
    """One requirement: the statistics (None: not defined, or not observable) in the order of `information.STATISTICS`
    and the unit of `api.UNIT_OF`; the verdict: "met", "missed", "unobservable" or ""."""

    requirement: int
    values: tuple[float | None, ...]
    verdict: str


class PointResult(NamedTuple):
    """The result of a point. `failure`: the reason where there is none; `note` and `spec` are of an optimised point."""

    point: int
    failure: str = ""
    duration_s: float = 0.0
    soak_s: float = 0.0
    motion_s: float = 0.0
    residuals: tuple[Residual, ...] = ()
    before: float | None = None
    note: str = ""
    spec: str = ""


def results_as_json(results: list[PointResult]) -> str:
    """Results as JSON, without loss."""
    return json.dumps([[*r[:5], [list(row) for row in r.residuals], *r[6:]] for r in results], allow_nan=False)


def results_from_json(text: str) -> list[PointResult]:
    """The results in a text of `results_as_json`."""
    rows = json.loads(text)
    read = ([*r[:5], tuple(Residual(a, tuple(b), c) for a, b, c in r[5]), *r[6:]] for r in rows)
    return [PointResult._make(row) for row in read]


def one_line(error: BaseException) -> str:
    """An error's sentence, without line breaks."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: {text}"
