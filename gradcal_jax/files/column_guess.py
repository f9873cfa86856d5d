"""A column map for a recording without one: an example, and a guess from the header."""

import contextlib
import re
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np

from gradcal_jax import units
from gradcal_jax.files import presets
from gradcal_jax.files.log import LogError

EXAMPLE: Final = presets.template("columns.toml")

_TIME: Final = re.compile(r"(time|stamp|timestamp|t)(?:[ _\-(\[]*(ns|us|µs|ms|s|sec|seconds))?[)\]]*", re.IGNORECASE)
_TEMPERATURE: Final = re.compile(r"(temp|temperature|t)(?:[ _\-(\[]*(?:deg|°)?[ _]?(c|f))?[)\]]*", re.IGNORECASE)
_RATE: Final = re.compile(
    r"(?:gyro?|gyr|rate|omega|w|g|angular[ _]?velocity|rot)[ _.\-]?([xyz])"
    r"(?:[ _\-(\[]*(deg/s|dps|°/s|mdps|rad/s|rps|rad_s|deg_s|deg/h))?[)\]]*",
    re.IGNORECASE,
)
_FORCE: Final = re.compile(
    r"(?:acc(?:el(?:erometer)?)?|a|specific[ _]?force|f)[ _.\-]?([xyz])"
    r"(?:[ _\-(\[]*(m/s\^?2|m/s²|ms2|m_s2|mg|g))?[)\]]*",
    re.IGNORECASE,
)
# By what names are tried for, and in the order of a map.
_KINDS: Final = {"rate": _RATE, "force": _FORCE, "time": _TIME, "temperature": _TEMPERATURE}
_ORDER: Final = ("time", "temperature", "rate", "force")
_UNITS: Final = {
    "m/s2": "m/s^2", "m/s²": "m/s^2", "ms2": "m/s^2", "m_s2": "m/s^2",
    "mdps": "mdeg/s", "deg/sec": "deg/s", "rad/sec": "rad/s", "°/sec": "deg/s",
    "sec": "s", "seconds": "s", "µs": "us", "dps": "deg/s", "°/s": "deg/s", "deg_s": "deg/s", "rps": "rad/s",
    "rad_s": "rad/s", "c": "degC", "f": "degF",
}  # fmt: skip
# A unit in brackets at the end of a name, and powers behind a stroke.
_BRACKET: Final = re.compile(r"[(\[]([^()\[\]]+)[)\]]\s*$")
_POWER: Final = {"1": "", "2": "^2", "3": "^3"}


def without_a_map(path: Path) -> LogError:
    """The error for a recording without a column map: what to do, with a guess from its header if possible."""
    problem = f"{path} is no log of this program (.nc): say what its columns mean in a file and give it with --columns"
    example = "gradcal new column-map -o columns.toml writes one to start from"
    try:
        columns = guess(path)
    except (OSError, ValueError):
        columns = None
    if columns is None:
        return LogError(f"{problem}; {example}")
    return LogError(f"{problem}; {example}. A guess from its header, to be completed where it says ???:\n\n{columns}")


def guess(path: Path) -> str | None:
    """A column map in TOML from the header of a text table (or the names in an .npz); None if that is not enough.
    Units without a hint in the name are ???, to be completed by the user."""
    names, delimiter = _names(path)
    columns: dict[str, tuple[str, str]] = {}
    for name in names:
        for kind, pattern in _KINDS.items():
            if match := pattern.fullmatch(name):
                key = f"{kind}.{match[1].lower()}" if kind in ("rate", "force") else kind
                if key not in columns:
                    columns[key] = (name, _unit(match[2]))
                    break
    if not any(key.startswith("rate.") for key in columns):
        return None
    lines = ['format = "gradcal-columns/1"', *([] if "time" in columns else ['sample_rate = "???"'])]
    order = sorted(columns, key=lambda key: (_ORDER.index(key.split(".")[0]), key))
    lines += [_line(key, *columns[key]) for key in order]
    if delimiter not in (None, ","):
        lines += ["[csv]", f'delimiter = "{delimiter}"']
    return "\n".join(lines)


def contradiction(column: str, unit: str) -> str | None:
    """A question where the name of a column says another unit than its map, as in "Gyroscope x (rad/s)" or
    "w_x [rad s^-1]"; None where it says none."""
    match = _RATE.fullmatch(column) or _TIME.fullmatch(column)
    text = match[2] if match is not None and match[2] else None
    if text is None and (bracket := _BRACKET.search(column)):
        text = bracket[1]
    named = _in_words_of_maps(text) if text else None
    if named is None or named == unit:
        return None
    with contextlib.suppress(units.UnitError):
        if abs(units.convert(1.0, named, unit) - 1.0) < 1e-9:
            return None
    return f"the name of column '{column}' says {text}, and the map says {unit}: which of them is right?"


def _in_words_of_maps(text: str) -> str | None:
    """A unit as people write it in a header, as this program writes it; None where it is none."""
    plain = text.strip().replace("²", "^2").replace("⁻", "^-").replace("¹", "1").replace("·", " ").replace("*", " ")
    plain = re.sub(r"\bsec(onds?)?\b", "s", plain.replace("µ", "u").replace("μ", "u"))
    plain = _UNITS.get(plain.lower(), plain.removeprefix("°") if plain in ("°C", "°F") else plain)
    plain = {"C": "degC", "F": "degF", "G": "g"}.get(plain, plain).replace("°", "deg").replace("m/s/s", "m/s^2")
    # Factors with negative powers stand behind the stroke.
    above, below = list[str](), list[str]()
    for factor in plain.split():
        power = re.fullmatch(r"([A-Za-z]+)\^?-(\d)", factor)
        (above if power is None else below).append(factor if power is None else power[1] + _POWER[power[2]])
    known = "/".join(["·".join(above), *below]) if above else ""
    try:
        units.dimension_of(known)
    except units.UnitError:
        return None
    return known if re.search("[A-Za-z]", known) else None


def _unit(text: str | None) -> str:
    return "???" if text is None else _UNITS.get(text.lower(), text.lower())


def _line(key: str, column: str, unit: str) -> str:
    escaped = column.replace("\\", "\\\\").replace('"', '\\"')
    return f'{key} = {{ column = "{escaped}", unit = "{unit}" }}'


def _names(path: Path) -> tuple[list[str], str | None]:
    """The names of the columns, and their delimiter."""
    if path.suffix.lower() == ".npz":
        with path.open("rb") as file, np.load(file, allow_pickle=False) as opened:
            return list(opened.files), None
    with path.open(encoding="utf-8-sig") as opened:
        for line in (line[:2000].lstrip("# ").strip() for line in islice(opened, 20)):
            for delimiter, mark in ((";", ";"), ("tab", "\t"), (",", ","), ("whitespace", None)):
                names = [name.strip().strip('"') for name in line.split(mark)]
                if len(names) > 1 and any(_RATE.fullmatch(name) for name in names):
                    return names, delimiter
    return [], None
