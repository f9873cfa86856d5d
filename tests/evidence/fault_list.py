"""The injected faults: what each changes in a scene, and what a user would have to be told.

A fault is a change of the *physics* (or of the rows on their way into the file). `words` is what a sentence must
contain so that its reader looks in the right place; it was written from what he needs, not from what is printed today.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from fault_scenes import END, Scene, axis_scene, unit_scene
from physics_log import DEG, DEG_H, PPM, Channel, G, Recorded, Rest, Turn, creep, play

# --- what a user needs to hear ----------------------------------------------------------------------------------------

EARTH = r"earth|latitude"
CLOCK = r"clock"
ENCODER_SCALE = r"(encoder|table).*(scale|graduation)|(scale|graduation).*(encoder|table)|angle.*scale factor"
INPUT_AXIS = r"mounting|input axis|misalign|alignment"
_BOTH_WAYS = r"heating (against|and|from) cooling"
_TEMPERATURE = r"(the )?(measured )?temperature"
_BEYOND = r"(beyond|outside|not reach|never reach|not cover)"
LAG = rf"\blags?\b|lagging|behind (the|its) (thermometer|temperature)|time constant|path|{_BOTH_WAYS}"
THERMOMETER = (
    rf"thermometer|(temperature sensor|sensor of {_TEMPERATURE}|error of {_TEMPERATURE}|self-heat|temperature.err)"
)
GRADIENT = rf"dT/dt|temperature.gradient|(gradient|rate of change) of {_TEMPERATURE}|K/min|{_BOTH_WAYS}"
FAHRENHEIT = (
    r"fahrenheit|°F|degF|outside (of )?(the )?(spec's )?chamber|chamber.*(range|reaches|goes|ends)"
    rf"|unit of {_TEMPERATURE}"
)
SATURATION = r"saturat|full scale|clipp"
QUANTISED = r"quanti[sz]|resolution|least significant|white|noise|steps of"
DROPPED = r"missing|lost|gaps?\b|dropped|irregular|uneven"
LATE = r"late\b|jitter|stamps?|irregular|uneven|noise|white"
SLIP = r"slip|jump|encoder|table.s angle|contradict|cannot explain|disagree"
WOBBLE = r"wobble|table|axis of rotation|χ²|chi-squared|residuals|do not agree|contradict|disagree"
VIBRATION = r"vibrat|noise|white|rectif|on the move|χ²|chi-squared"
SIGN = r"sign\b|direction|reversed|not an? (gyro|accelerometer)|opposite"
SWAPPED = r"swap|exchang|other axis|wrong axis|misalign|order of (the )?axes|not an? (gyro|accelerometer)"
FORCE_UNIT = r"m/s|unit of|\bin g\b|not an accelerometer|scale.factor error"
ROTATED = r"mount|misalign|rotat|turned by|orientation|not an? (gyro|accelerometer)"
BEYOND_T = rf"{_BEYOND}.*(temperature|°C|degC)|(temperature|°C|degC).*{_BEYOND}"
BEYOND_RATE = rf"{_BEYOND}.*(rate|deg/s)|(rates?|deg/s).*{_BEYOND}"
RATE_UNIT = r"unit|deg/s.*rad|rad.*deg|not a gyro|scale.factor error"
ANGLE_UNIT = r"table.s angles in degrees"
WRAPPED = r"wrap at 360 deg"
FILTER = r"filter|delay|bandwidth|latency|standstill"
TURN_ON = r"turn.on|power.?(on|up)|switched on|another power"
G_SENSITIVITY = r"g.sensitiv|acceleration.sensitiv|sensitivity to (the )?(acceleration|specific force)|attitude"
HYSTERESIS = rf"hysteresis|{_BOTH_WAYS}|path|\blags?\b"
FROZEN = r"fro[zs]en?|freez|stuck|repeats?|unchanged|constant"
CUT = r"stopped|broke off|broken off|ended (early|before)|shorter than|incomplete|lacks|not executed|of the plan"
INSTABILITY = r"instabilit|scale.factor.*(drift|unstable|varies)|χ²|chi-squared|noise|white|disagree|contradict"
NOISE = r"noise|residuals are|χ²|chi-squared|white|drift"
HARMONICS = r"harmonic|encoder|eccentric|repeats with the angle|angle error|table"
BACKLASH = r"backlash of|have backlash"
SITE = r"gravity|latitude|site"
TABLE = r"tilt|level|table|base|orthogonal|azimuth|installation"
STRUCTURE = r"structure|degree|does not fit|beyond the model|model"
SPIKES = r"spike|outlier|robust|beyond 3σ|single|cannot explain|χ²|chi-squared"
EVENT = r"jump|knock|slip|moved|drift|disagree|changes|transient"
STILL = r"standstill|settl|marked|still moving|not at rest|stands"
STEPS_OF_T = r"thermometer|temperature.*(resolution|steps|coarse|quanti)|resolution.*temperature"


@dataclass(frozen=True)
class Fault:
    """`scene`: axis or unit, of a lean or a full user; `words`: a regular expression; `always`: the log shows it by
    itself, so that it is to be said even where U covers it."""

    name: str
    scene: str
    words: str
    change: Callable[[Scene], None]
    both_ways: bool | None = None
    always: bool = False

    def made(self, seed: int) -> Scene:
        kind, _, user = self.scene.partition(", ")
        scene = (axis_scene if kind == "axis" else unit_scene)(user == "full", seed, self.both_ways)
        self.change(scene)
        return scene

    def __str__(self) -> str:
        return f"{self.name}, {self.scene}"


def none(scene: Scene) -> None:
    """Nothing is wrong."""


# --- changes that several faults share --------------------------------------------------------------------------------


def every(**fields: object) -> Callable[[Scene], None]:
    """Of every gyro."""

    def change(scene: Scene) -> None:
        scene.channels = [replace(c, **fields) if c.kind == "gyro" else c for c in scene.channels]

    return change


def chain(**fields: object) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        scene.chain = replace(scene.chain, **fields)

    return change


def climate(**fields: object) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        scene.climate = replace(scene.climate, **fields)

    return change


def encoders(**fields: object) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        for axis in scene.bench.axes[-1:]:
            axis.encoder = replace(axis.encoder, **fields)

    return change


def bench(**fields: object) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        scene.bench = replace(scene.bench, **fields)

    return change


def rows(edit: Callable[[Recorded], Recorded]) -> Callable[[Scene], None]:
    return lambda scene: scene.edits.append(edit)


def values(edit: Callable[[np.ndarray], np.ndarray]) -> Callable[[Scene], None]:
    """Of the samples `[row, channel]`, gyros first."""
    return rows(lambda r: replace(r, values=edit(r.values)))


def also(*changes: Callable[[Scene], None]) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        for one in changes:
            one(scene)

    return change


def without(*keys: str) -> Callable[[Scene], None]:
    return lambda scene: scene.without(*keys)


def no_latitude(scene: Scene) -> None:
    scene.replace('[rig.site]\nlatitude = "48 deg"\n', "")


def tipped(scene: Scene) -> None:
    """Input axes one degree from where they should be: of one gyro towards East; of a unit, as a whole about East."""
    c, s = np.cos(DEG), np.sin(DEG)
    if scene.kind == "axis":
        scene.channels = [replace(scene.channels[0], along=(s, 0.0, c))]
    else:
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        scene.channels = [replace(one, along=tuple(turn @ np.array(one.along))) for one in scene.channels]


def _first(r: Recorded, n: int) -> Recorded:
    host = None if r.host is None else r.host[:n]
    return Recorded(r.time[:n], r.values[:n], r.temperature[:n], r.angles[:n], r.stands[:n], host)


def stopped_after(share: float) -> Callable[[Scene], None]:
    return rows(lambda r: _first(r, int(share * len(r.time))))


def slower(scene: Scene) -> None:
    """The table never goes faster than 60 deg/s; the plan does as it was written."""
    moves = tuple(replace(m, rate=min(m.rate, 60.0)) if isinstance(m, Turn) else m for m in scene.motion.moves)
    scene.motion = replace(scene.motion, moves=moves)


def swapped(v: np.ndarray) -> np.ndarray:
    return v[:, [1, 0, *range(2, v.shape[1])]]


def quarter(v: np.ndarray) -> np.ndarray:
    """The whole body, a quarter turn about z."""
    return np.column_stack([v[:, 1], -v[:, 0], v[:, 2], v[:, 4], -v[:, 3], v[:, 5]])


def flipped(k: int) -> Callable[[Scene], None]:
    return values(lambda v: v * np.where(np.arange(v.shape[1]) == k, -1.0, 1.0))


def in_g(v: np.ndarray) -> np.ndarray:
    return v / np.array([1.0, 1.0, 1.0, G, G, G])


def in_degrees(v: np.ndarray) -> np.ndarray:
    return v * np.where(np.arange(v.shape[1]) < max(1, v.shape[1] // 2), 1.0 / DEG, 1.0)


def doubled(v: np.ndarray) -> np.ndarray:
    return v * np.where(np.arange(v.shape[1]) == 1, 2.0, 1.0)


def in_fahrenheit(r: Recorded) -> Recorded:
    return replace(r, temperature=r.temperature * 1.8 + 32.0)


def early(r: Recorded) -> Recorded:
    """The controller says "in position" 0.3 s before it is."""
    stands = r.stands.copy()
    for k in np.flatnonzero((stands[1:] >= 0) & (stands[:-1] < 0)) + 1:
        stands[max(0, k - 15) : k] = stands[k]
    return replace(r, stands=stands)


def wrapped(r: Recorded) -> Recorded:
    return replace(r, angles=np.mod(r.angles, 2.0 * np.pi))


def kinked(size: float) -> Callable[[Scene], None]:
    """A scale factor that differs by direction: `size` to either side, smooth within ±5 deg/s."""

    def change(scene: Scene) -> None:
        def one(c: Channel) -> Channel:
            scale = c.scale
            return replace(c, scale=lambda t, x: scale(t, x) + size * np.tanh(x / (5.0 * DEG)))

        scene.channels = [one(c) if c.kind == "gyro" else c for c in scene.channels]

    return change


def cubic(scene: Scene) -> None:
    def one(c: Channel) -> Channel:
        scale = c.scale
        return replace(c, scale=lambda t, x: scale(t, x) + 300 * PPM * (x / (200 * DEG)) ** 3)

    scene.channels = [one(c) if c.kind == "gyro" else c for c in scene.channels]


def stepped(size: float) -> Callable[[Scene], None]:
    """A bias that steps at 30 °C, as at a change of phase in a glue."""

    def change(scene: Scene) -> None:
        def one(c: Channel) -> Channel:
            bias = c.bias
            return replace(c, bias=lambda t: bias(t) + size * (np.tanh((t - 30.0) / 1.0) + 1.0) / 2.0)

        scene.channels = [one(c) if c.kind == "gyro" else c for c in scene.channels]

    return change


def noisier(by: float) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        scene.channels = [replace(c, white=c.white * by) for c in scene.channels]

    return change


def drifting(by: float) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        scene.channels = [replace(c, drift=tuple((s * by, tau) for s, tau in c.drift)) for c in scene.channels]

    return change


def skewed(scene: Scene) -> None:
    scene.bench.axes[0].skew = 2e-3


def wobbling(size: float) -> Callable[[Scene], None]:
    """Twice a turn: a cone drawn once a turn is a stage mounted askew, and no wobble."""

    def change(scene: Scene) -> None:
        for axis in scene.bench.axes:
            axis.wobble, axis.wobble_order = size, 2

    return change


def odd_turns(scene: Scene) -> None:
    """Turns that are not whole: 600 and 250 deg."""
    moves = tuple(replace(m, angle=m.angle / 3.0) if isinstance(m, Turn) else m for m in scene.motion.moves)
    scene.motion = replace(scene.motion, moves=(*moves, Rest(1.0)))
    for old, new in (('"1800 deg"', '"600 deg"'), ('"-1800 deg"', '"-600 deg"'),
                     ('"720 deg"', '"240 deg"'), ('"-720 deg"', '"-240 deg"')):  # fmt: skip
        scene.replace(old, new)
    scene.replace("\n]\n", '\n  { rest = "1 s" },\n]\n')


def later(second: float, edit: Callable[[np.ndarray], np.ndarray]) -> Callable[[Scene], None]:
    """A change of the samples from a time on."""

    def change(r: Recorded) -> Recorded:
        return replace(r, values=np.where((r.time > second)[:, None], edit(r.values), r.values))

    return rows(change)


def of_first(factor: float = 1.0, more: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    """Of the first gyro alone."""
    return lambda v: (
        v * np.where(np.arange(v.shape[1]) == 0, factor, 1.0) + np.where(np.arange(v.shape[1]) == 0, more, 0)
    )


def warming(r: Recorded) -> Recorded:
    """A transient of 100 deg/h after the power is on."""
    course = 100 * DEG_H * np.exp(-(r.time - r.time[0]) / 600.0)
    return replace(r, values=r.values + course[:, None] * (np.arange(r.values.shape[1]) == 0))


def one_sided(v: np.ndarray) -> np.ndarray:
    return np.where(np.arange(v.shape[1]) == 0, np.minimum(v, (150.0 if v.shape[1] == 1 else 250.0) * DEG), v)


def slipped_in_its_bracket(v: np.ndarray) -> np.ndarray:
    c, s = np.cos(2e-3), np.sin(2e-3)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.column_stack([v[:, :3] @ turn, v[:, 3:] @ turn])


def in_bursts(r: Recorded) -> Recorded:
    """Five seconds of every fifty are lost."""
    kept = np.arange(len(r.time)) % 2500 < 2250
    host = None if r.host is None else r.host[kept]
    return Recorded(r.time[kept], r.values[kept], r.temperature[kept], r.angles[kept], r.stands[kept], host)


def marked_late(r: Recorded) -> Recorded:
    """Standstills that are marked 0.3 s longer than they last."""
    stands = r.stands.copy()
    for k in np.flatnonzero((stands[1:] < 0) & (stands[:-1] >= 0)) + 1:
        stands[k : k + 15] = stands[k - 1]
    return replace(r, stands=stands)


def half_heated(scene: Scene) -> None:
    """The chamber fails at 20 °C and stays there; the plan says 60."""
    scene.climate = replace(scene.climate, corners=((0.0, -20.0), (END / 2, 20.0), (END, 20.0)))


def of_forces(**fields: object) -> Callable[[Scene], None]:
    """Of every accelerometer."""

    def change(scene: Scene) -> None:
        scene.channels = [replace(c, **fields) if c.kind == "accelerometer" else c for c in scene.channels]

    return change


def leaning(channel: int, towards: int) -> Callable[[Scene], None]:
    """A misalignment that changes by 1 mrad over 40 K."""

    def change(r: Recorded) -> Recorded:
        more = np.zeros_like(r.values)
        more[:, channel] = 1e-3 * (r.temperature - 20.0) / 40.0 * r.values[:, towards]
        return replace(r, values=r.values + more)

    return rows(change)


def behind(seconds: float) -> Callable[[Scene], None]:
    """The thermometer follows the die."""

    def change(r: Recorded) -> Recorded:
        own, share = r.temperature.copy(), (r.time[1] - r.time[0]) / seconds
        for k in range(1, len(own)):
            own[k] = own[k - 1] + share * (r.temperature[k] - own[k - 1])
        return replace(r, temperature=own)

    return rows(change)


def steep(r: Recorded) -> Recorded:
    """A thermometer whose degrees are 3 % too small."""
    return replace(r, temperature=20.0 + 1.03 * (r.temperature - 20.0))


def by_heading(r: Recorded) -> Recorded:
    """A bias of 8 deg/h that points to a place in the room, as by a magnetic field."""
    angle, none_of_them = r.angles[:, -1], np.zeros((len(r.time), r.values.shape[1] - 2))
    field = 8 * DEG_H * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    return replace(r, values=r.values + np.concatenate([field, none_of_them], axis=1))


def by_acceleration(v: np.ndarray) -> np.ndarray:
    """A scale factor of gyro z that depends on the acceleration along z, 150 ppm/g."""
    return v * np.where(np.arange(v.shape[1]) == 2, 1.0 + 150 * PPM * v[:, 5:6] / G, 1.0)


def beating(r: Recorded) -> Recorded:
    """40 deg/h with a period of 100 s in the first gyro, as of two sample rates."""
    more = 40 * DEG_H * np.sin(2.0 * np.pi * r.time / 100.0)
    return replace(r, values=r.values + more[:, None] * (np.arange(r.values.shape[1]) == 0))


def by_direction_of_force(scene: Scene) -> None:
    def one(c: Channel) -> Channel:
        scale = c.scale
        return replace(c, scale=lambda t, x: scale(t, x) + 300 * PPM * np.tanh(x / (0.05 * G)))

    scene.channels = [one(c) if c.kind == "accelerometer" else c for c in scene.channels]


def zero_of_outer_axis(r: Recorded) -> Recorded:
    return replace(r, angles=r.angles + np.array([3.0 * DEG, 0.0]))


def force_jumps(r: Recorded) -> Recorded:
    """Accelerometer x, by 2 mg, in the middle."""
    later = r.time > r.time.mean()
    return replace(r, values=r.values + 2e-3 * G * later[:, None] * (np.arange(r.values.shape[1]) == 3))


def on_ramps(rows_lost: int, held: bool) -> Callable[[Scene], None]:
    """Samples that are lost 0.4 s after each move begins, as of a buffer that overflows, or are the last one again."""

    def change(r: Recorded) -> Recorded:
        begins = np.flatnonzero((r.stands[1:] < 0) & (r.stands[:-1] >= 0)) + 20
        kept = np.ones(len(r.time), bool)
        kept[(begins[:, None] + np.arange(rows_lost)).ravel()] = False
        if held:
            return replace(r, values=r.values[np.maximum.accumulate(np.where(kept, np.arange(len(kept)), 0))])
        return Recorded(r.time[kept], r.values[kept], r.temperature[kept], r.angles[kept], r.stands[kept])

    return rows(change)


AXIS, UNIT, AXIS_FULL, UNIT_FULL = "axis, lean", "unit, lean", "axis, full", "unit, full"

# --- the list ---------------------------------------------------------------------------------------------------------

FAULTS: tuple[Fault, ...] = (
    # What no residual shows (issue 40, section 4), of a spec that says nothing of it.
    Fault("the Earth's rate, no latitude", AXIS, EARTH, no_latitude),
    Fault("the Earth's rate, the axis points north", AXIS, EARTH,
          also(no_latitude, lambda s: setattr(s.bench.axes[0], "direction", (0.0, 1.0, 0.0)),
               every(along=(0.0, 1.0, 0.0)))),
    Fault("clock 50 ppm fast", AXIS, CLOCK, chain(clock=50 * PPM)),
    Fault("clock 500 ppm fast", AXIS, CLOCK, chain(clock=500 * PPM)),
    Fault("clock 50 ppm fast, host time in the log", AXIS, CLOCK, chain(clock=50 * PPM, host=2e-4), always=True),
    Fault("clock 500 ppm fast, host time in the log", AXIS, CLOCK, chain(clock=500 * PPM, host=2e-4), always=True),
    Fault("clock 50 ppm fast", UNIT, CLOCK, chain(clock=50 * PPM)),
    Fault("clock 500 ppm fast", UNIT, CLOCK, chain(clock=500 * PPM)),
    Fault("clock 500 ppm fast, host time in the log", UNIT, CLOCK, chain(clock=500 * PPM, host=2e-4), always=True),
    Fault("clock 100 ppm fast where the spec says 5, host time in the log", AXIS_FULL, CLOCK,
          chain(clock=100 * PPM, host=2e-4), always=True),
    Fault("encoder scale 1e-4", AXIS, ENCODER_SCALE, encoders(scale=1e-4)),
    Fault("encoder scale 1e-4 of the inner axis", UNIT, ENCODER_SCALE, encoders(scale=1e-4)),
    Fault("input axis 1 degree off the table's", AXIS, INPUT_AXIS, tipped),
    Fault("unit mounted 1 degree off, prior 10 mrad", UNIT, INPUT_AXIS, tipped),
    Fault("die 60 s behind its thermometer, one ramp", AXIS, LAG, climate(thermometer_to_die=60.0)),
    Fault("die 60 s behind its thermometer, up and down", AXIS, LAG, climate(thermometer_to_die=60.0), True),
    Fault("die 60 s behind its thermometer, one ramp", UNIT, LAG, climate(thermometer_to_die=60.0)),
    Fault("die 60 s behind its thermometer, up and down", UNIT, LAG, climate(thermometer_to_die=60.0), True),
    Fault("die 3 K warmer than its thermometer", AXIS, THERMOMETER, climate(self_heating=3.0)),
    Fault("die 3 K warmer than its thermometer", UNIT, THERMOMETER, climate(self_heating=3.0)),
    Fault("thermometer 2 K off", AXIS, THERMOMETER, climate(offset=2.0)),
    Fault("thermometer 2 K off", UNIT, THERMOMETER, climate(offset=-2.0)),
    Fault("20 deg/h/(K/min), one ramp", AXIS, GRADIENT, every(gradient=20 * DEG_H * 60.0)),
    Fault("20 deg/h/(K/min), up and down", AXIS, GRADIENT, every(gradient=20 * DEG_H * 60.0), True),
    Fault("20 deg/h/(K/min), one ramp", UNIT, GRADIENT, every(gradient=20 * DEG_H * 60.0)),
    Fault("turn-on bias 17 deg/h", AXIS, TURN_ON, every(turn_on=17 * DEG_H)),
    Fault("turn-on bias 200 deg/h, in the spec", AXIS, TURN_ON,
          also(every(turn_on=200 * DEG_H), lambda s: s.replace('axes = ["x"]\nangle',
               'axes = ["x"]\nturn_on_bias = "200 deg/h"\nangle'))),
    Fault("turn-on bias 30 deg/h", UNIT, TURN_ON, every(turn_on=30 * DEG_H)),
    Fault("30 deg/h/g along the axis, which points up", AXIS, G_SENSITIVITY,
          every(force=(0.0, 0.0, 30 * DEG_H / G))),
    Fault("20 deg/h/g, not in the spec", UNIT, G_SENSITIVITY,
          every(force=(20 * DEG_H / G, -10 * DEG_H / G, 20 * DEG_H / G))),
    Fault("hysteresis of play, 15 deg/h, one ramp", AXIS, HYSTERESIS, every(hysteresis=play(10.0, 15 * DEG_H))),
    Fault("hysteresis of play, 15 deg/h, up and down", AXIS_FULL, HYSTERESIS, every(hysteresis=play(10.0, 15 * DEG_H))),
    Fault("hysteresis of creep, 10 min, one ramp", AXIS, HYSTERESIS,
          every(hysteresis=creep(600.0, 1.0 * DEG_H))),
    Fault("hysteresis of creep, 10 min, up and down", AXIS_FULL, HYSTERESIS,
          every(hysteresis=creep(600.0, 1.0 * DEG_H))),
    Fault("hysteresis of play, 30 deg/h, up and down", UNIT_FULL, HYSTERESIS, every(hysteresis=play(10.0, 30 * DEG_H))),
    Fault("hysteresis of creep, 10 min, up and down", UNIT_FULL, HYSTERESIS,
          every(hysteresis=creep(600.0, 2.0 * DEG_H))),
    # Contradictions that the log or the spec shows by itself.
    Fault("temperatures in Fahrenheit", AXIS, FAHRENHEIT, rows(in_fahrenheit)),
    Fault("temperatures in Fahrenheit", UNIT, FAHRENHEIT, rows(in_fahrenheit)),
    Fault("wrong sign of the axis", AXIS, SIGN, flipped(0)),
    Fault("wrong sign of gyro y", UNIT_FULL, SIGN, flipped(1)),
    Fault("wrong sign of accelerometer z", UNIT_FULL, SIGN, flipped(5)),
    Fault("gyros x and y swapped", UNIT_FULL, SWAPPED, values(swapped)),
    Fault("forces in g", UNIT_FULL, FORCE_UNIT, values(in_g)),
    Fault("body turned by 90 degrees about z", UNIT_FULL, ROTATED, values(quarter)),
    Fault("rates in deg/s", AXIS, RATE_UNIT, values(in_degrees)),
    Fault("rates in deg/s", UNIT_FULL, RATE_UNIT, values(in_degrees)),
    Fault("gyro y says twice the rate", UNIT_FULL, RATE_UNIT, values(doubled)),
    Fault("angles of the table in degrees", AXIS, ANGLE_UNIT,
          rows(lambda r: replace(r, angles=r.angles / DEG))),
    Fault("angles of the table wrapped at 360 degrees", AXIS, WRAPPED, rows(wrapped)),
    # Less than the plan.
    Fault("run cut at a fifth of the plan", AXIS, CUT, stopped_after(117 / 600), always=True),
    Fault("run cut at a fifth of the plan", UNIT_FULL, CUT, stopped_after(117 / 600), always=True),
    Fault("run cut at two thirds", UNIT, BEYOND_T, stopped_after(0.66)),
    Fault("the chamber stays at 20 degC", AXIS, BEYOND_T, half_heated),
    Fault("the chamber stays at 20 degC", UNIT, BEYOND_T, half_heated),
    Fault("the table never turns faster than 60 deg/s", AXIS, BEYOND_RATE, slower),
    Fault("the table never turns faster than 60 deg/s", UNIT, BEYOND_RATE, slower),
    # Electronics.
    Fault("saturation at 180 deg/s", AXIS_FULL, SATURATION, chain(limit={"gyro": 180 * DEG})),
    Fault("saturation at 290 deg/s", UNIT_FULL, SATURATION, chain(limit={"gyro": 290 * DEG})),
    Fault("saturation of accelerometers at 0.999 g", UNIT_FULL, SATURATION, chain(limit={"accelerometer": 0.999 * G})),
    Fault("quantised to 0.2 deg/s", AXIS_FULL, QUANTISED, chain(step={"gyro": 0.2 * DEG})),
    Fault("quantised to 0.2 deg/s and 20 mg", UNIT_FULL, QUANTISED,
          chain(step={"gyro": 0.2 * DEG, "accelerometer": 0.02 * G})),
    Fault("low-pass of 2 Hz", AXIS_FULL, FILTER, chain(low_pass=2.0)),
    Fault("low-pass of 2 Hz", UNIT_FULL, FILTER, chain(low_pass=2.0)),
    Fault("samples 0.3 s old", AXIS_FULL, FILTER, chain(delay=0.3)),
    Fault("1 % of the rows lost", AXIS_FULL, DROPPED, chain(lost=0.01)),
    Fault("1 % of the rows lost", UNIT_FULL, DROPPED, chain(lost=0.01)),
    Fault("3 % of the stamps 15 ms late", AXIS_FULL, LATE, chain(late=(0.03, 0.015))),
    Fault("3 % of the stamps 15 ms late", UNIT_FULL, LATE, chain(late=(0.03, 0.015))),
    Fault("spikes of 50 deg/s in 0.02 % of the samples", AXIS_FULL, SPIKES, chain(spikes=(2e-4, 50 * DEG))),
    Fault("spikes of 50 deg/s in 0.02 % of the samples", UNIT_FULL, SPIKES, chain(spikes=(2e-4, 50 * DEG))),
    Fault("the gyro freezes for a minute", AXIS_FULL, FROZEN, chain(frozen=(1000.0, 1060.0, (0,)))),
    Fault("accelerometer x freezes for a minute", UNIT_FULL, FROZEN, chain(frozen=(1000.0, 1060.0, (3,)))),
    Fault("all channels freeze for a minute", UNIT_FULL, FROZEN, chain(frozen=(1000.0, 1060.0, (0, 1, 2, 3, 4, 5)))),
    Fault("the thermometer freezes for ten minutes", AXIS_FULL, FROZEN, climate(frozen=(300.0, 900.0))),
    Fault("the thermometer freezes for ten minutes", UNIT_FULL, FROZEN, climate(frozen=(300.0, 900.0))),
    Fault("the thermometer has steps of 2 K", AXIS_FULL, STEPS_OF_T, climate(step=2.0)),
    # Table.
    Fault("encoder slips by 0.5 deg in mid-run", AXIS_FULL, SLIP, encoders(slip=(1206.0, 0.5))),
    Fault("encoder slips by 0.5 deg in a turn", AXIS_FULL, SLIP, encoders(slip=(1214.0, 0.5))),
    Fault("encoder slips by 0.5 deg in mid-run", UNIT_FULL, SLIP, encoders(slip=(1206.0, 0.5))),
    Fault("wobble of 200 arcsec", AXIS_FULL, WOBBLE, wobbling(200 / 3600 * DEG)),
    Fault("wobble of 60 arcsec", UNIT_FULL, WOBBLE, wobbling(60 / 3600 * DEG)),
    Fault("encoder harmonic of 0.05 deg, turns not whole", AXIS, HARMONICS,
          also(odd_turns, encoders(waves={1: (0.03, 0.04)}))),
    Fault("encoder harmonic of 0.02 deg", UNIT, HARMONICS, encoders(waves={1: (0.012, 0.016)})),
    Fault("'in position' 0.3 s too early", AXIS_FULL, STILL, rows(early)),
    Fault("'in position' 0.3 s too early", UNIT_FULL, STILL, rows(early)),
    Fault("base tilted by 3 mrad", UNIT, TABLE, bench(base=(3e-3, 0.0, 0.0))),
    Fault("axes 2 mrad off a right angle", UNIT, TABLE, skewed),
    Fault("gravity not stated, 180 ug more than standard", UNIT, SITE,
          also(without("gravity ="), bench(gravity=G * (1 + 180e-6)))),
    Fault("latitude of another town, 10 degrees off", UNIT_FULL, SITE, bench(latitude=38.0)),
    # Vibration and noise.
    Fault("vibration on the move, 3 deg/s rms", AXIS_FULL, VIBRATION, every(vibration=3 * DEG)),
    Fault("vibration on the move, 30 deg/h rectified", AXIS_FULL, VIBRATION,
          every(vibration=1 * DEG, rectified=30 * DEG_H)),
    Fault("vibration on the move, 60 deg/h rectified", UNIT_FULL, VIBRATION,
          every(vibration=1 * DEG, rectified=60 * DEG_H)),
    Fault("noise four times the spec's", AXIS_FULL, NOISE, noisier(4.0)),
    Fault("drift eight times the spec's", AXIS_FULL, NOISE, drifting(8.0)),
    Fault("noise and drift four times the spec's", UNIT_FULL, NOISE, also(noisier(4.0), drifting(4.0))),
    Fault("scale factor drifts by 100 ppm in 20 min", AXIS, INSTABILITY, every(scale_drift=((100 * PPM, 1200.0),))),
    Fault("scale factor drifts by 100 ppm in 20 min", UNIT, INSTABILITY, every(scale_drift=((100 * PPM, 1200.0),))),
    # Events.
    Fault("bias jumps by 60 deg/h", AXIS_FULL, EVENT, later(1000.0, of_first(more=60 * DEG_H))),
    Fault("bias jumps by 60 deg/h", UNIT_FULL, EVENT, later(1000.0, of_first(more=60 * DEG_H))),
    Fault("scale factor jumps by 300 ppm", AXIS_FULL, EVENT, later(1200.0, of_first(1.0003))),
    Fault("scale factor jumps by 300 ppm", UNIT_FULL, EVENT, later(1200.0, of_first(1.0003))),
    Fault("the unit turns by 2 mrad in its bracket", UNIT_FULL, EVENT, later(1200.0, slipped_in_its_bracket)),
    Fault("transient of 100 deg/h after power-on", AXIS_FULL, EVENT, rows(warming)),
    Fault("transient of 100 deg/h after power-on", UNIT_FULL, EVENT, rows(warming)),
    Fault("five seconds lost of every fifty", AXIS_FULL, DROPPED, rows(in_bursts), always=True),
    Fault("five seconds lost of every fifty", UNIT_FULL, DROPPED, rows(in_bursts), always=True),
    Fault("two samples lost on each ramp", AXIS_FULL, DROPPED, on_ramps(2, held=False)),
    Fault("two samples lost on each ramp", UNIT_FULL, DROPPED, on_ramps(2, held=False)),
    Fault("the last sample repeated for 0.1 s on each ramp", AXIS_FULL, rf"repeat|{DROPPED}", on_ramps(5, held=True)),
    Fault("the last sample repeated for 0.1 s on each ramp", UNIT_FULL, rf"repeat|{DROPPED}", on_ramps(5, held=True)),
    Fault("clipped on one side", AXIS_FULL, SATURATION, values(one_sided), always=True),
    Fault("clipped on one side", UNIT_FULL, SATURATION, values(one_sided), always=True),
    Fault("standstills marked 0.3 s too long", AXIS_FULL, STILL, rows(marked_late)),
    Fault("standstills marked 0.3 s too long", UNIT_FULL, STILL, rows(marked_late)),
    Fault("angles of the two axes swapped", UNIT_FULL, SWAPPED,
          rows(lambda r: replace(r, angles=r.angles[:, ::-1]))),
    Fault("the inner axis counts backwards", UNIT_FULL, SIGN,
          rows(lambda r: replace(r, angles=r.angles * np.array([1.0, -1.0])))),
    Fault("encoder steps of 0.1 deg", AXIS_FULL, NOISE, encoders(step=0.1 * DEG)),
    Fault("encoder steps of 0.1 deg", UNIT_FULL, NOISE, encoders(step=0.1 * DEG)),
    Fault("third harmonic of the encoder, 0.05 deg", UNIT_FULL, HARMONICS, encoders(waves={3: (0.03, 0.04)})),
    Fault("second harmonic of the encoder, 0.005 deg", UNIT_FULL, HARMONICS, encoders(waves={2: (0.003, 0.004)})),
    Fault("backlash of 0.02 deg", AXIS, BACKLASH, encoders(backlash=0.02)),
    Fault("backlash of 0.02 deg", AXIS_FULL, BACKLASH, encoders(backlash=0.02)),
    Fault("backlash of 0.02 deg", UNIT, BACKLASH, encoders(backlash=0.02)),
    Fault("backlash of 0.02 deg", UNIT_FULL, BACKLASH, encoders(backlash=0.02)),
    # Maps that the spec's functions cannot follow.
    Fault("cubic of the rate, 300 ppm", AXIS_FULL, STRUCTURE, cubic),
    Fault("cubic of the rate, 300 ppm", UNIT_FULL, STRUCTURE, cubic),
    Fault("scale factor differs by direction, ±100 ppm", AXIS_FULL, STRUCTURE, kinked(100 * PPM)),
    Fault("scale factor differs by direction, ±100 ppm", UNIT_FULL, STRUCTURE, kinked(100 * PPM)),
    Fault("bias steps by 30 deg/h at 30 degC", AXIS_FULL, STRUCTURE, stepped(30 * DEG_H)),
    Fault("bias steps by 30 deg/h at 30 degC", UNIT_FULL, STRUCTURE, stepped(30 * DEG_H)),
    # Of the accelerometers, of axes that lean by the temperature, of what no term of a spec is.
    Fault("accelerometers 100 ug/g2, not in the spec", UNIT, rf"second.order|square|nonlinear|{NOISE}",
          of_forces(square=100e-6 / G)),
    Fault("gyro x leans by 1 mrad over 40 K", UNIT, rf"misalign|{NOISE}", leaning(0, 1)),
    Fault("gyro x leans by 1 mrad over 40 K", UNIT_FULL, rf"misalign|{NOISE}", leaning(0, 1)),
    Fault("accelerometer x leans by 1 mrad over 40 K", UNIT_FULL, rf"misalign|{NOISE}", leaning(3, 4)),
    Fault("accelerometers x and y swapped", UNIT_FULL, SWAPPED, values(lambda v: v[:, [0, 1, 2, 4, 3, 5]])),
    Fault("thermometer 3 % too steep", AXIS, THERMOMETER, rows(steep)),
    Fault("thermometer 3 % too steep", UNIT, THERMOMETER, rows(steep)),
    Fault("thermometer 60 s behind the die, one ramp", AXIS, LAG, behind(60.0)),
    Fault("thermometer 60 s behind the die, one ramp", UNIT, LAG, behind(60.0)),
    Fault("thermometer 60 s behind the die, up and down", UNIT_FULL, LAG, behind(60.0)),
    Fault("scale factor 150 ppm/g", UNIT, rf"scale.factor|{NOISE}", values(by_acceleration)),
    Fault("scale factor 150 ppm/g", UNIT_FULL, rf"scale.factor|{NOISE}", values(by_acceleration)),
    Fault("accelerometer x jumps by 2 mg", UNIT_FULL, rf"{EVENT}|{NOISE}", rows(force_jumps)),
    Fault("accelerometers: play of 1 mg, up and down", UNIT_FULL, HYSTERESIS,
          of_forces(hysteresis=play(10.0, 1e-3 * G))),
    Fault("accelerometers: play of 1 mg, one ramp", UNIT, HYSTERESIS, of_forces(hysteresis=play(10.0, 1e-3 * G))),
    Fault("accelerometers: 200 ug/(K/min), one ramp", UNIT, GRADIENT, of_forces(gradient=200e-6 * G * 60.0)),
    Fault("accelerometers: turn-on bias 2 mg", UNIT, TURN_ON, of_forces(turn_on=2e-3 * G)),
    Fault("accelerometers differ by direction, ±300 ppm", UNIT, rf"asymmetr|{NOISE}", by_direction_of_force),
    Fault("accelerometers differ by direction, ±300 ppm", UNIT_FULL, rf"asymmetr|{NOISE}", by_direction_of_force),
    Fault("zero of the outer axis 3 deg off", UNIT_FULL, TABLE, rows(zero_of_outer_axis)),
    Fault("gyro z says nothing", UNIT_FULL, rf"{FROZEN}|not a gyro|0 times", values(lambda v: v * (np.arange(6) != 2))),
    Fault("bias by heading, 8 deg/h", UNIT, rf"magnet|attitude|{NOISE}", rows(by_heading)),
    Fault("bias by heading, 8 deg/h", UNIT_FULL, rf"magnet|attitude|{NOISE}", rows(by_heading)),
    Fault("a beat of 100 s, 40 deg/h", AXIS_FULL, NOISE, rows(beating)),
    Fault("a beat of 100 s, 40 deg/h", UNIT_FULL, NOISE, rows(beating)),
)  # fmt: skip
