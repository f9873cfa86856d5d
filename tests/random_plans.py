"""Random plans, as TOML tables (gradcal-spec/1) with quantities as text, of a gyro's axis and of a unit. A number
names a plan.

Drawn: turns that follow one another without a rest, in one direction or back, of every shape; rests that are read
every second, at their end, or not at all; what is left of a cycle when its ramp ends; programmes of several parts with
soaks between them that are not used; tables that hold their axes or read them; poses. `more_terms` draws what only
predictions are asked about: bases of every kind, further noise of sensor and encoder.
"""

from typing import Any

import numpy as np

Tables = dict[str, Any]
_WARM = {"degree": 1, "centre": "20 degC", "scale": "40 K"}
_CHAMBER = {"range": ["-40 degC", "85 degC"], "max_heating": "6 K/min", "max_cooling": "6 K/min"}
_BIAS = {"name": "bias", "quantity": "gyro_bias", "temperature": ["16 degC", "25 degC"], "statistic": "max"}
SCALE = {"name": "scale factor", "quantity": "gyro_scale_factor", "axis": "x", "temperature": ["16 degC", "25 degC"],
          "rate": ["-200 deg/s", "200 deg/s"], "grid": [5, 7]}  # fmt: skip


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
        used = [{"soak": self.of(120, 300, "s"), "at": ends[0], "used": True}, parts[1]]
        return self.one(ramp, {"programme": used}, {"programme": [*parts, {"ramp_to": "20 degC", "rate": slope}]})

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
        read = draws.one({"read_every": "1 s"}, {"read_every": draws.of(1.5, 4, "s")}, {"read_every": "rest"}, {}, {})
        return {"rest": draws.of(4, 15, "s")} | (read if draws.chance(0.85) else {"read_every": "none"})

    def turn(sign: int, _: Tables | None) -> Tables:
        angle, shape = f"{sign * 180 * int(draws.rng.integers(1, 8))} deg", draws.one("cosine ramps", "linear ramps")
        return {"turn": angle, "peak_rate": draws.of(30, 250, "deg/s"), "shape": shape}

    begin, end = {"rest": "8 s", "read_every": "1 s"}, {"rest": "6 s", "read_every": "1 s"}
    cycle: Tables = {"moves": [begin, *draws.moves(turn, rest), end]}
    if draws.chance(0.5):
        cycle["other_axes"] = {"duration": draws.of(10, 40, "s")} | draws.one({"read_every": "1 s"}, {})
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
    for axis in table["axis"]:  # all are read together
        axis["angle"]["read_every"] = table["axis"][0]["angle"]["read_every"]
    rig = {"site": {"latitude": "48 deg"}, "table": table}
    return {"sensor": sensor, "rig": rig, "plan": {"cycle": {"moves": moves}}}


def more_terms(draws: Draws, tables: Tables) -> None:
    """Of an axis."""
    sensor, angle = tables["sensor"], tables["rig"]["table"]["axis"][0]["angle"]
    gyro = sensor["gyro"]
    ends = ["0 degC", draws.of(15, 22, "degC"), "40 degC"]
    spline = {"knots": ends, "degree": int(draws.rng.integers(0, 4))}
    unstable = {"standard_deviation": draws.of(5, 60, "ppm"), "correlation_time": draws.of(60, 1200, "s")}
    error = {"standard_deviation": "0.1 K", "bias_slope": "5 deg/h/K", "scale_factor_slope": "15 ppm/K"}
    optional = (
        (0.4, gyro["scale_factor"], "temperature", spline),
        (0.3, gyro["scale_factor"], "smoothness", "100 ppm"),
        (0.4, gyro["bias"], "temperature", spline),
        (0.4, gyro, "turn_on_bias", draws.of(3, 30, "deg/h")),
        (0.3, gyro, "rate_random_walk", draws.of(0.3, 3, "deg/h/sqrt(h)")),
        (0.4, gyro, "scale_factor_instability", [unstable]),
        (0.3, gyro, "temperature_error", error),
        (0.3, gyro, "bias_temperature_gradient", {"prior": "5 deg/h/(K/min)"}),
        (0.4, sensor, "thermal_lag", draws.of(60, 400, "s")),
        (0.4, angle, "timing_error", draws.of(0.1, 0.6, "ms")),
        (0.4, angle, "harmonics", [{"order": 2, "amplitude": draws.of(5, 45, "arcsec")}]),
    )
    for share, section, key, value in optional:
        if draws.chance(share):
            section[key] = value
    if "knots" not in gyro["scale_factor"]["temperature"]:
        gyro["scale_factor"].pop("smoothness", None)


KINDS = {"axis": axis_plan, "unit": motion_plan}


def plan_of(kind: str, number: int, *, terms: bool = False) -> Tables:
    """A valid spec."""
    draws = Draws(number)
    tables = KINDS[kind](draws)
    if terms:
        more_terms(draws, tables)
    tables["plan"] |= {"method": "gradient"} | draws.course()
    tables["rig"]["chamber"] = _CHAMBER
    tables["sensor"]["clock"] = "host"  # with which a run compares the unit's
    scale = SCALE | {"statistic": draws.one("mean of max", "max", "mean", "rms")}
    return {"format": "gradcal-spec/1", "requirement": [_BIAS, scale] if terms else [_BIAS]} | tables
