"""The recipes of a sweep with searches, and a table of them."""

import csv
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gradcal_jax.information.prediction import make_recipe
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.writing import to_toml, write_whole

if TYPE_CHECKING:
    import xarray

_HEADER: Final = "Made by gradcal sweep; `gradcal check` prints it as a table."
_COLUMNS: Final = ("requirement", "unit", "before", "now", "hours", "verdict", "limited_by", "search", "recipe")


def write_recipes(results: "xarray.Dataset", folder: str | Path) -> list[dict[str, Any]]:
    """Write a recipe for each point of a sweep with searches, `summary.csv` and `summary.md` (ppm, deg/h; 1σ) into
    `folder`; the rows of the summary, in the order of the points. A point without a plan has a row with the reason.

    Errors: `ValueError` for a sweep without searches, and where `folder` cannot be written to.
    """
    if "optimised_spec" not in results:
        raise ValueError('recipes are only possible for a sweep with do = "optimise"')
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"the folder {folder} for recipes cannot be used: {error.strerror}") from None
    rows = list(_rows(results, folder))
    stream = io.StringIO()
    names = list(rows[0])
    csv.writer(stream, lineterminator="\n").writerows([names, *([row[name] for name in names] for row in rows)])
    write_whole(folder / "summary.csv", stream.getvalue())
    write_whole(folder / "summary.md", as_markdown(rows, results.attrs["title"]))
    return rows


def _rows(results: "xarray.Dataset", folder: Path) -> Iterator[dict[str, Any]]:
    axes = [str(name) for name in results.coords]
    shape = results["failure"].shape
    for at in np.ndindex(shape):
        place = dict(zip(map(str, results["failure"].dims), at, strict=True))

        def value(name: str) -> Any:
            return results[name].values[tuple(place[str(dim)] for dim in results[name].dims)]  # noqa: B023

        case = {axis: value(axis) for axis in axes}
        named = {axis: str(x) if isinstance(x, str) else f"{x:.6g}" for axis, x in case.items()}
        row: dict[str, Any] = named | dict.fromkeys(_COLUMNS, "")
        if reason := str(value("failure")):
            yield row | {"search": reason}
            continue
        made = make_recipe(parse_spec(str(value("optimised_spec"))), status=str(value("convergence")))
        name = "__".join(slug(text.removesuffix(".toml")) for text in named.values()) + ".toml"
        write_whole(folder / name, to_toml(made, header=_HEADER))
        design = made.spec.design
        wanted = None if design is None else design.minimise
        rows = made.prediction.requirements
        decisive = next((one for one in rows if one.name == wanted), rows[0])
        yield row | {
            "requirement": decisive.name,
            "unit": decisive.unit,
            "before": float(value("objective_before")),
            "now": decisive.decisive,
            "hours": made.duration_s / 3600.0,
            "verdict": decisive.verdict or "",
            "limited_by": decisive.limited_by or "",
            "search": str(value("convergence")),
            "recipe": name,
        }


def slug(name: str) -> str:
    """A name for files: small letters, digits, hyphens; units' signs in words."""
    words = {"°": " deg", "″": " arcsec", "′": " arcmin", "√": " sqrt ", "µ": "u"}
    name = name.translate(str.maketrans(words))
    return re.sub(r"[^a-z0-9.]+", "-", name.casefold()).strip("-.") or "case"


def as_markdown(rows: list[dict[str, Any]], title: str | None) -> str:
    """The rows for people: four digits, and a link to each recipe."""
    axes = [name for name in rows[0] if name not in _COLUMNS]
    head = [*axes, "requirement", "as written", "optimised", "hours", "verdict", "limited by"]
    lines = [f"# {title or 'Recommended recipes'}", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for row in rows:
        cells = [row[axis] for axis in axes]
        if row["recipe"]:
            before, now = (f"{row[key]:.4g} {row['unit']}" for key in ("before", "now"))
            link, hours = f"[{now}]({row['recipe']})", f"{row['hours']:.3g} h"
            cells += [row["requirement"], before, link, hours, row["verdict"], row["limited_by"]]
        else:
            cells += ["", "", "no recipe", "", "", row["search"]]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
