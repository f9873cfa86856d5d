"""The strict grammar of quantities: datasheet idioms, refusals, round trips, and pint where pint is right."""

import math
import string

import pint
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gradcal_jax.units import DIMENSIONS, UnitError, convert, dimension_of, format_quantity, parse, to_unit, unit_of
from gradcal_jax.units.symbols import SYMBOLS

DEG = math.pi / 180.0
ARW = "angle random walk"

IDIOMS = [
    ("10 deg/s", "angular rate", 10 * DEG),
    ("1°/hr", "angular rate", DEG / 3600),
    ("1 rpm", "angular rate", 2 * math.pi / 60),
    ("1 rad·s⁻¹", "angular rate", 1.0),
    ("300 deg/s^2", "angular acceleration", 300 * DEG),
    ("300 deg/(s·s)", "angular acceleration", 300 * DEG),
    ("0.1 deg/sqrt(h)", ARW, 0.1 * DEG / 60),
    ("0.1 °/√h", ARW, 0.1 * DEG / 60),
    ("0.1 deg/rt-hr", ARW, 0.1 * DEG / 60),
    ("0.1 deg/h^(1/2)", ARW, 0.1 * DEG / 60),
    ("6 deg/h/sqrt(Hz)", ARW, 0.1 * DEG / 60),
    ("6 deg/(h·√Hz)", ARW, 0.1 * DEG / 60),
    ("2 deg/h/sqrt(h)", "rate random walk", 2 * DEG / 3600 / 60),
    ('30 "', "angle", DEG / 120),
    ("50 \N{GREEK SMALL LETTER MU}rad", "angle", 50e-6),
    ("−30 °C", "temperature", -30.0),
    ("86 degF", "temperature", 30.0),
    ("1 K/min", "temperature slope", 1 / 60),
    ("80 ppm", "scale factor", 80e-6),
    ("0.1 %", "scale factor", 1e-3),
    ("3 deg/(h·K)", "bias slope", 3 * DEG / 3600),
    ("2 deg/h/(K/min)", "bias temperature-gradient sensitivity", 2 * DEG / 3600 * 60),
    ("10 °/h/g", "acceleration-sensitive drift", 10 * DEG / 3600 / 9.80665),
    ("50 µg/g²", "second-order coefficient", 50e-6 / 9.80665),
    ("10 mg", "acceleration", 0.0980665),
    ("0.1 m/s/√h", "velocity random walk", 0.1 / 60),
    (" 1e-3  rad ", "angle", 1e-3),
    ("1.5E2 s", "time", 150.0),
    ("10\N{NO-BREAK SPACE}s", "time", 10.0),
]


@pytest.mark.parametrize(("text", "dimension", "value"), IDIOMS)
def test_idioms_of_data_sheets_are_read_exactly(text, dimension, value):
    assert parse(text, dimension) == pytest.approx(value, rel=4e-16, abs=0.0)


REFUSED = [
    ("0.1 deg/sqrt(h)", "angular rate", "angle random walk"),
    ("20 K", "temperature", "degC"),
    ("20 degC", "temperature difference", "difference in K"),
    ("20", "temperature", "unit is missing"),
    ("20 C", "temperature", "unknown"),
    ("-300 degC", "temperature", "absolute zero"),
    ("1 degF/min", "temperature slope", "Fahrenheit"),
    ("", "time", "begin with a number"),
    ("0,1 deg", "angle", "point"),
    ("10 000 ppm", "scale factor", "separators"),
    ("±5 deg", "angle", "±"),
    ("nan deg", "angle", "finite"),
    ("1e99999999999 s", "time", "range"),
    ("5 deg s^-1", "angular rate", "does not belong to the unit"),
    ("3 deg/h·K", "bias slope", "parentheses"),
    ("9.8 m/s2", "acceleration", "not understood"),
    ("0.1 deg/h^1/2", ARW, "not understood"),
    ("0.1 deg/sqrt h", ARW, "unknown"),
    ("0.1 deg/√(√h)", ARW, "root of a root"),
    ("0.1 deg/sqrt(h", ARW, "closed"),
    ("0.1 deg/", "angle", "complete"),
    ("0.1 Deg/h", "angular rate", "nearest: 'deg'"),
    ("1 deg^(1/3)/s", "angular rate", "power"),
    ("1 deg 30 min", "angle", "not understood"),
    ("5 deg" + " " * 200 + "/s", "angular rate", "too long"),
    ("٣ s", "time", "begin with a number"),
]


@pytest.mark.parametrize(("text", "dimension", "reason"), REFUSED)
def test_what_is_not_understood_exactly_is_refused_with_a_reason_and_an_example(text, dimension, reason):
    with pytest.raises(UnitError) as caught:
        parse(text, dimension)
    message = str(caught.value)
    assert reason in message
    assert DIMENSIONS[dimension].example in message


def test_an_unknown_dimension_names_the_nearest():
    with pytest.raises(UnitError, match="nearest: 'angular rate'"):
        parse("1 deg/s", "angle rate")


MORE = {
    "angle": "arcmin arcsec mrad µrad turns",
    "angular rate": "deg/h °/h dps mdps rpm",
    "time": "min h ms µs d",
    "temperature": "°C degF",
    "temperature slope": "°C/min K/h",
    ARW: "°/√h deg/h/sqrt(Hz) dps/√Hz deg/√min",
    "scale factor": "ppb % ‰",
    "acceleration": "g µg",
    "velocity random walk": "µg/√Hz",
    "frequency": "kHz 1/s",
}
PAIRS = [
    (name, unit)
    for name, d in DIMENSIONS.items()
    for unit in dict.fromkeys((d.si, d.usual, *MORE.get(name, "").split()))
]
finite = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e250, max_value=1e250).filter(
    lambda x: x == 0.0 or abs(x) > 1e-250
)


@pytest.mark.parametrize("name", DIMENSIONS)
def test_every_dimension_reads_its_own_example_and_units(name):
    dimension = DIMENSIONS[name]
    assert math.isfinite(parse(dimension.example, name))
    assert parse(f"1 {dimension.si}", name) == 1.0
    assert dimension_of(dimension.usual) == name
    assert unit_of(dimension.example) in dimension.example


@settings(deadline=None)
@given(st.sampled_from(PAIRS), finite)
@example(("temperature", "degF"), 2.7e-109)
def test_what_is_written_reads_back_as_the_very_same_float(pair, value):
    dimension, unit = pair
    if dimension == "temperature":
        value = math.remainder(value, 270.0)
    text = format_quantity(value, unit)
    assert parse(text, dimension) == value
    assert unit_of(text) == unit.replace("µ", "u") or (unit == "degF" and abs(value) < 1e-9)


symbols = st.sampled_from([*SYMBOLS, "sqrt(", "√", "rt-", "^", "2", "0.5", "(", ")", "/", "·", "*", " ", "⁻¹", "²"])
noise = st.text(alphabet=string.printable + "°′″√µ·−²½⁻㎯∞", max_size=30)


@settings(deadline=None)
@given(st.one_of(noise, st.lists(symbols, max_size=8).map("".join)), st.sampled_from(list(DIMENSIONS)), finite)
@example("1e999999999", "time", 1.0)
def test_junk_is_a_quantity_or_a_unit_error_and_nothing_else(junk, dimension, number):
    described = DIMENSIONS[dimension].described
    for text in (junk, f"{number} {junk}"):
        try:
            value = parse(text, dimension)
        except UnitError as error:
            said = str(error)
            assert described in said
            continue
        # What was understood has one meaning: written in SI it reads the same.
        assert parse(format_quantity(value, DIMENSIONS[dimension].si), dimension) == value


# Names that pint shares and reads rightly: no g (gram), no mg (milligram), no ″, no √, no bare ° before a slash.
PINT = {
    "rad": "radian", "mrad": "mrad", "deg": "degree", "arcmin": "arcminute", "arcsec": "arcsecond", "rev": "turn",
    "s": "s", "ms": "ms", "us": "us", "min": "minute", "h": "hour", "d": "day", "K": "kelvin", "m": "m", "mm": "mm",
    "Hz": "Hz", "kHz": "kHz", "ppm": "ppm", "rpm": "rpm", "dps": "degree/second",
}  # fmt: skip
ureg = pint.UnitRegistry()
SI = {"angle": "rad", "time": "s", "temperature": "K", "length": "m"}
exponents = st.sampled_from([(1, "", 1.0), (2, "^2", 2.0), (-1, "^-1", -1.0), (0.5, "^0.5", 0.5), (0.5, "^(1/2)", 0.5)])


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(list(PINT)), exponents), min_size=1, max_size=2),
    st.lists(st.tuples(st.sampled_from(list(PINT)), exponents), max_size=2),
    st.floats(0.001, 1000.0),
)
def test_compound_units_agree_with_pint(top, bottom, number):
    ours = "·".join(name + power for name, (_, power, _) in top)
    theirs = " * ".join(f"({PINT[name]})**({exponent})" for name, (exponent, _, _) in top)
    for name, (exponent, power, _) in bottom:
        ours += f"/{name}{power}"
        theirs += f" / ({PINT[name]})**({exponent})"
    try:
        dimension = dimension_of(ours)
    except UnitError:
        return
    expected = (number * ureg(theirs)).to_base_units()
    if dimension == "frequency" and "Hz" not in ours and ("rpm" in ours or "dps" in ours):
        return
    assert parse(f"{number!r} {ours}", dimension) == pytest.approx(expected.magnitude, rel=1e-12)


def test_conversion_keeps_the_dimension():
    assert convert(1.0, "deg/s", "deg/h") == 3600.0
    assert convert(6.0, "deg/h/sqrt(Hz)", "deg/sqrt(h)") == pytest.approx(0.1, rel=1e-15)
    assert convert(212.0, "degF", "degC") == 100.0
    assert convert(100.0, "degC", "degF") == 212.0
    assert format_quantity(parse("6.7 deg/h", "angular rate"), "deg/h") == "6.7 deg/h"
    assert to_unit(math.pi, "deg") == 180.0
    with pytest.raises(UnitError, match="out of range"):
        convert(1e308, "rad", "arcsec")
    with pytest.raises(UnitError, match="'deg' is an angle, 's' is a time"):
        convert(1.0, "deg", "s")
    for call in (
        lambda: convert(math.nan, "s", "h"),
        lambda: to_unit(math.inf, "s"),
        lambda: format_quantity(math.nan, "s"),
    ):
        with pytest.raises(UnitError, match="finite"):
            call()
