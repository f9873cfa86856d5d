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
from chain import Chain, chain, predicted_of, recipe_of
from evidence_report import ReportTable, Rows
from scipy.stats import chi2

# By how much an estimated standard deviation may differ from the predicted one.
MOST = 0.05
PLANS = 20

Tables = dict[str, Any]
_WARM = {"degree": 1, "centre": "20 degC", "scale": "40 K"}
_CHAMBER = {"range": ["-40 degC", "85 degC"], "max_heating": "6 K/min", "max_cooling": "6 K/min"}
_BIAS = {"name": "bias", "quantity": "gyro_bias", "temperature": ["16 degC", "25 degC"], "statistic": "max"}


class Draws:
    """What a plan is drawn from."""

    def __init__(self, number: int) -> None:
        self.rng = np.random.default_rng([number, 40])

    def one(self, *choices: Any) -> Any:
        return choices[int(self.rng.integers(len(choices)))]

    def of(self, low: float, high: float, unit: str) -> str:
        return f"{float(self.rng.uniform(low, high)):.3g} {unit}"

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def course(self) -> Tables:
        """A ramp that whole cycles do not fill, or parts of which some are not used."""
        ends, slope = [self.of(5.0, 15.0, "degC"), self.of(26.0, 34.0, "degC")], self.of(1.0, 2.5, "K/min")
        soak = {"soak": self.of(2, 5, "min"), "used": self.chance(0.5)}
        ramp = {"temperature": ends, "gradient": slope}
        parts = [{"soak": "2 min", "at": ends[0]}, {"ramp_to": ends[1], "rate": slope}, soak]
        used = {"soak": {"duration": self.of(120, 300, "s"), "used": True}}
        return self.one(ramp, ramp | used, {"programme": [*parts, {"ramp_to": "20 degC", "rate": slope}]})

    def moves(self, turn: Any, rest: Any) -> list[Tables]:
        """Up to three turns without a rest, of which the second may go back."""
        moves: list[Tables] = []
        for _ in range(int(self.rng.integers(3, 7))):
            axis = turn(1, None)
            moves += [axis, *(turn(self.one(1, -1), axis) for _ in range(int(self.rng.integers(0, 3))))]
            if self.chance(0.8):
                moves.append(rest())
        return moves

    def gyro(self, prior: str) -> Tables:
        rate = {"degree": int(self.rng.integers(0, 3)), "scale": "200 deg/s"}
        drift = {"standard_deviation": self.of(0.5, 3, "deg/h"), "correlation_time": self.of(60, 400, "s")}
        return {
            "angle_random_walk": self.of(0.05, 0.3, "deg/sqrt(h)"),
            "drift": [drift],
            "bias": {"temperature": _WARM, "prior": "400 deg/h"},
            "scale_factor": {"temperature": _WARM, "rate": rate, "prior": prior},
        }

    def axis(self, name: str, noise: float, offset: float) -> Tables:
        angle = {"reading_noise": self.of(0.1 * noise, noise, "deg"), "read_every": self.one("1 s", "2 s", "1.5 s")}
        if self.chance(0.7):
            angle["standstill_offset"] = self.of(0.1 * offset, offset, "deg")
        limits = {"max_rate": "300 deg/s", "max_acceleration": "1500 deg/s^2"}
        direction = [1.0, 0.0, 0.0] if name == "tilt" else [0.0, 0.0, 1.0]
        return {"name": name, "direction": direction, "angle": angle} | limits


def axis_plan(draws: Draws) -> Tables:
    """A plan of one gyro axis."""

    def rest() -> Tables:
        read = draws.one({"read_every": "1 s"}, {"read_every": draws.of(1.5, 4, "s")}, {"read": "end"}, {}, {})
        return {"rest": draws.of(4, 15, "s")} | (read if draws.chance(0.85) else {"read": "none"})

    def turn(sign: int, _: Tables | None) -> Tables:
        angle, shape = f"{sign * 180 * int(draws.rng.integers(1, 8))} deg", draws.one("cosine ramps", "linear ramps")
        return {"turn": angle, "peak_rate": draws.of(30, 250, "deg/s"), "shape": shape}

    begin, end = {"rest": "8 s", "read_every": "1 s"}, {"rest": "6 s", "read_every": "1 s"}
    cycle: Tables = {"moves": [begin, *draws.moves(turn, rest), end]}
    if draws.chance(0.5):
        cycle["other_axes"] = {"duration": draws.of(10, 40, "s"), "read": draws.chance(0.5)}
    clock = {"sample_clock_error": "10 ppm"} if draws.chance(0.4) else {}
    mounting = {"x": "+z", "y": "+x", "z": "+y"}
    return {
        "sensor": clock | {"gyro": draws.gyro("3000 ppm") | {"axes": ["x"]}},
        "rig": {"table": {"standing": "read", "mounting": mounting, "axis": [draws.axis("x", 0.05, 0.02)]}},
        "plan": {"cycle": cycle},
    }


def motion_plan(draws: Draws) -> Tables:
    """A plan of three gyros, often with accelerometers, on one axis that points up or on two."""
    names = draws.one(["tilt", "spin"], ["spin"])

    def rest() -> Tables:
        return {"rest": draws.of(3, 12, "s")}

    def turn(sign: int, before: Tables | None) -> Tables:
        axis = before["axis"] if before else draws.one(*names)
        angle = f"{sign * 90 * int(draws.rng.integers(1, 13))} deg"
        return {"turn": angle, "axis": axis, "peak_rate": draws.of(40, 280, "deg/s")}

    moves = [rest(), *draws.moves(turn, rest)]
    if len(names) > 1:
        moves += [
            {"pose": {"tilt": "90 deg"}, "rest": "5 s"},
            {"pose": {"tilt": "0 deg", "spin": "90 deg"}, "rest": "4 s"},
        ]
    moves += [rest(), {"pose": dict.fromkeys(names, "0 deg")}]
    sensor: Tables = {"gyro": draws.gyro("1000 ppm") | {"misalignment": {"prior": "1 mrad"}}}
    if len(names) > 1 and draws.chance(0.6):
        sensor["accelerometer"] = {
            "velocity_random_walk": "0.05 m/s/sqrt(h)",
            "drift": [{"standard_deviation": "50 ug", "correlation_time": "200 s"}],
            "bias": {"temperature": _WARM, "prior": "5 mg"},
            "scale_factor": {"prior": "1000 ppm"},
            "misalignment": {"prior": "1 mrad"},
        }
    table = {"standing": draws.one("held", "read"), "axis": [draws.axis(name, 0.02, 0.01) for name in names]}
    rig = {"site": {"latitude": "48 deg"}, "table": table}
    return {"sensor": sensor, "rig": rig, "plan": {"cycle": {"moves": moves}}}


KINDS = {"axis": axis_plan, "unit": motion_plan}


def spec_text(kind: str, number: int, *, ideal: bool = False) -> str:
    """`ideal`: of sensors that are hardly misaligned."""
    draws = Draws(number)
    tables = KINDS[kind](draws)
    tables["plan"] |= {"method": "gradient"} | draws.course()
    tables["rig"]["chamber"] = _CHAMBER
    tables["sensor"]["clock"] = "host"  # with which a run compares the unit's
    if ideal:
        tables["sensor"]["gyro"]["misalignment"]["prior"] = "0.001 mrad"
    return tomlkit.dumps({"format": "gradcal-spec/1", "requirement": [_BIAS]} | tables)


def executed(kind: str, number: int, folder: Path, *, ideal: bool = False) -> Chain:
    """A plan's simulated run and estimate, whose data fit."""
    (folder / "spec.toml").write_text(spec_text(kind, number, ideal=ideal), encoding="utf-8")
    recipe = recipe_of(folder / "spec.toml", folder)
    done = chain(recipe, predicted_of(recipe, folder), folder, seed=number)
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
"""


def _foot(rows: Rows) -> str:
    good, more = (sum(test(row[3]) for row in rows) for test in ("–".__eq__, lambda cell: "hardly misaligned" in cell))
    words = f"{good} of {len(rows)} within 5 % in every parameter, {more} more if their sensors are hardly misaligned"
    return f"{words}; {time.strftime('%Y-%m-%d')}."


_COLUMNS = ("plan", "parameters", "estimated over predicted", "beyond 5 %", "χ² of the data", "of")
REPORT = ReportTable("random_plans", _HEAD, _COLUMNS, foot=_foot)


@pytest.mark.long
@pytest.mark.parametrize(("kind", "number"), [("axis", 1), ("axis", 2), ("unit", 9)])
def test_what_is_predicted_is_what_is_estimated(kind: str, number: int, tmp_path: Path) -> None:
    assert not apart(executed(kind, number, tmp_path))


@pytest.mark.evidence
@pytest.mark.parametrize("number", range(1, PLANS + 1))
@pytest.mark.parametrize("kind", KINDS)
def test_twenty_plans_of_each_kind(kind: str, number: int, tmp_path: Path) -> None:
    done = executed(kind, number, tmp_path)
    ratios, beyond = list(done.sigmas.values()), apart(done)
    words = ", ".join(f"{name} {ratio}" for name, ratio in beyond.items())[:160] or "–"
    if beyond and kind == "unit":
        ideal = executed(kind, number, tmp_path, ideal=True)
        again = [ideal.sigmas[name] for name in beyond]
        beyond = apart(ideal)
        words += f"; hardly misaligned {min(again):.3f} … {max(again):.3f}"
    statistic, degrees = done.fit
    span = f"{min(ratios):.3f} … {max(ratios):.3f}"
    REPORT.put((f"{kind} {number:02d}", len(ratios), span, words, f"{statistic:.0f}", degrees))
    assert not beyond
