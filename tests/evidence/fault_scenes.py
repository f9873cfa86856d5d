"""Scenes of the injected faults: a table, a chamber, a sensor with its true maps, and the spec that a user wrote.

Two sensors, a gyro axis and a whole unit, and two users (`scenes/`). The *lean* one has written down noise, drift and
encoder and nothing else, as specs begin; the *full* one has given a figure for every term. Maps are drawn by `seed`.
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
    Floats,
    G,
    Law,
    Motion,
    Move,
    Recorded,
    Surface,
    log_of,
    record,
)

from gradcal_jax.records.log_file import write_log

SPECS = Path(__file__).parent / "scenes"
END = 2400.0
ACCELERATION = 400.0
UP = ((0.0, -20.0), (END, 60.0))
UP_AND_DOWN = ((0.0, -20.0), (0.5 * END, 60.0), (END, -20.0))
ONE_WAY = '{ ramp_to = "60 degC", rate = "2 K/min" }'
BOTH_WAYS = '{ ramp_to = "60 degC", rate = "4 K/min" }, { ramp_to = "-20 degC", rate = "4 K/min" }'


@dataclass
class Scene:
    """All of a run that a fault may change before it is recorded, and of its rows afterwards (`edits`)."""

    spec: str
    bench: Bench
    channels: list[Channel]
    climate: Climate
    chain: Chain
    seed: int
    top_rate: float = np.inf
    edits: list[Callable[[Recorded], Recorded]] = field(default_factory=list[Callable[[Recorded], Recorded]])

    def recorded(self) -> Recorded:
        axes = tomllib.loads(self.spec)["rig"]["table"]["axis"]
        motion = Motion(moves_of(tomllib.loads(self.spec), self.top_rate), END, len(axes))
        rows = record(self.bench, self.channels, motion, self.climate, self.chain, self.seed)
        for edit in self.edits:
            rows = edit(rows)
        return rows

    def write(self, folder: Path) -> list[str]:
        """Spec and log in a folder; the words of the command line."""
        (folder / "spec.toml").write_text(self.spec, encoding="utf-8")
        names = [axis["name"] for axis in tomllib.loads(self.spec)["rig"]["table"]["axis"]]
        write_log(log_of(self.recorded(), self.channels, names), folder / "log.nc")
        words = ["estimate", str(folder / "log.nc"), "--spec", str(folder / "spec.toml")]
        return [*words, "-o", str(folder / "calibration.toml"), "--force"]

    def replace(self, old: str, new: str = "") -> None:
        """In the spec's text."""
        assert old in self.spec, old
        self.spec = self.spec.replace(old, new)


def number(text: str) -> float:
    return float(str(text).split()[0])


def moves_of(spec: dict[str, Any], top_rate: float) -> list[Move]:
    """The moves of a plan as the table makes them; `top_rate`: it never goes faster, deg/s."""
    names = [axis["name"] for axis in spec["rig"]["table"]["axis"]]
    moves: list[Move] = []
    for move in spec["plan"]["cycle"]["moves"]:
        if "rest" in move:
            moves.append(Move(number(move["rest"])))
            continue
        angle, rate = number(move["turn"]), number(move["peak_rate"])
        ramp = number(move["duration"]) - abs(angle) / rate if "duration" in move else 0.5 * np.pi * rate / ACCELERATION
        if rate * ramp > abs(angle):  # as fast as the axis goes
            rate = float(np.sqrt(2.0 * abs(angle) * ACCELERATION / np.pi))
            ramp = abs(angle) / rate
        moves.append(Move(0.0, angle, min(rate, top_rate), float(ramp), names.index(move.get("axis", names[0]))))
    return moves


def powers(coefficients: Floats) -> Law:
    """A map over temperature in powers of (T − 20)/50."""
    return lambda t: np.polynomial.polynomial.polyval((t - 20.0) / 50.0, coefficients)


def surface(b: Floats, pace: float) -> Surface:
    """M over temperature (rows: powers of (T − 20)/50) and rate (columns: powers of rate/pace)."""
    return lambda t, x: np.polynomial.polynomial.polyval2d((t - 20.0) / 50.0, x / (pace * DEG), b)


def scene_of(name: str, seed: int) -> Scene:
    """ "axis" or "unit", "lean" or "full", and how the temperature goes, if not as this user lets it: "one ramp" or "up
    and down"."""
    kind, user, *course = name.split(", ")
    spec = (SPECS / f"{kind}_{user}.toml").read_text(encoding="utf-8")
    full = user == "full"
    scene = (axis_scene if kind == "axis" else unit_scene)(spec, full, seed)
    both = course == ["up and down"] if course else full
    scene.climate = Climate(UP_AND_DOWN if both else UP, 30.0 if full else 0.0, offset=scene.climate.offset)
    if both != full:
        scene.replace(*((ONE_WAY, BOTH_WAYS) if both else (BOTH_WAYS, ONE_WAY)))
    return scene


def axis_scene(spec: str, full: bool, seed: int) -> Scene:
    """One gyro on a table whose axis points up."""
    rng = np.random.default_rng([seed, 900])
    given = 1.0 if full else 0.0
    bias = powers(DEG_H * rng.standard_normal(4) * [60.0, 40.0, 20.0, 15.0])
    sizes = [[1500.0, 500.0, 400.0], [600.0, 300.0, 200.0], [300.0, 200.0, 150.0]]
    scale = surface(PPM * rng.standard_normal((3, 3)) * sizes, 200.0)
    along = np.array([*(1e-3 if full else 3e-4) * rng.standard_normal(2), 1.0])
    draw = rng.standard_normal if full else lambda: 0.0
    gyro = Channel(
        along / np.linalg.norm(along), bias, scale, white=0.1 / 60.0 * DEG, drift=((1.0 * DEG_H, 120.0),),
        gradient=2.0 * DEG_H * 60.0 * draw(), walk=given * 0.2 * DEG_H / 60.0,
        scale_drift=((given * 5.0 * PPM, 1200.0),) if full else (), turn_on=3.0 * DEG_H * draw(),
    )  # fmt: skip
    cosine, sine = 0.002 * rng.standard_normal(2)
    encoder = Encoder(0.002, 0.004, 1e-6 * draw(), {1: (cosine, sine)} if full else {})
    climate = Climate(UP, offset=0.05 * draw())
    bench = Bench([Axis((0.0, 0.0, 1.0), encoder)])
    return Scene(spec, bench, [gyro], climate, Chain(clock=5.0 * PPM * draw()), seed)


def unit_scene(spec: str, full: bool, seed: int) -> Scene:
    """Three gyros and three accelerometers on a table of two axes: the outer one level, the inner one up at zero."""
    rng = np.random.default_rng([seed, 901])
    draw = rng.standard_normal if full else lambda *size: np.zeros(size)
    given = 1.0 if full else 0.0
    sizes = [[1500.0, 400.0, 300.0], [500.0, 300.0, 200.0], [300.0, 200.0, 100.0]]

    def along(k: int) -> Floats:
        axis = np.eye(3)[k] + 3e-3 * rng.standard_normal(3) * (1.0 - np.eye(3)[k])
        return axis / np.linalg.norm(axis)

    gyros, forces = list[Channel](), list[Channel]()
    for k in range(3):
        axis, force = along(k), DEG_H / G * 10.0 * draw(3)
        bias = powers(DEG_H * rng.standard_normal(4) * [150.0, 60.0, 30.0, 15.0])
        scale = surface(PPM * rng.standard_normal((3, 3)) * sizes, 300.0)
        gyros.append(
            Channel(
                axis, bias, scale, force, white=0.15 / 60.0 * DEG, drift=((1.0 * DEG_H, 120.0),),
                walk=given * 0.2 * DEG_H / 60.0, scale_drift=((3.0 * PPM, 1200.0),) if full else (),
                turn_on=float(DEG_H * draw()),
            )
        )  # fmt: skip
    for k in range(3):
        axis, over = along(k), powers(PPM * rng.standard_normal(3) * [1500.0, 500.0, 200.0])
        bias = powers(1e-3 * G * rng.standard_normal(4) * [5.0, 2.0, 1.0, 0.5])
        forces.append(
            Channel(
                axis, bias, lambda t, x, over=over: over(t), square=float(200e-6 / G * draw()), white=0.05 / 60.0,
                drift=((50e-6 * G, 200.0),), turn_on=float(50e-6 * G * draw()), kind="accelerometer",
            )
        )  # fmt: skip
    axes: list[Axis] = []
    for direction, skewed in (((1.0, 0.0, 0.0), True), ((0.0, 0.0, 1.0), False)):
        cosine, sine = 0.001 * draw(2)
        skew = 50e-6 * float(draw()) if skewed else 0.0
        encoder = Encoder(0.001, 0.002, 1e-6 * float(draw()), {1: (cosine, sine)} if full else {})
        axes.append(Axis(direction, encoder, skew))
    base = draw(3) * [100e-6, 100e-6, 2e-3]
    clock = 5.0 * PPM * float(draw())
    lever = given * np.array([0.03, -0.02, 0.01])
    climate = Climate(UP, offset=0.05 * float(draw()))
    return Scene(spec, Bench(axes, base=base, lever=lever), [*gyros, *forces], climate, Chain(clock=clock), seed)


# --- what is wrong with a calibration ---------------------------------------------------------------------------------

UNIT_SIZES = {"ppm": PPM, "deg/h": DEG_H, "µrad": 1e-6, "urad": 1e-6, "µg": 1e-6 * G, "ug": 1e-6 * G,
              "deg/h/g": DEG_H / G}  # fmt: skip


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
        temperatures = np.linspace(*map(number, want["temperature"]), want["grid"][0])
        rates = np.zeros(1)
        if "rate" in want:
            rates = DEG * np.linspace(*map(number, want["rate"]), want["grid"][1])
        t, x = np.meshgrid(temperatures, rates, indexing="ij")
        error = true_error(scene, made, want["quantity"], t.ravel(), x.ravel())
        size = summed(error.reshape(t.shape), row["statistic"]) / UNIT_SIZES[row["unit"]]
        u = 2.0 * row["value"] if "value" in row else None
        found.append(Judged(row["name"], size, u, row.get("verdict") or "", row["unit"]))
    return found


def summed(size: Floats, statistic: str) -> float:
    """A statistic of an error, as the spec's key names it, on a box `[temperature, rate]`."""
    if statistic.startswith("mean of max"):
        return float(size.max(axis=0).mean())
    if statistic.startswith("rms"):
        return float(np.sqrt(np.mean(size**2)))
    return float(size.max() if statistic.startswith("max") else size.mean())


def true_error(scene: Scene, made: dict[str, Any], quantity: str, t: Floats, x: Floats) -> Floats:
    """The root mean square over the elements of what the file says less what is true, about the body's own axes; of one
    axis, along its own."""
    kind = "accelerometer" if quantity.startswith("accelerometer") else "gyro"
    name = quantity.removeprefix(f"{kind}_")
    channels = [channel for channel in made["channel"] if channel["kind"] == kind]
    truths = [channel for channel in scene.channels if channel.kind == kind]
    squares: list[Floats] = []
    for channel, truth in zip(channels, truths, strict=True):
        own = "xyz".index(channel["axis"])
        along = np.array(truth.along) if len(scene.channels) > 1 else np.ones(3)
        elements: dict[str, Floats | float] = {}  # what is true, by the signal that it answers to
        signal = "rate" if kind == "gyro" else "force"
        if name == "bias":
            elements[""] = truth.bias(t)
        elif name == "scale_factor":
            elements[""] = along[own] * (1.0 + truth.scale(t, along[own] * x)) - 1.0
        elif name == "misalignment":
            elements = {f"{signal} {'xyz'[j]}": along[j] / along[own] for j in range(3) if j != own}
        else:
            elements = {f"force {'xyz'[j]}": truth.force[j] for j in range(3)}
        for of, true in elements.items():
            terms = [term for term in channel["term"] if term["name"].startswith(name)]
            said = [term_values(term, *held(channel, t, x)) for term in terms if not of or term["signals"] == [of]]
            squares.append((sum(said, np.zeros(len(t))) - true) ** 2)
    return np.sqrt(np.mean(squares, axis=0))


def held(channel: dict[str, Any], t: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Beyond what the data covered a calibration holds its values at the edge."""
    low, high = map(number, channel["valid_temperature"])
    slow, fast = (DEG * number(rate) for rate in channel.get("valid_rate", ("0", "0")))
    return np.clip(t, low, high), np.clip(x, slow, fast)


def term_values(term: dict[str, Any], t: Floats, x: Floats) -> Floats:
    """A term's values at temperatures and rates, from its file: temperature by temperature, the powers of the rate."""
    values = np.array(list(term["coefficients"].values()), float)
    over_t, over_x = (
        basis(term[key], at) if key in term else np.ones((1, len(t))) for key, at in (("temperature", t), ("rate", x))
    )
    return np.einsum("ij,in,jn->n", values.reshape(len(over_t), len(over_x)), over_t, over_x)


def basis(of: dict[str, Any], x: Floats) -> Floats:
    rate = "deg/s" in of["scale"]
    centre = number(of.get("centre", "0"))
    assert centre == 0.0 or not rate
    return ((x - centre) / (number(of["scale"]) * (DEG if rate else 1.0))) ** np.arange(of["degree"] + 1)[:, None]
