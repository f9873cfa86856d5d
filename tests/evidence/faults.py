"""The injected faults: what each changes in a scene, and what a user would have to be told.

A fault is a change of the *physics* (or of the rows on their way into the file). `words` is what a sentence must
contain so that its reader looks in the right place; it was written from what he needs, not from what is printed today.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from fault_changes import (
    Change,
    added,
    after_ramps,
    also,
    angles,
    behind,
    bench,
    chain,
    climate,
    column,
    counted,
    course,
    dead_band,
    encoder,
    factors,
    flexing,
    forces,
    grown,
    gyros,
    kept,
    later,
    leaning,
    marked,
    noisier,
    odd_turns,
    one_late,
    one_sided,
    outer_axis,
    quartz,
    repeated,
    rotated,
    rows,
    scaled,
    slipped_in_its_bracket,
    spec,
    stale,
    stepped,
    telegraph,
    temperature,
    tilting,
    tipped,
    values,
    with_host,
    wobbling,
)
from fault_scenes import END, Scene, scene_of
from physics_log import DEG, DEG_H, PPM, G, creep, play

# --- what a user needs to hear ----------------------------------------------------------------------------------------

_BOTH_WAYS = r"heating (against|and|from) cooling"
_TEMPERATURE = r"(the )?(measured )?temperature"
_BEYOND = r"(beyond|outside|not reach|never reach|not cover)"
EARTH = r"earth|latitude"
CLOCK = r"clock"
ENCODER_SCALE = r"(encoder|table).*(scale|graduation)|(scale|graduation).*(encoder|table)|angle.*scale factor"
INPUT_AXIS = r"mounting|input axis|misalign|alignment"
LAG = rf"\blags?\b|lagging|behind (the|its) (thermometer|temperature)|time constant|path|{_BOTH_WAYS}"
THERMOMETER = (
    rf"thermometer|(temperature sensor|sensor of {_TEMPERATURE}|error of {_TEMPERATURE}|self-heat|temperature.err)"
)
GRADIENT = rf"dT/dt|temperature.gradient|(gradient|rate of change) of {_TEMPERATURE}|K/min|{_BOTH_WAYS}"
FAHRENHEIT = (
    r"fahrenheit|°F|degF|outside (of )?(the )?(spec's )?chamber|chamber.*(range|reaches|goes|ends)"
    rf"|unit of {_TEMPERATURE}"
)
KELVIN = r"in K\b|outside the (chamber|plan)"
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
COLUMN = r"column|unit|sign|times the input"
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
MISALIGNED = rf"misalign|{NOISE}"
SCALE = rf"scale.factor|{NOISE}"


@dataclass(frozen=True)
class Fault:
    """`scene`: axis or unit, of a lean or a full user; `words`: a regular expression; `always`: the log shows it by
    itself, so that it is to be said even where U covers it."""

    name: str
    words: str
    change: Change
    scene: str
    always: bool = False

    def made(self, seed: int) -> Scene:
        scene = scene_of(self.scene, seed)
        self.change(scene)
        return scene

    def __str__(self) -> str:
        return f"{self.name}, {self.scene}"


AXIS, UNIT, AXIS_FULL, UNIT_FULL = "axis, lean", "unit, lean", "axis, full", "unit, full"
FULL = (AXIS_FULL, UNIT_FULL)
LEAN = (AXIS, UNIT)
BOTH_UNITS = (UNIT, UNIT_FULL)
AXIS_UP_DOWN, UNIT_UP_DOWN = f"{AXIS}, up and down", f"{UNIT}, up and down"

# --- the table: name, words, change, scenes ---------------------------------------------------------------------------

_LATITUDE = '[rig.site]\nlatitude = "48 deg"\n'
_TABLE: tuple[tuple[Any, ...], ...] = (
    # What no residual shows, of a spec that says nothing of it.
    ("the Earth's rate, no latitude", EARTH, spec(_LATITUDE), AXIS),
    ("the Earth's rate, the axis points north", EARTH,
     also(spec(_LATITUDE), outer_axis(direction=(0.0, 1.0, 0.0)), gyros(along=(0.0, 1.0, 0.0))), AXIS),
    ("clock 50 ppm fast", CLOCK, chain(clock=50 * PPM), *LEAN),
    ("clock 500 ppm fast", CLOCK, chain(clock=500 * PPM), *LEAN),
    ("encoder scale 1e-4", ENCODER_SCALE, encoder(scale=1e-4), *LEAN),
    ("input axes 1 degree off", INPUT_AXIS, tipped, *LEAN),
    ("die 60 s behind its thermometer", LAG, climate(thermometer_to_die=60.0), *LEAN, AXIS_UP_DOWN, UNIT_UP_DOWN),
    ("thermometer 60 s behind the die", LAG, behind(60.0), *LEAN, UNIT_FULL),
    ("temperatures 120 s late", rf"{LAG}|{NOISE}",
     column("temperature", lambda r: np.interp(r.time - 120.0, r.time, r.temperature)), *FULL),
    ("die 3 K warmer than its thermometer", THERMOMETER, climate(self_heating=3.0), *LEAN),
    ("thermometer 2 K high", THERMOMETER, climate(offset=2.0), AXIS),
    ("thermometer 2 K low", THERMOMETER, climate(offset=-2.0), UNIT),
    ("thermometer 3 % too steep", THERMOMETER, temperature(lambda t: 20.0 + 1.03 * (t - 20.0)), *LEAN),
    ("20 deg/h/(K/min)", GRADIENT, gyros(gradient=20 * DEG_H * 60.0), *LEAN, AXIS_UP_DOWN),
    ("accelerometers: 200 ug/(K/min)", GRADIENT, forces(gradient=200e-6 * G * 60.0), UNIT),
    ("turn-on bias 17 deg/h", TURN_ON, gyros(turn_on=17 * DEG_H), AXIS),
    ("turn-on bias 200 deg/h, in the spec", TURN_ON,
     also(gyros(turn_on=200 * DEG_H), spec('axes = ["x"]\n', 'axes = ["x"]\nturn_on_bias = "200 deg/h"\n')), AXIS),
    ("turn-on bias 30 deg/h", TURN_ON, gyros(turn_on=30 * DEG_H), UNIT),
    ("accelerometers: turn-on bias 2 mg", TURN_ON, forces(turn_on=2e-3 * G), UNIT),
    ("30 deg/h/g along the axis, which points up", G_SENSITIVITY, gyros(force=(0.0, 0.0, 30 * DEG_H / G)), AXIS),
    ("20 deg/h/g, not in the spec", G_SENSITIVITY, gyros(force=np.array([20, -10, 20]) * DEG_H / G), UNIT),
    ("hysteresis of play, 15 deg/h", HYSTERESIS, gyros(hysteresis=play(10.0, 15 * DEG_H)), AXIS, AXIS_FULL),
    ("hysteresis of play, 30 deg/h", HYSTERESIS, gyros(hysteresis=play(10.0, 30 * DEG_H)), UNIT_FULL),
    ("hysteresis of creep, 10 min", HYSTERESIS, gyros(hysteresis=creep(600.0, 1.0 * DEG_H)), AXIS, AXIS_FULL),
    ("hysteresis of creep, 10 min, twice as much", HYSTERESIS, gyros(hysteresis=creep(600.0, 2.0 * DEG_H)), UNIT_FULL),
    ("accelerometers: play of 1 mg", HYSTERESIS, forces(hysteresis=play(10.0, 1e-3 * G)), *BOTH_UNITS),
    # Contradictions that the log or the spec shows by itself.
    ("temperatures in Fahrenheit", FAHRENHEIT, temperature(lambda t: t * 1.8 + 32.0), *LEAN),
    ("temperatures in K", KELVIN, temperature(lambda t: t + 273.15), AXIS),
    ("temperatures in tenths", KELVIN, temperature(lambda t: 10.0 * t), AXIS),
    ("wrong sign of the axis", SIGN, factors({0: -1.0}), AXIS),
    ("wrong sign of gyro y", SIGN, factors({1: -1.0}), UNIT_FULL),
    ("wrong sign of accelerometer z", SIGN, factors({5: -1.0}), UNIT_FULL),
    ("all accelerometers with the wrong sign", SIGN, factors({3: -1.0, 4: -1.0, 5: -1.0}), UNIT_FULL),
    ("all gyros with the wrong sign", SIGN, factors({0: -1.0, 1: -1.0, 2: -1.0}), UNIT_FULL),
    ("gyros x and y swapped", SWAPPED, values(lambda v: v[:, [1, 0, 2, 3, 4, 5]]), UNIT_FULL),
    ("accelerometers x and y swapped", SWAPPED, values(lambda v: v[:, [0, 1, 2, 4, 3, 5]]), UNIT_FULL),
    ("forces in g", FORCE_UNIT, factors({3: 1.0 / G, 4: 1.0 / G, 5: 1.0 / G}), UNIT_FULL),
    ("body turned by 90 degrees about z", ROTATED, values(lambda v: rotated(v, 0.5 * np.pi)), UNIT_FULL),
    ("rates in deg/s", RATE_UNIT, factors({0: 1.0 / DEG, 1: 1.0 / DEG, 2: 1.0 / DEG}), AXIS, UNIT_FULL),
    ("gyro y says twice the rate", RATE_UNIT, factors({1: 2.0}), UNIT_FULL),
    ("gyro z says nothing", rf"{FROZEN}|not a gyro|0 times", factors({2: 0.0}), UNIT_FULL),
    ("time in milliseconds", COLUMN, column("time", lambda r: 1000.0 * r.time), *FULL),
    ("angles in degrees", r"table.s angles in degrees", angles(lambda a: a / DEG), AXIS),
    ("angles in turns", COLUMN, angles(lambda a: a / (2.0 * np.pi)), AXIS),
    ("angles of a gear of two", COLUMN, angles(lambda a: 2.0 * a), AXIS),
    ("angles wrapped at 360 degrees", r"wrap at 360 deg", angles(lambda a: np.mod(a, 2.0 * np.pi)), AXIS),
    ("angles of the two axes swapped", SWAPPED, angles(lambda a: a[:, ::-1]), UNIT_FULL),
    ("angles late by one standstill", rf"{SLIP}|{COLUMN}", column("angles", one_late), *FULL),
    ("the inner axis counts backwards", SIGN, angles(lambda a: a * [1.0, -1.0]), UNIT_FULL),
    ("zero of the outer axis 3 deg off", TABLE, angles(lambda a: a + np.array([3.0 * DEG, 0.0])), UNIT_FULL),
    # Less than the plan.
    ("run cut at a fifth of the plan", CUT, kept(lambda r: slice(int(117 / 600 * len(r.time)))), "always", AXIS,
     UNIT_FULL),
    ("run cut at two thirds", BEYOND_T, kept(lambda r: slice(int(0.66 * len(r.time)))), UNIT),
    ("the chamber stays at 20 degC", BEYOND_T, climate(corners=((0.0, -20.0), (END / 2, 20.0), (END, 20.0))), *LEAN),
    ("the table never turns faster than 60 deg/s", BEYOND_RATE, lambda scene: setattr(scene, "top_rate", 60.0), *LEAN),
    # The computer's clock, which the log has.
    ("clock 50 ppm fast, host time in the log", CLOCK, chain(clock=50 * PPM, host=2e-4), "always", AXIS),
    ("clock 500 ppm fast, host time in the log", CLOCK, chain(clock=500 * PPM, host=2e-4), "always", *LEAN),
    ("clock 100 ppm fast where the spec says 5, host time in the log", CLOCK, chain(clock=100 * PPM, host=2e-4),
     "always", AXIS_FULL),
    ("the computer's clock is set by 0.5 s", CLOCK, with_host(lambda r: r.host + 0.5 * later(r)), "always", *FULL,
     AXIS),
    ("the computer's clock 200 ppm off", CLOCK, with_host(lambda r: 1.0002 * r.host), "always", *FULL, AXIS),
    ("a watch's crystal, host time in the log", CLOCK, also(chain(host=2e-4), column("time", quartz)), "always", *FULL,
     UNIT),
    ("a watch's crystal", CLOCK, column("time", quartz), AXIS),
    # Electronics.
    ("saturation at 180 deg/s", SATURATION, chain(limit={"gyro": 180 * DEG}), AXIS_FULL),
    ("saturation at 290 deg/s", SATURATION, chain(limit={"gyro": 290 * DEG}), UNIT_FULL),
    ("saturation of accelerometers at 0.999 g", SATURATION, chain(limit={"accelerometer": 0.999 * G}), UNIT_FULL),
    ("clipped on one side", SATURATION, values(one_sided), "always", *FULL),
    ("quantised to 0.2 deg/s and 20 mg", QUANTISED, chain(step={"gyro": 0.2 * DEG, "accelerometer": 0.02 * G}), *FULL),
    ("dead band of 0.02 deg/s", rf"{NOISE}|repeat", values(dead_band), *FULL),
    ("low-pass of 2 Hz", FILTER, chain(low_pass=2.0), *FULL),
    ("low-pass of 8 Hz", FILTER, chain(low_pass=8.0), *FULL),
    ("samples 0.3 s old", FILTER, chain(delay=0.3), AXIS_FULL),
    ("1 % of the rows lost", DROPPED, chain(lost=0.01), *FULL),
    ("five seconds lost of every fifty", DROPPED, kept(lambda r: np.arange(len(r.time)) % 2500 < 2250), "always",
     *FULL),
    ("a minute is lost", DROPPED, kept(lambda r: (r.time <= 1190.0) | (r.time >= 1260.0)), "always", *FULL),
    ("200 rows lost, stamps counted", rf"{DROPPED}|{NOISE}", rows(counted), *FULL),
    ("two samples lost on each ramp", DROPPED, kept(lambda r: after_ramps(r, 2)), *FULL),
    ("the last sample repeated on each ramp", rf"repeat|{DROPPED}", column("values", repeated), *FULL),
    ("ten seconds of an old buffer", rf"{EVENT}|{FROZEN}|{COLUMN}", column("values", stale), *FULL),
    ("3 % of the stamps 15 ms late", LATE, chain(late=(0.03, 0.015)), *FULL),
    ("spikes of 50 deg/s in 0.02 % of the samples", SPIKES, chain(spikes=(2e-4, 50 * DEG)), *FULL),
    ("gyro x freezes for a minute", FROZEN, chain(frozen=(1000.0, 1060.0, (0,))), AXIS_FULL),
    ("accelerometer x freezes for a minute", FROZEN, chain(frozen=(1000.0, 1060.0, (3,))), UNIT_FULL),
    ("all channels freeze for a minute", FROZEN, chain(frozen=(1000.0, 1060.0, (0, 1, 2, 3, 4, 5))), UNIT_FULL),
    ("gyro y dies", rf"{FROZEN}|{BEYOND_T}",
     grown(1, lambda r: -later(r, 1800.0)), *BOTH_UNITS),
    ("the thermometer freezes for ten minutes", FROZEN, climate(frozen=(300.0, 900.0)), *FULL),
    ("the thermometer has steps of 2 K", STEPS_OF_T, climate(step=2.0), AXIS_FULL),
    ("the thermometer is dead", rf"{BEYOND_T}|thermometer|{NOISE}",
     temperature(lambda t: 25.0 + 0.01 * np.random.default_rng(1).standard_normal(len(t))), *LEAN),
    # Table.
    ("encoder slips by 0.5 deg in mid-run", SLIP, encoder(slip=(1206.0, 0.5)), *FULL),
    ("encoder slips by 0.5 deg in a turn", SLIP, encoder(slip=(1214.0, 0.5)), AXIS_FULL),
    ("a whole turn slips", rf"{SLIP}|do not agree|readings of the table", encoder(slip=(1214.0, 360.0)), *FULL),
    ("wobble of 200 arcsec", WOBBLE, wobbling(200 / 3600 * DEG), AXIS_FULL),
    ("wobble of 60 arcsec", WOBBLE, wobbling(60 / 3600 * DEG), UNIT_FULL),
    ("encoder harmonic of 0.05 deg, turns not whole", HARMONICS, also(odd_turns, encoder(waves={1: (0.03, 0.04)})),
     AXIS),
    ("encoder harmonic of 0.02 deg", HARMONICS, encoder(waves={1: (0.012, 0.016)}), UNIT),
    ("third harmonic of the encoder, 0.05 deg", HARMONICS, encoder(waves={3: (0.03, 0.04)}), UNIT_FULL),
    ("second harmonic of the encoder, 0.005 deg", HARMONICS, encoder(waves={2: (0.003, 0.004)}), UNIT_FULL),
    ("backlash of 0.02 deg", BACKLASH, encoder(backlash=0.02), *LEAN, *FULL),
    ("encoder steps of 0.1 deg", NOISE, encoder(step=0.1), *FULL),
    ("'in position' 0.3 s too early", STILL, marked(15, 0), *FULL),
    ("standstills marked 0.3 s too long", STILL, marked(0, 15), *FULL),
    ("every other standstill is not marked", rf"{STILL}|{NOISE}|{BEYOND_T}|of the plan",
     column("stands", lambda r: np.where(r.stands % 2 == 1, -1, r.stands)), AXIS),
    ("base tilted by 3 mrad", TABLE, bench(base=(3e-3, 0.0, 0.0)), UNIT),
    ("the base tilts by 0.3 mrad in the run", rf"{TABLE}|{NOISE}", column("values", tilting), *BOTH_UNITS),
    ("axes 2 mrad off a right angle", TABLE, outer_axis(skew=2e-3), UNIT),
    ("gravity not stated, 180 ug more than standard", SITE,
     also(spec('gravity = "9.80665 m/s^2"\n'), bench(gravity=G * (1 + 180e-6))), UNIT),
    ("latitude of another town, 10 degrees off", SITE, bench(latitude=38.0), UNIT_FULL),
    # Vibration and noise.
    ("vibration on the move, 3 deg/s rms", VIBRATION, gyros(vibration=3 * DEG), AXIS_FULL),
    ("vibration on the move, 30 deg/h rectified", VIBRATION, gyros(vibration=1 * DEG, rectified=30 * DEG_H), AXIS_FULL),
    ("vibration on the move, 60 deg/h rectified", VIBRATION, gyros(vibration=1 * DEG, rectified=60 * DEG_H), UNIT_FULL),
    ("noise four times the spec's", NOISE, noisier(4.0, 1.0), AXIS_FULL),
    ("drift eight times the spec's", NOISE, noisier(1.0, 8.0), AXIS_FULL),
    ("noise and drift four times the spec's", NOISE, noisier(4.0, 4.0), UNIT_FULL),
    ("scale factor drifts by 100 ppm in 20 min", INSTABILITY, gyros(scale_drift=((100 * PPM, 1200.0),)), *LEAN),
    ("a beat of 100 s, 40 deg/h", NOISE, added(0, lambda r: 40 * DEG_H * np.sin(2.0 * np.pi * r.time / 100.0)), *FULL),
    ("a random telegraph of 40 deg/h", NOISE, added(0, telegraph), *FULL, UNIT),
    # Events.
    ("bias jumps by 60 deg/h", EVENT, added(0, lambda r: 60 * DEG_H * later(r, 1000.0)), *FULL),
    ("scale factor jumps by 300 ppm", EVENT, grown(0, lambda r: 300 * PPM * later(r)), *FULL),
    ("another sensor from the middle on", EVENT,
     also(grown(0, lambda r: 2e-3 * later(r)), added(0, lambda r: 100 * DEG_H * later(r))), *FULL),
    ("accelerometer x jumps by 2 mg", rf"{EVENT}|{NOISE}",
     added(3, lambda r: 2e-3 * G * later(r, r.time.mean())), UNIT_FULL),
    ("the unit turns by 2 mrad in its bracket", EVENT, column("values", slipped_in_its_bracket), UNIT_FULL),
    ("transient of 100 deg/h after power-on", EVENT,
     added(0, lambda r: 100 * DEG_H * np.exp(-(r.time - r.time[0]) / 600.0)), *FULL),
    ("a scale factor grows by 200 ppm", INSTABILITY,
     grown(0, lambda r: 200 * PPM * course(r)), *FULL),
    # Maps that the spec's functions cannot follow, and what no term of a spec is.
    ("cubic of the rate, 300 ppm", STRUCTURE, scaled(lambda t, x: 300 * PPM * (x / (200 * DEG)) ** 3), *FULL),
    ("scale factor differs by direction, ±100 ppm", STRUCTURE,
     scaled(lambda t, x: 100 * PPM * np.tanh(x / (5.0 * DEG))), *FULL),
    ("bias steps by 30 deg/h at 30 degC", STRUCTURE, stepped, *FULL),
    ("accelerometers differ by direction, ±300 ppm", rf"asymmetr|{NOISE}",
     scaled(lambda t, x: 300 * PPM * np.tanh(x / (0.05 * G)), "accelerometer"), *BOTH_UNITS),
    ("accelerometers 100 ug/g2, not in the spec", rf"second.order|square|nonlinear|{NOISE}", forces(square=100e-6 / G),
     UNIT),
    ("gyro x leans by 1 mrad over 40 K", MISALIGNED, leaning(0, 1), *BOTH_UNITS),
    ("accelerometer x leans by 1 mrad over 40 K", MISALIGNED, leaning(3, 4), UNIT_FULL),
    ("a body that leans by 0.3 mrad/g", NOISE, values(flexing), *BOTH_UNITS),
    ("scale factor 150 ppm/g", SCALE, grown(2, lambda r: 150 * PPM * r.values[:, 5] / G), *BOTH_UNITS),
    ("g-sensitivity over temperature, 10 deg/h/g", NOISE,
     added(0, lambda r: 10 * DEG_H * (r.temperature - 20.0) / 40.0 * r.values[:, 5] / G), UNIT_FULL),
    ("bias by heading, 8 deg/h", rf"magnet|attitude|{NOISE}",
     also(added(0, lambda r: 8 * DEG_H * np.cos(r.angles[:, -1])),
          added(1, lambda r: -8 * DEG_H * np.sin(r.angles[:, -1]))), *BOTH_UNITS),
)  # fmt: skip

FAULTS = tuple(
    Fault(name, words, change, scene, "always" in scenes)
    for name, words, change, *scenes in _TABLE
    for scene in scenes
    if scene != "always"
)

# What no log can show: it must be said all the same.
UNSEEN = (
    # 70 ppm at -20 degC, where the spec says 5 and no other clock is in the log.
    Fault("a watch's crystal", r"does not compare the sensor's clock", column("time", quartz), AXIS_FULL),
    # Neither is a change over time on a ramp in one direction other than one over temperature.
    Fault("an accelerometer's scale factor grows by 500 ppm", r"one-way ramp.*drift",
          grown(3, lambda r: 500 * PPM * course(r)), f"{UNIT_FULL}, one ramp"),
)  # fmt: skip
