"""Scenes of the injected faults: a table, a chamber, a sensor with its true maps, and the spec that a user wrote.

Two sensors, a gyro axis and a whole unit, and two users. The *lean* one has written down noise, drift and encoder and
nothing else, as specs begin; the *full* one has given a figure for every term. Maps are drawn by `seed`.
"""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from physics_log import (
    DEG,
    DEG_H,
    PPM,
    Axis,
    Bench,
    Chain,
    Channel,
    Climate,
    Encoder,
    G,
    Motion,
    Recorded,
    Rest,
    Turn,
    log_of,
    powers,
    quick,
    record,
)

from gradcal_jax.records.log_file import write_log

MG = 1e-3 * G


@dataclass
class Scene:
    """All of a run that a fault may change before it is recorded, and of its rows afterwards (`edits`)."""

    kind: str
    spec: str
    bench: Bench
    channels: list[Channel]
    motion: Motion
    climate: Climate
    chain: Chain
    axes: tuple[str, ...]
    table_axes: tuple[str, ...]
    edits: list[Callable[[Recorded], Recorded]] = field(default_factory=list[Callable[[Recorded], Recorded]])
    seed: int = 1

    def write(self, folder: Path) -> list[str]:
        """Spec and log in a folder; the words of the command line."""
        (folder / "spec.toml").write_text(self.spec, encoding="utf-8")
        rows = record(self.bench, self.channels, self.motion, self.climate, self.chain, seed=self.seed)
        for edit in self.edits:
            rows = edit(rows)
        write_log(log_of(rows, self.channels, self.table_axes, self.axes), folder / "log.nc")
        words = ["estimate", str(folder / "log.nc"), "--spec", str(folder / "spec.toml")]
        return [*words, "-o", str(folder / "calibration.toml"), "--force"]

    def without(self, *keys: str) -> None:
        """Take lines out of the spec that begin with these keys."""
        lines = self.spec.splitlines()
        left = [line for line in lines if not line.strip().startswith(keys)]
        assert len(left) == len(lines) - len(keys), keys
        self.spec = "\n".join(left) + "\n"

    def replace(self, old: str, new: str) -> None:
        assert old in self.spec, old
        self.spec = self.spec.replace(old, new)


# --- one axis ---------------------------------------------------------------------------------------------------------

AXIS_MOVES = (
    Rest(12.0), Turn(1800.0, 200.0, 1.0), Rest(12.0), Turn(-1800.0, 200.0, 1.0),
    Rest(12.0), Turn(720.0, 60.0, 1.0), Rest(12.0), Turn(-720.0, 60.0, 1.0),
)  # fmt: skip

_AXIS = """format = "gradcal-spec/1"
{sensor}[sensor.gyro]
axes = ["x"]
angle_random_walk = "0.1 deg/sqrt(h)"
drift = [{{ standard_deviation = "1 deg/h", correlation_time = "120 s" }}]
{terms}
[sensor.gyro.bias]
temperature = {{ basis = "polynomial", degree = 3, centre = "20 degC", scale = "50 K" }}
prior = "400 deg/h"
[sensor.gyro.scale_factor]
temperature = {{ basis = "polynomial", degree = 2, centre = "20 degC", scale = "50 K" }}
rate = {{ basis = "polynomial", degree = 2, scale = "200 deg/s" }}
prior = "5000 ppm"
[rig.site]
latitude = "48 deg"
[rig.table]
standing = "read"
mounting = {{ x = "+z", y = "+x", z = "+y"{mounting} }}
[[rig.table.axis]]
name = "x"
direction = [0.0, 0.0, 1.0]
max_rate = "300 deg/s"
max_acceleration = "400 deg/s^2"
[rig.table.axis.angle]
reading_noise = "0.002 deg"
standstill_offset = "0.004 deg"
{encoder}
read_every = "1 s"
[rig.chamber]
range = ["-40 degC", "85 degC"]
max_heating = "5 K/min"
max_cooling = "5 K/min"
[[requirement]]
name = "M"
quantity = "gyro_scale_factor"
axis = "x"
temperature = ["-18 degC", "56 degC"]
rate = ["-200 deg/s", "200 deg/s"]
statistic = "mean of max"
grid = [41, 41]
target = "{scale}"
[[requirement]]
name = "B"
quantity = "gyro_bias"
axis = "x"
temperature = ["-18 degC", "56 degC"]
statistic = "mean"
grid = [41]
target = "{bias}"
[plan]
method = "gradient"
programme = {programme}
[plan.cycle]
moves = [
  {{ rest = "12 s", read_every = "1 s" }},
  {{ turn = "1800 deg", peak_rate = "200 deg/s", ramp = "1 s", shape = "cosine ramps" }},
  {{ rest = "12 s", read_every = "1 s" }},
  {{ turn = "-1800 deg", peak_rate = "200 deg/s", ramp = "1 s", shape = "cosine ramps" }},
  {{ rest = "12 s", read_every = "1 s" }},
  {{ turn = "720 deg", peak_rate = "60 deg/s", ramp = "1 s", shape = "cosine ramps" }},
  {{ rest = "12 s", read_every = "1 s" }},
  {{ turn = "-720 deg", peak_rate = "60 deg/s", ramp = "1 s", shape = "cosine ramps" }},
]
"""
_FULL_SENSOR = """[sensor]
thermal_lag = "30 s"
sample_clock_error = "5 ppm"
temperature_offset = "0.05 K"
temperature_lag = "0 s"
"""
_FULL_AXIS = """rate_random_walk = "0.2 deg/h/sqrt(h)"
turn_on_bias = "3 deg/h"
scale_factor_instability = [{ standard_deviation = "5 ppm", correlation_time = "20 min" }]
temperature_error = { standard_deviation = "0.05 K", bias_slope = "2 deg/h/K", scale_factor_slope = "15 ppm/K" }
bias_temperature_gradient = { prior = "2 deg/h/(K/min)" }
"""
_FULL_ENCODER = """timing_error = "0.1 ms"
scale_error = "1 ppm"
harmonics = [{ order = 1, amplitude = "0.002 deg" }]"""

ONE_WAY = '[{ soak = "1 min", at = "-20 degC" }, { ramp_to = "60 degC", rate = "2 K/min" }]'
BOTH_WAYS = (
    '[{ soak = "1 min", at = "-20 degC" }, { ramp_to = "60 degC", rate = "4 K/min" }, '
    '{ ramp_to = "-20 degC", rate = "4 K/min" }]'
)
END = 2400.0
UP = ((0.0, -20.0), (END, 60.0))
UP_AND_DOWN = ((0.0, -20.0), (0.5 * END, 60.0), (END, -20.0))


def _map(b: np.ndarray, pace: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """M over temperature (rows: powers of (T − 20)/50) and rate (columns: powers of rate/pace)."""

    def scale(t: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.polynomial.polynomial.polyval2d((t - 20.0) / 50.0, x / pace, b)

    return scale


def axis_scene(full: bool, seed: int = 1, both_ways: bool | None = None) -> Scene:
    """One gyro on a table whose axis points up. The full user's run heats and cools, the lean one's heats."""
    rng = np.random.default_rng([seed, 900])
    a = DEG_H * rng.standard_normal(4) * [60.0, 40.0, 20.0, 15.0]
    b = PPM * rng.standard_normal((3, 3)) * [[1500.0, 500.0, 400.0], [600.0, 300.0, 200.0], [300.0, 200.0, 150.0]]
    tip = 1e-3 * rng.standard_normal(2) if full else 3e-4 * rng.standard_normal(2)
    along = np.array([*tip, 1.0]) / np.linalg.norm([*tip, 1.0])
    gyro = Channel(
        along, powers(a), _map(b, 200.0 * DEG), white=0.1 / 60.0 * DEG, drift=((1.0 * DEG_H, 120.0),),
        gradient=(2.0 * DEG_H * 60.0 * rng.standard_normal()) if full else 0.0,
        walk=0.2 * DEG_H / 60.0 if full else 0.0,
        scale_drift=((5.0 * PPM, 1200.0),) if full else (),
        turn_on=3.0 * DEG_H * rng.standard_normal() if full else 0.0,
    )  # fmt: skip
    wave = tuple(0.002 * rng.standard_normal(2))
    waves = {1: (float(wave[0]), float(wave[1]))} if full else {}
    encoder = Encoder(0.002, 0.004, scale=1e-6 * rng.standard_normal() if full else 0.0, waves=waves)
    both = full if both_ways is None else both_ways
    offset = 0.05 * rng.standard_normal() if full else 0.0
    clock = 5.0 * PPM * rng.standard_normal() if full else 0.0
    spec = _AXIS.format(
        sensor=_FULL_SENSOR if full else "", terms=_FULL_AXIS if full else "",
        encoder=_FULL_ENCODER if full else "",
        mounting=', accuracy = "1 mrad"' if full else "",
        scale="150 ppm" if full else "60 ppm", bias="10 deg/h" if full else "2 deg/h",
        programme=BOTH_WAYS if both else ONE_WAY,
    )  # fmt: skip
    climate = Climate(UP_AND_DOWN if both else UP, air_to_die=30.0 if full else 0.0, offset=offset)
    return Scene(
        "axis", spec, Bench([Axis(encoder=encoder)]), [gyro], Motion(AXIS_MOVES, END), climate, Chain(clock=clock),
        ("x",), ("x",), seed=seed,
    )  # fmt: skip


# --- a whole unit -----------------------------------------------------------------------------------------------------

_TABLE = (("tilt", (1.0, 0.0, 0.0)), ("spin", (0.0, 0.0, 1.0)))
_SPIN, _TILT = 1, 0


def _unit_moves() -> tuple[list[Rest | Turn], list[str]]:
    """The moves of a cycle, and the same in words of a spec."""
    moves: list[Rest | Turn] = []
    words: list[str] = []

    def rest() -> None:
        moves.append(Rest(5.0))
        words.append('{ rest = "5 s" }')

    def turn(axis: int, angle: float, rate: float = 300.0) -> None:
        moves.append(quick(angle, axis, rate, 400.0))
        words.append(f'{{ turn = "{angle:g} deg", axis = "{_TABLE[axis][0]}", peak_rate = "{rate:g} deg/s" }}')
        rest()

    rest()
    for axis in (_SPIN, _TILT, _TILT):
        if axis == _TILT:
            turn(_TILT if words.count(words[0]) < 8 else _SPIN, 90.0)
        for angle, rate in ((1080.0, 300.0), (720.0, 150.0), (360.0, 60.0)):
            turn(axis, angle, rate)
            turn(axis, -angle, rate)
        if axis == _TILT:
            turn(_SPIN, 180.0)
            turn(axis, 720.0)
            turn(axis, -720.0)
            turn(_SPIN, -180.0)
    # tilt 90, spin 90: positions between the faces, and back to zero
    turn(_TILT, 45.0)
    turn(_SPIN, 135.0)
    for _ in range(3):
        turn(_TILT, 45.0)
    turn(_SPIN, -180.0)
    turn(_TILT, -45.0)
    turn(_TILT, -180.0)
    turn(_SPIN, 45.0)
    turn(_TILT, -45.0)
    turn(_SPIN, -90.0)
    return moves, words


UNIT_MOVES, _UNIT_WORDS = _unit_moves()

_UNIT = """format = "gradcal-spec/1"
[sensor]
{terms}
[sensor.gyro]
angle_random_walk = "0.15 deg/sqrt(h)"
drift = [{{ standard_deviation = "1 deg/h", correlation_time = "120 s" }}]
misalignment = {{ prior = "10 mrad" }}
{gyro}
[sensor.gyro.bias]
temperature = {{ basis = "polynomial", degree = 3, centre = "20 degC", scale = "50 K" }}
prior = "500 deg/h"
[sensor.gyro.scale_factor]
temperature = {{ basis = "polynomial", degree = 2, centre = "20 degC", scale = "50 K" }}
rate = {{ basis = "polynomial", degree = 2, scale = "300 deg/s" }}
prior = "5000 ppm"
[sensor.accelerometer]
velocity_random_walk = "0.05 m/s/sqrt(h)"
drift = [{{ standard_deviation = "50 ug", correlation_time = "200 s" }}]
misalignment = {{ prior = "10 mrad" }}
{accelerometer}
[sensor.accelerometer.bias]
temperature = {{ basis = "polynomial", degree = 3, centre = "20 degC", scale = "50 K" }}
prior = "20 mg"
[sensor.accelerometer.scale_factor]
temperature = {{ basis = "polynomial", degree = 2, centre = "20 degC", scale = "50 K" }}
prior = "5000 ppm"
[rig.site]
latitude = "48 deg"
gravity = "9.80665 m/s^2"
{site}
[rig.table]
{table}
[[rig.table.axis]]
name = "tilt"
direction = [1.0, 0.0, 0.0]
max_rate = "300 deg/s"
max_acceleration = "400 deg/s^2"
{skew}
[rig.table.axis.angle]
reading_noise = "0.001 deg"
standstill_offset = "0.002 deg"
{encoder}
[[rig.table.axis]]
name = "spin"
direction = [0.0, 0.0, 1.0]
max_rate = "300 deg/s"
max_acceleration = "400 deg/s^2"
[rig.table.axis.angle]
reading_noise = "0.001 deg"
standstill_offset = "0.002 deg"
{encoder}
[rig.chamber]
range = ["-40 degC", "85 degC"]
max_heating = "5 K/min"
max_cooling = "5 K/min"
{requirements}
[plan]
method = "gradient"
programme = {programme}
[plan.cycle]
moves = [
{moves},
]
"""
_FULL_UNIT = """thermal_lag = "30 s"
sample_clock_error = "5 ppm"
temperature_offset = "0.05 K"
temperature_lag = "0 s"
"""
_FULL_GYRO = """g_sensitivity = { prior = "20 deg/h/g" }
rate_random_walk = "0.2 deg/h/sqrt(h)"
turn_on_bias = "1 deg/h"
scale_factor_instability = [{ standard_deviation = "3 ppm", correlation_time = "20 min" }]
bias_temperature_gradient = "0 deg/h/(K/min)"
"""
_REQUIREMENT = """[[requirement]]
name = "{quantity}"
quantity = "{quantity}"
axis = "all"
temperature = ["-18 degC", "56 degC"]
target = "{target}"
{more}"""
_TARGETS = {
    "gyro_scale_factor": ("40 ppm", "120 ppm"),
    "gyro_bias": ("4 deg/h", "20 deg/h"),
    "gyro_misalignment": ("40 urad", "150 urad"),
    "accelerometer_bias": ("100 ug", "300 ug"),
    "accelerometer_scale_factor": ("100 ppm", "200 ppm"),
    "accelerometer_misalignment": ("60 urad", "200 urad"),
}


def unit_scene(full: bool, seed: int = 1, both_ways: bool | None = None) -> Scene:
    """Three gyros and three accelerometers on a table of two axes: the outer one level, the inner one up at zero."""
    rng = np.random.default_rng([seed, 901])
    channels: list[Channel] = []
    sized = [[1500.0, 400.0, 300.0], [500.0, 300.0, 200.0], [300.0, 200.0, 100.0]]
    for k in range(3):
        along = np.eye(3)[k] + 3e-3 * rng.standard_normal(3) * (1.0 - np.eye(3)[k])
        force = DEG_H / G * 10.0 * rng.standard_normal(3) if full else (0.0, 0.0, 0.0)
        channels.append(
            Channel(
                along / np.linalg.norm(along), powers(DEG_H * rng.standard_normal(4) * [150.0, 60.0, 30.0, 15.0]),
                _map(PPM * rng.standard_normal((3, 3)) * sized, 300.0 * DEG), force, white=0.15 / 60.0 * DEG,
                drift=((1.0 * DEG_H, 120.0),),
                walk=0.2 * DEG_H / 60.0 if full else 0.0,
                scale_drift=((3.0 * PPM, 1200.0),) if full else (),
                turn_on=1.0 * DEG_H * rng.standard_normal() if full else 0.0,
            )
        )  # fmt: skip
    for k in range(3):
        along = np.eye(3)[k] + 3e-3 * rng.standard_normal(3) * (1.0 - np.eye(3)[k])
        over = powers(PPM * rng.standard_normal(3) * [1500.0, 500.0, 200.0])
        channels.append(
            Channel(
                along / np.linalg.norm(along), powers(MG * rng.standard_normal(4) * [5.0, 2.0, 1.0, 0.5]),
                lambda t, x, over=over: over(t), square=(200e-6 / G * rng.standard_normal()) if full else 0.0,
                white=0.05 / 60.0, drift=((50e-6 * G, 200.0),), kind="accelerometer",
                turn_on=50e-6 * G * rng.standard_normal() if full else 0.0,
            )
        )  # fmt: skip
    axes: list[Axis] = []
    for k, (_, direction) in enumerate(_TABLE):
        wave = 0.001 * rng.standard_normal(2) if full else np.zeros(2)
        waves = {1: (float(wave[0]), float(wave[1]))} if full else {}
        skew = 50e-6 * rng.standard_normal() if full and k == 0 else 0.0
        scale = 1e-6 * rng.standard_normal() if full else 0.0
        axes.append(Axis(direction, Encoder(0.001, 0.002, scale=scale, waves=waves), skew=skew))
    base = rng.standard_normal(3) * [100e-6, 100e-6, 2e-3] if full else np.zeros(3)
    both = full if both_ways is None else both_ways
    requirements = "\n".join(
        _REQUIREMENT.format(
            quantity=name, target=target[full],
            more='rate = ["-300 deg/s", "300 deg/s"]\ngrid = [41, 41]' if "gyro_scale" in name else "grid = [41]",
        )
        for name, target in (_TARGETS | ({"g_sensitivity": ("", "5 deg/h/g")} if full else {})).items()
    )  # fmt: skip
    spec = _UNIT.format(
        terms=_FULL_UNIT if full else "", gyro=_FULL_GYRO if full else "",
        accelerometer='second_order = { prior = "500 ug/g^2" }\nturn_on_bias = "50 ug"' if full else "",
        site='gravity_accuracy = "5 ug"' if full else "",
        table='tilt = "100 urad"\nazimuth = "2 mrad"' if full else "",
        skew='orthogonality = "50 urad"' if full else "",
        encoder='scale_error = "1 ppm"\nharmonics = [{ order = 1, amplitude = "0.001 deg" }]' if full else "",
        requirements=requirements, programme=BOTH_WAYS if both else ONE_WAY,
        moves=",\n".join(f"  {word}" for word in _UNIT_WORDS),
    )  # fmt: skip
    clock = 5.0 * PPM * rng.standard_normal() if full else 0.0
    climate = Climate(
        UP_AND_DOWN if both else UP, air_to_die=30.0 if full else 0.0,
        offset=0.05 * rng.standard_normal() if full else 0.0,
    )  # fmt: skip
    return Scene(
        "unit", spec, Bench(axes, base=base, lever=(0.03, -0.02, 0.01) if full else (0.0, 0.0, 0.0)), channels,
        Motion(UNIT_MOVES, END, 2), climate,
        Chain(clock=clock), ("x", "y", "z"), tuple(name for name, _ in _TABLE), seed=seed,
    )  # fmt: skip


# --- what is wrong with a calibration ---------------------------------------------------------------------------------

UNIT_SIZES = {
    "ppm": PPM,
    "deg/h": DEG_H,
    "µrad": 1e-6,
    "urad": 1e-6,
    "µg": 1e-6 * G,
    "ug": 1e-6 * G,
    "deg/h/g": DEG_H / G,
}


@dataclass(frozen=True)
class Judged:
    """A requirement: the statistic of the true error, and U (k = 2) and verdict as stated; in `unit`."""

    name: str
    error: float
    u: float | None
    verdict: str
    unit: str

    @property
    def within(self) -> bool:
        return self.u is not None and self.error <= self.u


def _basis(of: dict[str, Any], x: np.ndarray) -> np.ndarray:
    number = lambda key: float(str(of[key]).split()[0])  # noqa: E731
    scale = number("scale") * (DEG if "deg/s" in str(of["scale"]) else 1.0)
    centre = number("centre") if "centre" in of else 0.0
    assert of["basis"] == "polynomial"
    assert centre == 0.0 or "deg/s" not in str(of["scale"])
    return ((x - centre) / scale)[None] ** np.arange(of["degree"] + 1)[:, None]


def term_values(term: dict[str, Any], t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A term's values at temperatures and rates, from its file."""
    values = np.array(list(term["coefficients"].values()), float)
    one = np.ones((1, len(t)))
    over_t = _basis(term["temperature"], t) if "temperature" in term else one
    over_x = _basis(term["rate"], x) if "rate" in term else one
    return np.einsum("ij,in,jn->n", values.reshape(len(over_t), len(over_x)), over_t, over_x)


def _numbers(pair: list[str]) -> tuple[float, float]:
    low, high = (float(str(text).split()[0]) for text in pair)
    return low, high


def summed(error: np.ndarray, statistic: str, shape: tuple[int, ...]) -> float:
    """A statistic of |error|, as the spec's key names it, on a box `[temperature, rate]`."""
    size = np.abs(error).reshape(shape)
    if statistic.startswith("mean of max"):
        return float(size.max(axis=0).mean())
    if statistic.startswith("rms"):
        return float(np.sqrt(np.mean(size**2)))
    return float(size.max() if statistic.startswith("max") else size.mean())


def judge(scene: Scene, folder: Path) -> list[Judged]:
    """Every requirement of the spec: true error and stated U. Empty where no calibration was written."""
    path = folder / "calibration.toml"
    if not path.exists():
        return []
    made = tomllib.loads(path.read_text(encoding="utf-8"))
    asked = {row["name"]: row for row in tomllib.loads(scene.spec)["requirement"]}
    found: list[Judged] = []
    for row in made["result"]:
        want = asked[row["name"]]
        grid = want["grid"]
        (low, high), (slow, fast) = _numbers(want["temperature"]), _numbers(want.get("rate", ["0", "0"]))
        rates = DEG * np.linspace(slow, fast, [*grid, 1][1])
        t, x = np.meshgrid(np.linspace(low, high, grid[0]), rates, indexing="ij")
        shape = t.shape if "rate" in want else (t.shape[0], 1)
        errors = _axis_errors if scene.kind == "axis" else _unit_errors
        error = errors(scene, made, want["quantity"], t.ravel(), x.ravel())
        unit = row["unit"]
        size = summed(error, row["statistic"], shape) / UNIT_SIZES[unit]
        value = row.get("value")
        found.append(Judged(row["name"], size, None if value is None else 2.0 * value, row.get("verdict") or "", unit))
    return found


def held(made: dict[str, Any], t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Beyond what the data covered a calibration holds its values at the edge."""
    (low, high), (slow, fast) = _numbers(made["valid_temperature"]), _numbers(made.get("valid_rate", ["0", "0"]))
    return np.clip(t, low, high), np.clip(x, slow * DEG, fast * DEG)


def _axis_errors(scene: Scene, made: dict[str, Any], quantity: str, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    (channel,), (gyro,) = made["channel"], scene.channels
    at, terms = held(channel, t, x), {term["name"]: term for term in channel["term"]}
    if quantity == "gyro_bias":
        return term_values(terms["bias"], *at) - gyro.bias(t)
    # b{rate power}{temperature power}, written temperature by temperature.
    return term_values(terms["scale_factor"], *at) - gyro.scale(t, x)


def _unit_errors(scene: Scene, made: dict[str, Any], quantity: str, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The root mean square over the elements of what the file says less what is true, about the body's own axes."""
    kind = "accelerometer" if quantity.startswith("accelerometer") else "gyro"
    name = quantity.removeprefix(f"{kind}_")
    squares: list[np.ndarray] = []
    for channel, truth in zip([c for c in made["channel"] if c["kind"] == kind],
                              [c for c in scene.channels if c.kind == kind], strict=True):  # fmt: skip
        at, own = held(channel, t, x), "xyz".index(channel["axis"])
        signal = "rate" if kind == "gyro" else "force"
        for j in range(3):
            if (name == "misalignment") == (j == own) and name != "g_sensitivity":
                continue
            if name == "bias":
                true = truth.bias(t)
            elif name == "scale_factor":
                true = truth.along[own] * (1.0 + truth.scale(t, truth.along[own] * x)) - 1.0
            elif name == "misalignment":
                true = np.full(len(t), truth.along[j] / truth.along[own])
            else:
                true, signal = np.full(len(t), truth.force[j]), "force"
            pointing = name in ("misalignment", "g_sensitivity")
            own_terms = [term for term in channel["term"] if term["name"].startswith(name)]
            if pointing:
                own_terms = [term for term in own_terms if term["signals"] == [f"{signal} {'xyz'[j]}"]]
            said = sum((term_values(term, *at) for term in own_terms), np.zeros(len(t)))
            squares.append((said - true) ** 2)
    return np.sqrt(np.mean(squares, axis=0))
