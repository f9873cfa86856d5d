"""Random plans of an axis and of a unit: what is predicted of each parameter is what is estimated from the plan's own
simulated run, within 5 % of every standard deviation.

Drawn: turns that follow one another without a rest, in one direction or back, of every shape; rests that are read
every second, at their end, or not at all; what is left of a cycle when its ramp ends; programmes of several parts with
soaks between them that are not used; tables that hold their axes or read them; poses.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit
from chain import AIR_LAG_S, Chain, chain, predicted_of, recipe_of
from scipy.stats import chi2

REPORT = Path(__file__).parents[2] / "experiments" / "evidence" / "random_plans.md"
# By how much an estimated standard deviation may differ from the predicted one.
MOST = 0.05

Tables = dict[str, Any]
_WARM = {"basis": "polynomial", "degree": 1, "centre": "20 degC", "scale": "40 K"}
_CHAMBER = {"range": ["-40 degC", "85 degC"], "max_heating": "6 K/min", "max_cooling": "6 K/min"}


def _one(rng: np.random.Generator, choices: list[Any]) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _of(rng: np.random.Generator, low: float, high: float, unit: str) -> str:
    return f"{float(rng.uniform(low, high)):.3g} {unit}"


def _maps(rng: np.random.Generator, prior: str) -> Tables:
    rate = {"basis": "polynomial", "degree": int(rng.integers(0, 3)), "scale": "200 deg/s"}
    return {"temperature": _WARM, "rate": rate, "prior": prior}


def _course(rng: np.random.Generator) -> Tables:
    """A ramp that whole cycles do not fill, or parts of which some are not used."""
    kind = _one(rng, ["ramp", "used soak", "parts"])
    low, high = float(rng.uniform(5.0, 15.0)), float(rng.uniform(26.0, 34.0))
    slope = f"{float(rng.uniform(1.0, 2.5)):.2f} K/min"
    ends = [f"{low:.1f} degC", f"{high:.1f} degC"]
    if kind == "ramp":
        return {"temperature": ends, "gradient": slope}
    if kind == "used soak":
        return {"temperature": ends, "gradient": slope, "soak": {"duration": _of(rng, 120, 300, "s"), "used": True}}
    return {
        "programme": [
            {"soak": "2 min", "at": ends[0]},
            {"ramp_to": ends[1], "rate": slope},
            {"soak": _of(rng, 2, 5, "min"), "used": bool(rng.integers(2))},
            {"ramp_to": f"{0.5 * (low + high):.1f} degC", "rate": slope},
        ]
    }


def axis_plan(rng: np.random.Generator) -> Tables:
    """A plan of one gyro axis."""

    def rest() -> Tables:
        read = _one(rng, [{"read_every": "1 s"}, {"read_every": _of(rng, 1.5, 4.0, "s")}, {"read": "end"}, {}])
        return {"rest": f"{int(rng.integers(4, 15))} s"} | (read if rng.random() < 0.85 else {"read": "none"})

    def turn(sign: int) -> Tables:
        shape = _one(rng, ["cosine ramps", "linear ramps"])
        return {
            "turn": f"{sign * 180 * int(rng.integers(1, 8))} deg",
            "peak_rate": _of(rng, 30, 250, "deg/s"),
            "shape": shape,
        }

    moves: list[Tables] = [{"rest": "8 s", "read_every": "1 s"}]
    for _ in range(int(rng.integers(3, 6))):
        for k in range(int(rng.integers(1, 4))):  # up to three turns without a rest
            moves.append(turn(_one(rng, [1, -1]) if k else 1))
        if rng.random() < 0.8:
            moves.append(rest())
    moves.append({"rest": "6 s", "read_every": "1 s"})
    cycle: Tables = {"moves": moves}
    if rng.random() < 0.5:
        cycle["other_axes"] = {"duration": _of(rng, 10, 40, "s"), "read": bool(rng.integers(2))}
    sensor: Tables = {"clock": "host"}  # with which a run compares the unit's
    gyro: Tables = {
        "axes": ["x"],
        "angle_random_walk": _of(rng, 0.05, 0.3, "deg/sqrt(h)"),
        "drift": [{"standard_deviation": _of(rng, 0.5, 3.0, "deg/h"), "correlation_time": _of(rng, 60, 400, "s")}],
        "bias": {"temperature": _WARM, "prior": "400 deg/h"},
        "scale_factor": _maps(rng, "3000 ppm"),
    }
    if rng.random() < 0.4:
        sensor["sample_clock_error"] = "10 ppm"
    angle = {"reading_noise": _of(rng, 0.002, 0.05, "deg"), "read_every": "1 s"}
    if rng.random() < 0.6:
        angle["standstill_offset"] = _of(rng, 0.002, 0.02, "deg")
    axis = {
        "name": "x",
        "direction": [0.0, 0.0, 1.0],
        "max_rate": "300 deg/s",
        "max_acceleration": "1500 deg/s^2",
        "angle": angle,
    }
    return {
        "format": "gradcal-spec/1",
        "sensor": sensor | {"gyro": gyro},
        "rig": {
            "table": {"standing": "read", "mounting": {"x": "+z", "y": "+x", "z": "+y"}, "axis": [axis]},
            "chamber": _CHAMBER,
        },
        "requirement": [
            {"name": "bias", "quantity": "gyro_bias", "temperature": ["16 degC", "25 degC"], "statistic": "max"}
        ],
        "plan": {"method": "gradient"} | _course(rng) | {"cycle": cycle},
    }


def motion_plan(rng: np.random.Generator) -> Tables:
    """A plan of three gyros, often with accelerometers, on one axis that points up or on two."""
    two = bool(rng.integers(2))
    standing = _one(rng, ["held", "read"])
    names = ["tilt", "spin"] if two else ["spin"]
    angle = {"reading_noise": _of(rng, 0.001, 0.02, "deg"), "standstill_offset": _of(rng, 0.001, 0.01, "deg")}
    angle["read_every"] = _one(rng, ["1 s", "2 s", "1.5 s"])
    axes = [
        {
            "name": name,
            "direction": [1.0, 0.0, 0.0] if name == "tilt" else [0.0, 0.0, 1.0],
            "max_rate": "300 deg/s",
            "max_acceleration": "1500 deg/s^2",
            "angle": dict(angle),
        }
        for name in names
    ]

    def rest() -> Tables:
        return {"rest": f"{int(rng.integers(3, 12))} s"}

    moves: list[Tables] = [rest()]
    for _ in range(int(rng.integers(4, 8))):
        axis = _one(rng, names)
        for k in range(int(rng.integers(1, 4))):
            sign = _one(rng, [1, -1]) if k else 1
            moves.append({"turn": f"{sign * 90 * int(rng.integers(1, 13))} deg", "axis": axis,
                          "peak_rate": _of(rng, 40, 280, "deg/s")})  # fmt: skip
        if rng.random() < 0.75:
            moves.append(rest())
    if two:
        moves += [
            {"pose": {"tilt": "90 deg"}, "rest": "5 s"},
            {"pose": {"tilt": "0 deg", "spin": "90 deg"}, "rest": "4 s"},
        ]
    moves += [rest(), {"pose": dict.fromkeys(names, "0 deg")}]
    sensor: Tables = {
        "clock": "host",  # with which a run compares the unit's
        "gyro": {
            "angle_random_walk": _of(rng, 0.05, 0.3, "deg/sqrt(h)"),
            "drift": [{"standard_deviation": _of(rng, 0.5, 3.0, "deg/h"), "correlation_time": _of(rng, 60, 400, "s")}],
            "bias": {"temperature": _WARM, "prior": "400 deg/h"},
            "scale_factor": _maps(rng, "1000 ppm"),
            "misalignment": {"prior": "1 mrad"},
        },
    }
    if rng.random() < 0.6 and two:
        sensor["accelerometer"] = {
            "velocity_random_walk": "0.05 m/s/sqrt(h)",
            "drift": [{"standard_deviation": "50 ug", "correlation_time": "200 s"}],
            "bias": {"temperature": _WARM, "prior": "5 mg"},
            "scale_factor": {"prior": "1000 ppm"},
            "misalignment": {"prior": "1 mrad"},
        }
    return {
        "format": "gradcal-spec/1",
        "sensor": sensor,
        "rig": {
            "site": {"latitude": "48 deg"},
            "table": {"standing": standing, "axis": axes},
            "chamber": _CHAMBER,
        },
        "requirement": [
            {"name": "bias", "quantity": "gyro_bias", "temperature": ["16 degC", "25 degC"], "statistic": "max"}
        ],
        "plan": {"method": "gradient"} | _course(rng) | {"cycle": {"moves": moves}},
    }


PLANS = {"axis": axis_plan, "unit": motion_plan}


def executed(kind: str, number: int, folder: Path, *, ideal: bool = False) -> Chain:
    """A plan's simulated run and estimate, whose data fit; `ideal`: of sensors that are hardly misaligned."""
    spec, tables = folder / "spec.toml", PLANS[kind](np.random.default_rng([number, 40]))
    if ideal:
        tables["sensor"]["gyro"]["misalignment"]["prior"] = "0.001 mrad"
    spec.write_text(tomlkit.dumps(tables), encoding="utf-8")
    recipe = recipe_of(spec, folder)
    predicted = predicted_of(recipe, AIR_LAG_S)
    done = chain(recipe, predicted, folder, seed=number)
    assert done.sigmas, done.printed
    assert chi2.sf(*done.fit) > 1e-4, f"the run's own data do not fit: χ² {done.fit[0]:.0f} of {done.fit[1]}"
    return done


def apart(done: Chain) -> dict[str, float]:
    """Of parameters by name the estimated standard deviation over the predicted one, where they differ."""
    return {name: round(float(ratio), 3) for name, ratio in done.sigmas.items() if abs(ratio - 1.0) > MOST}


_HEAD = """# Random plans: what is predicted is what is estimated

Made by `pytest -m evidence tests/evidence/test_random_plans.py`, which says what is drawn: recipe, run on simulated
devices, log and estimate by the command line. Of every parameter that the plan says anything of, the estimated standard
deviation over the predicted one, which may differ by 5 %; of a misalignment, that of its product with the scale factor.
A prediction is of an ideal sensor: where a misaligned one shows more (a gyro across the table's only axis senses a turn
by its misalignment alone, and then its scale factor), the plan is run again with sensors that are hardly misaligned.
χ² of the run's own data.

| plan | parameters | estimated over predicted | beyond 5 % | χ² of the data | of |
|---|---|---|---|---|---|
"""


def report(kind: str, number: int, done: Chain | None = None, ideal: Chain | None = None) -> None:
    """Write or replace the row of a plan; without its run remove it."""
    rows: dict[str, str] = {}
    if REPORT.exists():
        for line in REPORT.read_text(encoding="utf-8").splitlines():
            if line.startswith(("| axis", "| unit")):
                rows[line.split(" | ")[0]] = line
    rows.pop(f"| {kind} {number:02d}", None)
    if done is not None:
        rows[f"| {kind} {number:02d}"] = row_of(kind, number, done, ideal)
    good, more = (sum(of in row for row in rows.values()) for of in (" | – | ", "hardly misaligned"))
    foot = f"\n{good} of 40 within 5 % in every parameter, {more} more if their sensors are hardly misaligned; "
    foot += f"{time.strftime('%Y-%m-%d')}.\n"
    REPORT.write_text(_HEAD + "\n".join(rows[name] for name in sorted(rows)) + "\n" + foot, encoding="utf-8")


def row_of(kind: str, number: int, done: Chain, ideal: Chain | None) -> str:
    ratios, beyond = list(done.sigmas.values()), apart(done)
    beyond_words = ", ".join(f"{name} {ratio}" for name, ratio in beyond.items())[:160] or "–"
    if ideal is not None and not apart(ideal):
        ratios_of_ideal = [ideal.sigmas[name] for name in beyond]
        beyond_words += f"; hardly misaligned {min(ratios_of_ideal):.3f} … {max(ratios_of_ideal):.3f}"
    cells = (f"{len(ratios)}", f"{min(ratios):.3f} … {max(ratios):.3f}", beyond_words, f"{done.fit[0]:.0f}")
    return f"| {kind} {number:02d} | {' | '.join(cells)} | {done.fit[1]} |"


@pytest.mark.long
@pytest.mark.parametrize(("kind", "number"), [("axis", 1), ("axis", 2), ("unit", 8)])
def test_what_is_predicted_is_what_is_estimated(kind: str, number: int, tmp_path: Path) -> None:
    assert not apart(executed(kind, number, tmp_path))


@pytest.mark.evidence
@pytest.mark.parametrize("number", range(1, 21))
@pytest.mark.parametrize("kind", PLANS)
def test_twenty_plans_of_each_kind(kind: str, number: int, tmp_path: Path) -> None:
    report(kind, number)
    done = executed(kind, number, tmp_path)
    again = kind == "unit" and bool(apart(done))
    ideal = executed(kind, number, tmp_path, ideal=True) if again else None
    report(kind, number, done, ideal)
    assert not apart(ideal or done)
