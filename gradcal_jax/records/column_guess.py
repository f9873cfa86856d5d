"""A column map for a recording without one: an example, and a guess from the header."""

import contextlib
import gzip
import importlib
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np

from gradcal_jax import units
from gradcal_jax.records.log import LogError
from gradcal_jax.records.tables import ForceColumn, Measured, RateColumn
from gradcal_jax.spec import presets

EXAMPLE: Final = presets.template("columns.toml")

_FORMAT: Final = 'format = "gradcal-columns/1"'
_TIME: Final = re.compile(
    r"(time|stamp|timestamp|seconds_elapsed|sampletimefine|t)(?:[ _\-(\[]*(ns|us|µs|ms|s|sec|seconds))?[)\]]*",
    re.IGNORECASE,
)
_TEMPERATURE: Final = re.compile(r"(temp|temperature|t)(?:[ _\-(\[]*(?:deg|°)?[ _]?(c|f))?[)\]]*", re.IGNORECASE)
_OF_RATE: Final = (
    r"(?:gyro?(?:scope|adc|unfilt)?|gyr|rate|omega|w|w_rs_s|g|angular[ _.]?velocity|angvel|angularrate|rot(?:ation)?)"
)
_OF_FORCE: Final = r"(?:(?:lin(?:ear)?[ _.]?)?acc(?:el(?:erometer|eration)?|smooth)?|a|a_rs_s|specific[ _]?force|f)"
_RATE_UNIT: Final = r"(deg/s(?:ec)?|dps|°/s(?:ec)?|mdps|rad/s(?:ec)?|rad s\^-1|rps|rad_s|deg_s|deg/h)"
_FORCE_UNIT: Final = r"(m/s\^?2|m/s²|m s\^-2|m/s/s|ms2|m_s2|mg|g)"
# The axis behind the name ("gyro_x", "gyroADC[0]", "scaledGyroX"), or before it ("xRate").
_RATE: Final = re.compile(
    rf"(?:scaled)?(?:{_OF_RATE}[ _.\-\[]?(?P<a>[xyz012])\]?|(?P<b>[xyz])[ _]?(?:rate|gyro|angrate))"
    rf"(?:[ _\-(\[]*{_RATE_UNIT})?[)\]]*",
    re.IGNORECASE,
)
_FORCE: Final = re.compile(
    rf"(?:scaled)?(?:{_OF_FORCE}[ _.\-\[]?(?P<a>[xyz012])\]?|(?P<b>[xyz])[ _]?(?:acc(?:el)?))"
    rf"(?:[ _\-(\[]*{_FORCE_UNIT})?[)\]]*",
    re.IGNORECASE,
)
# Text lines of receivers, by their first field: the numbers of the columns, and their unit.
_SENTENCES: Final = {
    "$VNYMR": {"rate": (10, 11, 12), "force": (7, 8, 9)},
    "$VNIMU": {"rate": (7, 8, 9), "force": (4, 5, 6), "temperature": (10,)},
}
_RAWIMUS: Final = """time = { column = 3, unit = "s" }
# counts of angle and velocity increments; scale: the IMU's factor (rad or m/s per count) times its sample rate in Hz
rate.x = { column = 10, unit = "rad/s", scale = ??? }
rate.y = { column = 9, unit = "rad/s", scale = -??? }
rate.z = { column = 8, unit = "rad/s", scale = ??? }
force.x = { column = 7, unit = "m/s^2", scale = ??? }
force.y = { column = 6, unit = "m/s^2", scale = -??? }
force.z = { column = 5, unit = "m/s^2", scale = ??? }"""
# A phone's file of one sensor, whose name alone says which: "time,seconds_elapsed,z,y,x", in SI.
_PHONE: Final = {"seconds_elapsed", "x", "y", "z"}
# By what names are tried for, and in the order of a map.
_KINDS: Final = {"rate": _RATE, "force": _FORCE, "time": _TIME, "temperature": _TEMPERATURE}
_ORDER: Final = ("time", "temperature", "rate", "force")
_UNITS: Final = {
    "m/s2": "m/s^2", "m/s²": "m/s^2", "ms2": "m/s^2", "m_s2": "m/s^2",
    "rad s^-1": "rad/s", "m s^-2": "m/s^2", "m/s/s": "m/s^2",
    "mdps": "mdeg/s", "deg/sec": "deg/s", "rad/sec": "rad/s", "°/sec": "deg/s",
    "sec": "s", "seconds": "s", "µs": "us", "dps": "deg/s", "°/s": "deg/s", "deg_s": "deg/s", "rps": "rad/s",
    "rad_s": "rad/s", "c": "degC", "f": "degF",
}  # fmt: skip
# A unit in brackets at the end of a name, and powers behind a stroke.
_BRACKET: Final = re.compile(r"[(\[]([^()\[\]]+)[)\]]\s*$")
_POWER: Final = {"1": "", "2": "^2", "3": "^3"}
_COUNTS: Final = re.compile(r"(?:raw|lsb|counts?|cnts?|ticks?|digits?|adc|int16)", re.IGNORECASE)
_AXIS: Final = r"[ _.\-\[]*[xyz0-2]\]?"
# Names that leave no doubt.
_QUANTITIES: Final = {
    quantity: re.compile(pattern, re.IGNORECASE)
    for quantity, pattern in {
        "a rate": rf"(?:gyro?(?:scope)?|ang(?:ular)?[ _.]?(?:velocity|vel|rate)|omega){_AXIS}",
        "a specific force": rf"(?:lin(?:ear)?[ _.]?)?acc(?:el(?:eration|erometer)?)?{_AXIS}",
        "a quaternion": r"q(?:uat(?:ernion)?)?[ _.\-\[]*[wxyz0-3]\]?|orientation[ _.]?[wxyz]",
        "an angle": rf"roll|pitch|yaw|heading|azimuth|(?:euler|angle)[ _.\-]?(?:roll|pitch|yaw)|(?:euler|angle){_AXIS}",
        "a magnetic field": rf"mag(?:net(?:ic|ometer)?)?(?:[ _.]?field)?{_AXIS}",
    }.items()
}


def without_a_map(path: Path) -> LogError:
    """The error for a recording without a column map: what to do, with a guess from its header if possible."""
    problem = (
        f"{path} is not a log of this program (.nc): describe its columns in a column map, and give the map with "
        "--columns"
    )
    example = "gradcal new column-map -o columns.toml writes one to start from"
    try:
        columns = guess(path)
    except (OSError, ValueError, ImportError):
        columns = None
    if columns is None:
        return LogError(f"{problem}; {example}")
    return LogError(f"{problem}; {example}. A guess from the header of the file; replace every ???:\n\n{columns}")


def guess(path: Path) -> str | None:
    """A column map in TOML from the header of a text table (or the names in an .npz or Parquet file), or from the first
    field of lines without one; None if that is not enough. Units without a hint are ???, to be completed by the user.
    """
    begin = _first_lines(path)
    for line in begin:
        if (sentence := line.split(",")[0]) in _SENTENCES:
            return _of_sentence(sentence)
        if sentence == "%RAWIMUSA":
            return f'{_FORMAT}\n{_RAWIMUS}\n[csv]\nheader = false\nlines = "^%RAWIMUSA"'
    names, delimiter = _names(path, begin)
    columns: dict[str, tuple[str, str]] = {}
    if set(names) >= _PHONE and "gyro" in path.stem.lower():
        columns = {f"rate.{axis}": (axis, "rad/s") for axis in "xyz"} | {"time": ("seconds_elapsed", "s")}
    for name in [] if columns else names:
        for kind, pattern in _KINDS.items():
            if match := pattern.fullmatch(name):
                key = f"{kind}.{_axis(match)}" if kind in ("rate", "force") else kind
                if key not in columns:
                    columns[key] = (name, _unit(match[pattern.groups]))
                    break
    if not any(key.startswith("rate.") for key in columns):
        return None
    lines = [_FORMAT, *([] if "time" in columns else ['sample_rate = "???"'])]
    order = sorted(columns, key=lambda key: (_ORDER.index(key.split(".")[0]), key))
    lines += [_line(key, *columns[key]) for key in order]
    if delimiter not in (None, ","):
        lines += ["[csv]", f'delimiter = "{delimiter}"']
    return "\n".join(lines)


def _of_sentence(sentence: str) -> str:
    lines = [_FORMAT, 'sample_rate = "???"']
    units_of = {"rate": "rad/s", "force": "m/s^2", "temperature": "degC"}
    for kind, places in _SENTENCES[sentence].items():
        for place, axis in zip(places, "xyz", strict=False):
            key = kind if kind == "temperature" else f"{kind}.{axis}"
            lines.append(f'{key} = {{ column = {place}, unit = "{units_of[kind]}" }}')
    return "\n".join([*lines, "[csv]", "header = false", f"lines = '^{re.escape(sentence)},'"])


def _axis(match: re.Match[str]) -> str:
    text = (match["a"] or match["b"]).lower()
    return "xyz"[int(text)] if text.isdigit() else text


def contradiction(column: str, unit: str) -> str | None:
    """A question where the name of a column says another unit than its map, as in "Gyroscope x (rad/s)" or
    "w_x [rad s^-1]"; None where it says none."""
    match = _RATE.fullmatch(column) or _TIME.fullmatch(column)
    text = match[match.re.groups] if match is not None else None
    if text is None and (bracket := _BRACKET.search(column)):
        text = bracket[1]
    named = _in_words_of_maps(text) if text else None
    if named is None or named == unit:
        return None
    with contextlib.suppress(units.UnitError):
        if abs(units.convert(1.0, named, unit) - 1.0) < 1e-9:
            return None
    return (
        f"the name of column '{column}' states the unit {text}, and the column map states {unit}: which of the two "
        "is correct?"
    )


def question_of(name: str, source: Measured) -> str | None:
    """A question where a column's name says another quantity than its map, or another unit; None where neither."""
    own = "a rate" if isinstance(source, RateColumn) else "a specific force" if isinstance(source, ForceColumn) else ""
    plain = _BRACKET.sub("", name).strip()
    for quantity, pattern in _QUANTITIES.items():
        if own and quantity != own and pattern.fullmatch(plain):
            return (
                f"the name of column '{name}' states {quantity}, and the column map states {own}: which of the two "
                "is correct?"
            )
    bracket = _BRACKET.search(name)
    if source.scale != 1.0:
        return None
    if bracket and _COUNTS.fullmatch(bracket[1].strip()):
        return (
            f"the name of column '{name}' states counts, and the column map states {source.unit}: give the scale of "
            "one count"
        )
    return contradiction(name, source.unit)


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


def _first_lines(path: Path) -> list[str]:
    if path.suffix.lower() in (".npz", ".parquet"):
        return []
    text = gzip.open if path.suffix.lower() == ".gz" else open
    with text(path, "rt", encoding="utf-8-sig") as lines:
        return [line[:2000].lstrip("# ").strip() for line in islice(lines, 60)]


def _names(path: Path, begin: Sequence[str]) -> tuple[list[str], str | None]:
    """The names of the columns, and their delimiter."""
    if path.suffix.lower() == ".npz":
        with path.open("rb") as file, np.load(file, allow_pickle=False) as opened:
            return list(opened.files), None
    if path.suffix.lower() == ".parquet":
        parquet: Any = importlib.import_module("pyarrow.parquet")
        return list(parquet.read_schema(path).names), None
    for line in begin:
        for delimiter, mark in ((";", ";"), ("tab", "\t"), (",", ","), ("whitespace", None)):
            names = [name.strip().strip('"') for name in line.split(mark)]
            if len(names) > 1 and (any(_RATE.fullmatch(name) for name in names) or set(names) >= _PHONE):
                return names, delimiter
    return [], None
