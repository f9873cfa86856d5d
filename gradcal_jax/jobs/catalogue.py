"""Recipes for every case of a catalogue, with a summary table; an interrupted job resumes where it stopped."""

import csv
import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gradcal_jax.display import summary
from gradcal_jax.files import tables_of
from gradcal_jax.files.catalogue import Catalogue, CatalogueCase
from gradcal_jax.files.writing import write_whole
from gradcal_jax.jobs.pool import JobProgress, Report, Task, TaskRunner, borrowed, unwatched
from gradcal_jax.jobs.sweep import versions

_COLUMNS: Final[tuple[str, ...]] = (
    "sensor", "rig", "requirement", "plan", "objective", "unit", "before", "now", "limit", "efficiency", "hours",
    "verdict", "limited_by", "converged", "recipe", "remark",
)  # fmt: skip


@dataclass(frozen=True)
class RecipeTable:
    """The rows of a summary, by requirement, sensor and residual; `failed` have no recipe."""

    rows: tuple[dict[str, Any], ...]
    kept: int

    __repr__ = summary

    @property
    def failed(self) -> int:
        """Cases without a recipe; the remark says why."""
        return sum(not row["recipe"] for row in self.rows)


def recipes(
    job: Catalogue, folder: str | Path, *, runner: TaskRunner | None = None, progress: Report = unwatched
) -> RecipeTable:
    """Write `<case>.toml` for every case, `summary.csv` and `summary.md` (ppm, deg/h; 1σ) into `folder`.

    Finished cases are kept in `folder/.finished`, and not repeated while the case and the versions are the same.
    Errors: `ValueError` where `folder` cannot be written to.
    """
    folder = Path(folder)
    kept_in = folder / ".finished"
    try:
        kept_in.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder} cannot be a folder for recipes: {error.strerror}") from None
    identities = [identity_of_case(case) for case in job.cases]
    rows: dict[int, dict[str, Any]] = {}
    for number, case in enumerate(job.cases):
        if case.spec is None:
            rows[number] = _failed(case, case.failure)
            continue
        row = _kept(kept_in / f"{case.slug}.json", identities[number])
        if row is not None and (not row["recipe"] or (folder / row["recipe"]).is_file()):
            rows[number] = row
    kept = len(rows)
    progress(JobProgress("optimise", kept, len(job.cases), kept))
    tasks = [
        Task(number, "recommend", (tables_of(case.spec),))
        for number, case in enumerate(job.cases)
        if number not in rows and case.spec is not None
    ]
    with borrowed(runner) as workers:
        for number, answer in workers.run(tasks):
            case = job.cases[number]
            if isinstance(answer, Exception):
                row = _failed(case, str(answer))
            else:
                name = f"{case.slug}.toml"
                write_whole(folder / name, answer.pop("toml"))
                row = _row(case, recipe=name, remark=answer.pop("sentence"), **answer)
            write_whole(kept_in / f"{case.slug}.json", json.dumps([identities[number], row], indent=1))
            rows[number] = row
            outcome = row["remark"] if not row["recipe"] else f"{row['now']:.4g} {row['unit']}"
            progress(JobProgress("optimise", len(rows), len(job.cases), kept, f"{', '.join(case.names)}: {outcome}"))
    table = RecipeTable(_ordered([rows[number] for number in range(len(job.cases))]), kept)
    write_whole(folder / "summary.csv", as_csv(table))
    write_whole(folder / "summary.md", as_markdown(table, job.file.title))
    return table


def identity_of_case(case: CatalogueCase) -> str:
    """A hash of a case and of the versions that compute it."""
    tables = None if case.spec is None else tables_of(case.spec)
    text = json.dumps([tables, versions()], sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _kept(path: Path, identity: str) -> dict[str, Any] | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        return record[1] if record[0] == identity else None
    except (OSError, ValueError, TypeError, LookupError):
        return None


def _row(case: CatalogueCase, **values: Any) -> dict[str, Any]:
    named = dict(zip(("sensor", "rig", "requirement", "plan"), case.names, strict=True))
    return {column: {**named, **values}.get(column) for column in _COLUMNS}


def _failed(case: CatalogueCase, reason: str) -> dict[str, Any]:
    return _row(case, recipe="", remark=reason, verdict="", limited_by="", objective="", unit="")


def _ordered(rows: list[dict[str, Any]]) -> tuple[dict[str, Any], ...]:
    """By requirement and sensor, then the best first; cases without a recipe last."""
    place = {name: k for k, name in enumerate(dict.fromkeys((r["requirement"], r["sensor"]) for r in rows))}

    def rank(row: dict[str, Any]) -> tuple:
        left = row["now"] is None, row["now"] or 0.0
        return place[row["requirement"], row["sensor"]], *left, row["rig"], row["plan"]

    return tuple(sorted(rows, key=rank))


def as_csv(table: RecipeTable) -> str:
    """The rows for other programs: numbers in full."""
    stream = io.StringIO()
    rows = ([row[column] for column in _COLUMNS] for row in table.rows)
    csv.writer(stream, lineterminator="\n").writerows((_COLUMNS, *rows))
    return stream.getvalue()


def as_markdown(table: RecipeTable, title: str | None) -> str:
    """The rows for people: four digits."""
    several = len({row["plan"] for row in table.rows}) > 1
    head = ["sensor", "rig", "requirement", *(["plan"] if several else []), "as written", "optimised", "hours"]
    limits = any(row["limit"] is not None for row in table.rows)
    head += ["no plan below", "efficiency"] if limits else []
    head += ["verdict", "limited by"]
    lines = [f"# {title or 'Recommended recipes'}", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for row in table.rows:
        recipe = f"[{_number(row['now'], row['unit'])}]({row['recipe']})" if row["recipe"] else "no recipe"
        cells = [row["sensor"], row["rig"], row["requirement"], *([row["plan"]] if several else [])]
        cells += [_number(row["before"], row["unit"]), recipe, _number(row["hours"], "h", 3)]
        if limits:
            share = row["efficiency"]
            cells += [_number(row["limit"], row["unit"]), "–" if share is None else f"{share:.0%}"]
        remark = row["limited_by"] if row["recipe"] else row["remark"]
        if row["recipe"] and not row["converged"]:
            remark = f"{remark}; {row['remark']}"
        lines.append(f"| {' | '.join(_cell(c) for c in [*cells, row['verdict'], remark])} |")
    lines += [
        "",
        "Residuals are predictions, one standard deviation, of the plans as rounded to the rigs' controllers.",
    ]
    return "\n".join(lines) + "\n"


def _number(value: float | None, unit: str, digits: int = 4) -> str:
    return "–" if value is None else f"{value:.{digits}g} {unit}"


def _cell(text: object) -> str:
    return str(text or "").replace("|", "/").replace("\n", " ")
