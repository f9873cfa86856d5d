"""What a fault changes in a scene: of the physics, or of the rows on their way into the file."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from fault_scenes import Scene
from physics_log import DEG, DEG_H, PPM, Channel, Floats, G, Recorded, Surface

Change = Callable[[Scene], None]
OfRows = Callable[[Recorded], Floats]

# --- of the physics ---------------------------------------------------------------------------------------------------


def also(*changes: Change) -> Change:
    def change(scene: Scene) -> None:
        for one in changes:
            one(scene)

    return change


def nothing(scene: Scene) -> None:
    """Nothing is wrong."""


def channels(edit: Callable[[Channel], dict[str, Any]], kind: str = "") -> Change:
    """Of every channel, or of every one of a kind, other fields."""

    def change(scene: Scene) -> None:
        scene.channels = [replace(c, **edit(c)) if kind in c.kind else c for c in scene.channels]

    return change


def gyros(**fields: Any) -> Change:
    return channels(lambda _: fields, "gyro")


def forces(**fields: Any) -> Change:
    return channels(lambda _: fields, "accelerometer")


def scaled(more: Surface, kind: str = "gyro") -> Change:
    """More of the scale factor, of temperature and input."""
    return channels(lambda c: {"scale": lambda t, x: c.scale(t, x) + more(t, x)}, kind)


def noisier(white: float, drift: float) -> Change:
    """Of all channels, so many times."""
    return channels(lambda c: {"white": c.white * white, "drift": [(s * drift, tau) for s, tau in c.drift]})


def stepped(scene: Scene) -> None:
    """A bias that steps by 30 deg/h at 30 °C, as at a change of phase in a glue."""
    step = lambda t: 15 * DEG_H * (np.tanh(t - 30.0) + 1.0)  # noqa: E731
    channels(lambda c: {"bias": lambda t: c.bias(t) + step(t)}, "gyro")(scene)


def of(part: str, **fields: Any) -> Change:
    """Of the scene's `chain` or `climate`, other fields."""
    return lambda scene: setattr(scene, part, replace(getattr(scene, part), **fields))


def bench(**fields: Any) -> Change:
    return of("bench", **fields)


def chain(**fields: Any) -> Change:
    return of("chain", **fields)


def climate(**fields: Any) -> Change:
    return of("climate", **fields)


def encoder(**fields: Any) -> Change:
    """Of the innermost axis."""

    def change(scene: Scene) -> None:
        axis = scene.bench.axes[-1]
        axis.encoder = replace(axis.encoder, **fields)

    return change


def outer_axis(**fields: Any) -> Change:
    def change(scene: Scene) -> None:
        for name, value in fields.items():
            setattr(scene.bench.axes[0], name, value)

    return change


def wobbling(size: float) -> Change:
    def change(scene: Scene) -> None:
        for axis in scene.bench.axes:
            axis.wobble = size

    return change


def spec(old: str, new: str = "") -> Change:
    """Of the text of the spec alone."""
    return lambda scene: scene.replace(old, new)


def tipped(scene: Scene) -> None:
    """Input axes one degree from where they should be: of one gyro towards East; of a unit, as a whole about East."""
    c, s = np.cos(DEG), np.sin(DEG)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    if len(scene.channels) == 1:
        gyros(along=(s, 0.0, c))(scene)
    else:
        channels(lambda one: {"along": turn @ np.array(one.along)})(scene)


def odd_turns(scene: Scene) -> None:
    """Turns that are not whole: 600 and 240 deg, with the same ramps."""
    for whole, rate, lasts, shorter in ((1800, 200, 10, 4), (720, 60, 13, 5)):
        at = f'peak_rate = "{rate} deg/s", duration = '
        scene.replace(f'{whole} deg", {at}"{lasts} s"', f'{whole // 3} deg", {at}"{shorter} s"')
    scene.replace("\n]\n", '\n  { rest = "1 s" },\n]\n')


# --- of the rows ------------------------------------------------------------------------------------------------------


def rows(edit: Callable[[Recorded], Recorded]) -> Change:
    return lambda scene: scene.edits.append(edit)


def column(name: str, edit: OfRows) -> Change:
    """Of `time`, `values` `[row, channel]` (gyros first), `temperature`, `angles`, `stands` or `host`."""
    return rows(lambda r: replace(r, **{name: edit(r)}))


def values(edit: Callable[[Floats], Floats]) -> Change:
    return column("values", lambda r: edit(r.values))


def temperature(edit: Callable[[Floats], Floats]) -> Change:
    return column("temperature", lambda r: edit(r.temperature))


def angles(edit: Callable[[Floats], Floats]) -> Change:
    return column("angles", lambda r: edit(r.angles))


def factors(of_channel: dict[int, float]) -> Change:
    """Of some channels, by their numbers."""
    return values(lambda v: v * [of_channel.get(k, 1.0) for k in range(v.shape[1])])


def added(channel: int, more: OfRows) -> Change:
    def edit(r: Recorded) -> Floats:
        own = np.zeros_like(r.values)
        own[:, channel] = more(r)
        return r.values + own

    return column("values", edit)


def grown(channel: int, share: OfRows) -> Change:
    """More of a channel's own values."""
    return added(channel, lambda r: share(r) * r.values[:, channel])


def leaning(channel: int, towards: int) -> Change:
    """A misalignment that changes by 1 mrad over 40 K."""
    return added(channel, lambda r: 1e-3 * (r.temperature - 20.0) / 40.0 * r.values[:, towards])


def later(r: Recorded, second: float = 1200.0) -> Floats:
    """One from a time on, zero before."""
    return (r.time > second).astype(float)


def course(r: Recorded) -> Floats:
    """From zero to one in the run."""
    return (r.time - r.time[0]) / (r.time[-1] - r.time[0])


def kept(which: OfRows) -> Change:
    """The other rows are lost."""
    return rows(lambda r: r.rows(which(r)))


def after_ramps(r: Recorded, count: int) -> Floats:
    """Whether a row is not one of `count` from 0.4 s after each move begins, as of a buffer that overflows."""
    begins = np.flatnonzero((r.stands[1:] < 0) & (r.stands[:-1] >= 0)) + 20
    left = np.ones(len(r.time), bool)
    left[(begins[:, None] + np.arange(count)).ravel()] = False
    return left


def repeated(r: Recorded) -> Floats:
    """The last sample is repeated for 0.1 s on each ramp."""
    left = after_ramps(r, 5)
    return r.values[np.maximum.accumulate(np.where(left, np.arange(len(left)), 0))]


def counted(r: Recorded) -> Recorded:
    """Two hundred rows are lost, and the stamps count those that are left."""
    left = np.ones(len(r.time), bool)
    left[np.random.default_rng(3).integers(0, len(left), 200)] = False
    return replace(r.rows(left), time=r.time[: int(left.sum())])


def stale(r: Recorded) -> Floats:
    """Ten seconds of samples are those of the ten seconds before."""
    again = r.values.copy()
    again[60000:60500] = again[59500:60000]
    return again


def marked(before: int, after: int) -> Change:
    """Standstills that are marked so many rows before they begin and after they end."""

    def edit(r: Recorded) -> Floats:
        stands = r.stands.copy()
        edges = np.flatnonzero(np.diff(np.sign(r.stands + 1))) + 1
        for k in edges:
            if r.stands[k] >= 0:
                stands[max(0, k - before) : k] = r.stands[k]
            else:
                stands[k : k + after] = r.stands[k - 1]
        return stands

    return column("stands", edit)


def one_late(r: Recorded) -> Floats:
    """Each standstill has the angle of the one before."""
    late, number = r.angles.copy(), np.unique(r.stands[r.stands >= 0])
    means = [r.angles[r.stands == k].mean(axis=0) for k in number]
    for k, before in zip(number[1:], means, strict=False):
        late[r.stands == k] = before
    return late


def rotated(v: Floats, angle: float) -> Floats:
    """The whole body, about z."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.column_stack([v[:, :3] @ turn.T, v[:, 3:] @ turn.T])


def slipped_in_its_bracket(r: Recorded) -> Floats:
    return np.where(later(r)[:, None] > 0.0, rotated(r.values, -2e-3), r.values)


def flexing(v: Floats) -> Floats:
    """The body leans by 0.3 mrad for each g across its z axis."""
    rates, force = v[:, :3], v[:, 3:]
    lean = 0.3e-3 / G * np.stack([force[:, 1], -force[:, 0], 0.0 * force[:, 0]], axis=1)
    return v - np.concatenate([np.cross(lean, rates), np.cross(lean, force)], axis=1)


def tilting(r: Recorded) -> Floats:
    """The base tilts by 0.3 mrad about the outer axis, slowly."""
    tilt, spin = r.angles.T
    y = -0.3e-3 * G * (r.time - r.time[0]) / r.time[-1]
    more = [np.sin(spin) * np.cos(tilt) * y, np.cos(spin) * np.cos(tilt) * y, -np.sin(tilt) * y]
    return r.values + np.stack([*([0.0 * y] * 3), *more], axis=1)


def behind(seconds: float) -> Change:
    """The thermometer follows the die."""

    def edit(r: Recorded) -> Floats:
        own, share = r.temperature.copy(), (r.time[1] - r.time[0]) / seconds
        for k in range(1, len(own)):
            own[k] = own[k - 1] + share * (r.temperature[k] - own[k - 1])
        return own

    return column("temperature", edit)


def one_sided(v: Floats) -> Floats:
    limit = (150.0 if v.shape[1] == 1 else 250.0) * DEG
    return np.minimum(v, [limit, *[np.inf] * (v.shape[1] - 1)])


def dead_band(v: Floats) -> Floats:
    return np.where((np.arange(v.shape[1]) == 0) & (np.abs(v) < 0.02 * DEG), 0.0, v)


def telegraph(r: Recorded) -> Floats:
    """A bias that jumps by 40 deg/h to and fro, once a minute on average."""
    odd = np.cumsum(np.random.default_rng(5).random(len(r.time)) < (r.time[1] - r.time[0]) / 60.0) % 2
    return 40 * DEG_H * (odd - 0.5)


def quartz(r: Recorded) -> Floats:
    """The sensor's clock has a crystal cut for watches, slow by 0.035 ppm/K² away from 25 °C."""
    error = -0.035 * PPM * (r.temperature - 25.0) ** 2
    return r.time + np.cumsum(error * np.diff(r.time, prepend=r.time[0]))


def with_host(edit: OfRows) -> Change:
    """A change of the computer's stamps, where the log has them."""
    return also(chain(host=2e-4), column("host", edit))
