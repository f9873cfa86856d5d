"""Sentences on what a unit's plan cannot observe, and on changes that would help."""

import re

import numpy as np

from gradcal_jax.information import Posterior, posterior, square_root, unobservable_combinations
from gradcal_jax.information.imu_residual import UNITS_OF_TERMS, quantity_of
from gradcal_jax.model import AXIS_NAMES, Channel, Discrepancy, Hysteresis, Map, PathTerm, RotationSensitivity
from gradcal_jax.model.imu_build import (
    HYSTERESIS,
    SCALE_FACTOR_HYSTERESIS,
    BuiltImu,
    build_imu,
    imu_posterior,
    rest_poses,
)
from gradcal_jax.motion import Trajectory, frames
from gradcal_jax.spec.absent import absent_terms, minutes_of_change
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.requirement import GyroScaleFactorRequirement, MissionHeadingRequirement
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.units import G

# A parameter counts as not observed where its standard deviation is more than this share of its prior's.
NOT_OBSERVED = 0.9
# Points a side of the grid on which a residual is compared with that of the priors.
_FEW = 11
# Cosine of the angle between directions that count as opposite.
_ALONG = 0.9
# Share of a turn's rate that a gyro must see.
_SEEN = 0.3
# Share of the prior of a hysteresis beyond which a course hardly observes it.
_HARDLY_SEEN = 0.7
# Number of unobservable combinations that are named each; more are lists of parameters.
_FEW_COMBINATIONS = 4
# Relative difference of rates that rounding to a controller's steps explains.
_NEARLY = 1e-3
# Points of a piece at which its largest rate is evaluated.
_PLACES = 33
# Change of temperature within a piece that counts as none, K.
_SAME_K = 1e-6
# Cosine to the vertical beyond which gravity does not see an axis's turns, and the tilt that is offered.
_UPRIGHT, _TILT_DEG = 0.995, 30.0
# Smallest over largest singular value of up-directions that do not lie in one plane.
_FLAT = 0.05


def unobserved_parameters(built: BuiltImu, known: Posterior, prior: Posterior | None = None) -> list[str]:
    """Names of the unit's own parameters that a plan, or data, do not observe, those of hidden structure and of the
    state at the beginning left out."""
    hidden = {
        f"{c.name}.{name}"
        for c in built.model.channels
        for t in c.model.terms
        if isinstance(t, Discrepancy | PathTerm | RotationSensitivity)
        for name in (t.nuisances if isinstance(t, PathTerm) else t.names())
    }
    own = slice(built.model.calibrated)
    after, before = known.deviations(built.model.to_reported[own]), prior_deviations(built, prior)[own]
    observed = np.isfinite(after) & ((after <= NOT_OBSERVED * before) | ~np.isfinite(before))
    return [name for name, seen in zip(built.model.names(), observed, strict=False) if not seen and name not in hidden]


def prior_deviations(built: BuiltImu, prior: Posterior | None = None) -> np.ndarray:
    """Prior standard deviation of every reported parameter; `inf` where flat. `prior`: what is known before any
    reading, if at hand."""
    return (prior or _prior(built)).deviations(built.model.to_reported)


def _prior(built: BuiltImu) -> Posterior:
    """What is known before any reading."""
    return posterior(square_root(built.model.prior_rows()))


def _combinations(built: BuiltImu, known: Posterior) -> list[str]:
    few = len(built.model.channels) == 1 or known.hidden.shape[1] <= _FEW_COMBINATIONS
    return unobservable_combinations(known, built.model) if few else []


def _of_combinations(built: BuiltImu, combinations: list[str], axes: np.ndarray) -> list[str]:
    if not combinations:
        return []
    blind = {name for name in built.model.names() if any(name in combination for combination in combinations)}
    cures = "; ".join(_cures(built, axes, blind)) or "change the plan"
    if len(built.model.channels) == 1:
        alone = f"{built.model.channels[0].name}."
        combinations = [combination.replace(alone, "") for combination in combinations]
    return [f"the plan cannot observe {combination}: {cures}; or state a prior" for combination in combinations]


def _axes_of(built: BuiltImu) -> np.ndarray:
    """The table's axes in the body as each piece begins, `(P, L, 3)`."""
    motion, example = built.motion, built.motion.example
    return frames(motion.geometry, motion.angles()[0][example], motion.mounting[example]).axes[motion.kind]


def plan_warnings(built: BuiltImu, known: Posterior) -> list[str]:
    """A sentence for each thing that the plan cannot observe, remedies first; and for requirements beyond the plan's
    temperatures and rates."""
    axes, combinations, prior = _axes_of(built), _combinations(built, known), _prior(built)
    every = [name for name in unobserved_parameters(built, known, prior) if not any(name in c for c in combinations)]
    of_path = one_way_sentences(built, known)
    # A hysteresis that is not observed has its own sentence.
    names = [name for name in every if not of_path or HYSTERESIS.partition("{")[0] not in name]
    sentences = _of_combinations(built, combinations, axes) + _cures(built, axes, set(names))
    if any(".m_" in name for name in names) or _orthogonality_is_hidden(built, known):
        sentences += _reversals(built, axes)
    groups: dict[str, list[str]] = {}
    for name in names:
        channel, _, symbol = name.partition(".")
        groups.setdefault(channel, []).append(symbol)
    sentences += [f"not observable: {channel}: {', '.join(symbols)}" for channel, symbols in groups.items()]
    sentences += of_path or _one_way_of_class(built)
    sentences += _unseen_by_gravity(built)
    sentences += _limited_by_priors(built, known, prior) + _as_before(built, known, prior)
    fastest = _fastest(built, axes)
    sentences += _saturated(built, fastest) + _beyond(built) + _beyond_rates(built, fastest)
    return sentences + _of_this_run(built) + _both_ways(built)


def check(spec: Spec) -> list[str]:
    """Warnings on a spec's prediction, in sentences: parameter combinations that the plan cannot observe, and
    requirements beyond the temperatures (°C) and rates (deg/s) that the plan visits.

    Errors: none; `read_spec` has validated the spec.
    """
    built = build_imu(expect_spec(spec))
    return plan_warnings(built, imu_posterior(built))


def one_way_sentences(built: BuiltImu, known: Posterior, line: Trajectory | None = None) -> list[str]:
    """What a plan that does not return leaves of every hysteresis, and the shortest return that observes it. `line`: of
    an executed motion in the place of the plan's."""
    model = built.model
    if not any(isinstance(term, Hysteresis) for c in model.channels for term in c.model.terms):
        return []
    prior = _prior(built)
    left: dict[tuple[str, str, str], tuple[float, float, list[str]]] = {}
    for c in model.channels:
        for head, kind in ((HYSTERESIS, "bias"), (SCALE_FACTOR_HYSTERESIS, "scale factor")):
            plays = [
                term
                for term in c.model.terms
                if isinstance(term, Hysteresis) and term.name.startswith(head.partition("{")[0])
            ]
            if not plays:
                continue
            row = np.zeros((1, model.size))
            for term in plays:
                row[0, model.where(c.kind, c.axis, term.name).start] = float(term.width)
            after, before = (float(of.deviations(row)[0]) for of in (known, prior))
            if after > _HARDLY_SEEN * before:
                si = model.units()[model.where(c.kind, c.axis, plays[0].name).start].removesuffix("/K")
                unit, factor = UNITS_OF_TERMS[si]
                wide = max(float(term.width) for term in plays)
                size, most, axes = left.get((c.kind, kind, unit), (0.0, 0.0, []))
                axes = [*axes, AXIS_NAMES[c.axis]]
                left[c.kind, kind, unit] = max(size, after * factor), max(most, wide), axes
    course, spec = _course_in_words(line or built.motion.line), built.spec
    return [
        f"{course}: hysteresis is not observable; ±{size:.3g} {unit} of hysteresis remain in the {kind} of {of} "
        f"{', '.join(axes)}: change the temperature back by {2.0 * wide:g} K or "
        f"more{minutes_of_change(spec, 2.0 * wide)}"
        for (of, kind, unit), (size, wide, axes) in left.items()
    ]


def _course_in_words(line: Trajectory) -> str:
    """Why the branches of the temperature are not told apart."""
    begin, end = (of[~line.gap] for of in line.ends())
    ways = {1.0 if b > a else -1.0 for a, b in zip(begin, end, strict=True) if abs(b - a) > _SAME_K}
    return {0: "constant temperature", 1: "one-way ramp"}.get(len(ways), "legs too short")


def _one_way_of_class(built: BuiltImu) -> list[str]:
    """The same for a hysteresis that the spec does not name and that a requirement's branch counts."""
    path = [term for term in absent_terms(built.spec) if term.key.endswith("hysteresis")]
    if not path:
        return []
    complete = build_imu(changed(built.spec, {term.key: term.value for term in path}))
    sentences = one_way_sentences(complete, imu_posterior(complete))
    return [f"{sentence}; the figure is typical of the class" for sentence in sentences]


# Name of an installation's parameter, unit of its prior, and a remedy other than a plan.
_HANG = "use several mountings, or refer misalignments to the table's axes"
_FREEDOMS = {
    "sample_clock": ("the sample clock", "ppm", 1e6, "compare the clock with a better clock"),
    "gravity": ("gravity", "ug", 1e6 / G, "measure gravity at the site"),
    "azimuth": ("the azimuth of the base", "mrad", 1e3, "survey the azimuth"),
    "tilt_east": ("the tilt of the base", "urad", 1e6, "level it"),
    "tilt_north": ("the tilt of the base", "urad", 1e6, "level it"),
    "mounting": ("the mounting", "urad", 1e6, _HANG),
}
_FAMILIES = {
    ("gyro", "a"): "bias",
    ("gyro", "b"): "scale factor",
    ("gyro", "m"): "misalignment",
    ("gyro", "g"): "acceleration sensitivity",
    ("accelerometer", "a"): "bias",
    ("accelerometer", "s"): "scale factor",
    ("accelerometer", "m"): "misalignment",
    ("accelerometer", "k"): "second order",
}


def _limited_by_priors(built: BuiltImu, known: Posterior, prior: Posterior) -> list[str]:
    """Errors of the installation that the plan does not observe and that dominate the error of a parameter of the unit:
    any plan, or this one, cannot separate the two (a gauge freedom of the measurement)."""
    model, names = built.model, built.model.names()
    own = model.to_reported[: model.calibrated]
    spread = own @ known.spread
    size = np.sqrt(np.sum(spread**2, axis=1))
    reasons: dict[tuple[str, str, float, float, str], list[str]] = {}
    priors = prior_deviations(built, prior)
    for i in range(model.calibrated, model.size):
        freedom = _FREEDOMS.get("mounting" if names[i].startswith("mounting") else names[i])
        std = np.sqrt(np.sum(known.spread[i] ** 2))
        if freedom is None or std < NOT_OBSERVED * priors[i] or not std:
            continue
        share = np.abs(spread @ known.spread[i]) / np.where(size > 0.0, size * std, 1.0)
        for name in (names[j] for j in np.flatnonzero(share > NOT_OBSERVED)):
            channel, _, symbol = name.partition(".")
            kind = channel.partition("_")[0]
            family = _FAMILIES.get((kind, symbol[0]))
            if family is not None:
                words, unit, factor, cure = freedom
                limited = reasons.setdefault((words, unit, factor, float(priors[i]), cure), [])
                limited.append(f"the {kind}s' {family}")
    return [
        f"the plan does not reduce the uncertainty of {words} ({prior * factor:.3g} {unit}); however "
        f"long the plan is, this uncertainty alone limits {' and '.join(dict.fromkeys(limited))}: {cure}"
        for (words, unit, factor, prior, cure), limited in reasons.items()
    ]


def _as_before(built: BuiltImu, known: Posterior, before: Posterior) -> list[str]:
    """Sentences on requirements whose residual the plan hardly reduces."""
    sentences: list[str] = []
    for requirement in built.spec.requirement:
        quantity = quantity_of(built, requirement, _FEW)
        if (then := quantity.residual(before).statistic()) is None:
            continue
        now = quantity.residual(known).statistic()
        if now is not None and now > NOT_OBSERVED * then:
            sentences.append(
                f"requirement '{requirement.name}' depends only on the priors: the plan does not observe it"
            )
    return sentences


def _saturated(built: BuiltImu, fastest: np.ndarray) -> list[str]:
    """Sentences on gyros that a turn takes beyond their full scale less its margin, where their output is not valid."""
    gyro = built.spec.sensor.gyro
    if gyro is None or gyro.usable_rate is None:
        return []
    return [
        f"gyro {name} has rates up to {np.degrees(rate):.4g} deg/s, beyond its full scale minus the margin, "
        f"{np.degrees(gyro.usable_rate):.4g} deg/s: turn more slowly"
        for name, rate in zip(AXIS_NAMES, fastest, strict=True)
        if name in gyro.axes and rate > gyro.usable_rate * (1.0 + 1e-6)
    ]


def _fastest(built: BuiltImu, axes: np.ndarray) -> np.ndarray:
    """The fastest turn along each of the body's axes, rad/s."""
    motion = built.motion
    turned = np.bincount(motion.kind[(motion.axis >= 0) & ~motion.line.gap], minlength=len(motion.example))
    moves = motion.example[np.flatnonzero(turned)]
    places = np.broadcast_to(np.linspace(0.0, 1.0, _PLACES), (len(moves), _PLACES))
    fastest = np.max(np.abs(motion.line.rate(places, moves)), axis=1, initial=0.0)
    return np.max(np.abs(axes[moves, motion.axis[moves]]) * fastest[:, None], axis=0, initial=0.0)


def _beyond_rates(built: BuiltImu, fastest: np.ndarray) -> list[str]:
    """Sentences on requirements beyond the rates along their gyros."""
    sentences = list[str]()
    for r in built.spec.requirement:
        if not isinstance(r, GyroScaleFactorRequirement | MissionHeadingRequirement):
            continue
        widest = max(abs(float(rate)) for rate in r.rate)
        gyros = [c.axis for c in built.model.channels if c.kind == "gyro"]
        slow = [k for k in gyros if r.axis in ("all", "worst", AXIS_NAMES[k]) and widest > fastest[k] * (1.0 + _NEARLY)]
        if slow:
            least = np.degrees(min(fastest[k] for k in slow))
            about = "" if len(gyros) == 1 else f" about {', '.join(AXIS_NAMES[k] for k in slow)}"
            sentences.append(
                f"requirement '{r.name}' has rates up to {np.degrees(widest):.4g} deg/s, but the plan reaches "
                f"only {least:.4g} deg/s{about}: above {least:.4g} deg/s, the prediction relies on the form of the map "
                "in the spec, which this plan cannot test"
            )
    return sentences


def _of_this_run(built: BuiltImu) -> list[str]:
    """Sentences on turn-on biases, which a map of one run includes."""
    sentences: list[str] = []
    for kind, si in (("gyro", "rad/s"), ("accelerometer", "m/s^2")):
        triad = getattr(built.spec.sensor, kind)
        if triad is not None and triad.bias is not None and triad.turn_on_bias:
            unit, factor = UNITS_OF_TERMS[si]
            sentences.append(
                f"within one run the turn-on bias of the {kind}s cannot be separated from a0: the bias map is that of "
                f"this run, and the map of another run differs by {float(triad.turn_on_bias) * factor:.4g} {unit} "
                "(standard deviation)"
            )
    return sentences


def _both_ways(built: BuiltImu) -> list[str]:
    """Sentences on sensitivities to dT/dt that only count, in a plan that heats and cools: there they are no constant,
    which data contradict."""
    slopes = built.motion.line.slope[~built.motion.line.gap]
    if not (np.any(slopes > 0.0) and np.any(slopes < 0.0)):
        return []
    sentences: list[str] = []
    for kind in ("gyro", "accelerometer"):
        triad = getattr(built.spec.sensor, kind)
        if triad is not None and triad.gradient_sensitivity is None and triad.gradient_std:
            figure = triad.bias_temperature_gradient.text
            sentences.append(
                f"the plan heats and cools, so a bias of {figure} due to dT/dt is not constant: an estimate will "
                "report that the data contradict the model; to estimate the sensitivity, write "
                f"[sensor.{kind}] bias_temperature_gradient = "
                f'{{ prior = "{figure}" }}'
            )
    return sentences


def _beyond(built: BuiltImu) -> list[str]:
    line = built.motion.line
    begin, end = (e[~line.gap] for e in line.ends())
    low, high = float(min(begin.min(), end.min())), float(max(begin.max(), end.max()))
    beyond: dict[tuple[float, float], list[str]] = {}
    for r in built.spec.requirement:
        if r.temperature[0] < low - 1e-6 or r.temperature[1] > high + 1e-6:
            beyond.setdefault((float(r.temperature[0]), float(r.temperature[1])), []).append(f"'{r.name}'")
    return [
        (f"requirement {names[0]} asks" if len(names) == 1 else f"requirements {', '.join(names)} ask")
        + f" for {cold:g} … {warm:g} °C, but the sensor covers only {low:.4g} … {high:.4g} °C: outside this "
        "range, the prediction relies on the form of the maps in the spec, which this plan cannot test"
        for (cold, warm), names in beyond.items()
    ]


def _cures(built: BuiltImu, axes: np.ndarray, names: set[str]) -> list[str]:
    """Remedies for unobserved parameters that follow from the plan's poses and turns."""
    if not names:
        return []
    motion = built.motion
    moves = np.flatnonzero(motion.axis >= 0)
    up = rest_poses(built).up
    sentences: list[str] = []
    for c in built.model.channels:
        axis = AXIS_NAMES[c.axis]
        blind = {name for name in names if name.startswith(f"{c.name}.")}
        if c.kind == "accelerometer" and blind and len(up):
            for sign, where in ((1.0, "up"), (-1.0, "down")):
                if not np.any(sign * up[:, c.axis] > 0.5):
                    sentences.append(f"accelerometer {axis} never points {where}: add a pose")
        turned = np.any(np.abs(axes[moves, motion.axis[moves], c.axis]) > _SEEN)
        if c.kind == "gyro" and any(re.search(r"\.b[\d_]", name) for name in blind) and not turned:
            where = f"no turn is about gyro {axis}: add a turn while a table axis lies along this gyro"
            sentences.append("the axis never turns: add turns" if built.spec.is_one_axis else where)
        elif c.kind == "gyro" and blind:
            sentences += _too_few(built, axes, c)
    if any(".g_" in name for name in names) and len(up):
        spread = np.linalg.svd(np.column_stack([np.ones(len(up)), up]), compute_uv=False)
        if spread[-1] < _FLAT * spread[0]:
            sentences.append(
                "the directions that point up at rest are in one plane, so bias and acceleration sensitivity "
                "cannot be separated: use four directions that are not in one plane"
            )
    return sentences


def _too_few(built: BuiltImu, axes: np.ndarray, channel: Channel) -> list[str]:
    """What the plan has too few of for a gyro's maps: rates or temperatures, beside the number of coefficients."""
    maps = [term for term in channel.model.terms if isinstance(term, Map)]
    cures: list[str] = []
    scale = channel.model.scale
    if scale is not None and scale.rate is not None:
        rates, needed = _distinct_rates(built, axes, channel.axis), scale.rate.size
        if rates is not None and rates < needed:
            cures.append(
                f"{in_words(rates)} distinct {'rate' if rates == 1 else 'rates'} for {in_words(needed)} coefficients "
                f"in rate: add a turn at {'a second' if rates == 1 else 'another'} rate"
            )
    most = max(term.temperature.size for term in maps)
    line, schedule = built.motion.line, built.spec.schedule
    begin, end = (e[~line.gap] for e in line.ends())
    if max(begin.max(), end.max()) - min(begin.min(), end.min()) < 1.0:
        if most > 1:
            cures.append(f"one temperature for {in_words(most)} coefficients in temperature: use several temperatures")
    elif isinstance(schedule, StandardSchedule) and (visited := len(set(schedule.temperatures))) < most:
        cures.append(
            f"{in_words(visited)} temperatures for {in_words(most)} coefficients in temperature: add "
            f"{in_words(most - visited)} more"
        )
    return cures


def _distinct_rates(built: BuiltImu, axes: np.ndarray, axis: int) -> int | None:
    """The number of different constant rates along a body axis, counted with sign; None where a turn's rate varies
    throughout."""
    motion, line = built.motion, built.motion.line
    varying = np.isin(np.arange(line.piece_count), line.varying_pieces)
    turning = (motion.axis >= 0) & np.asarray(line.moving) & ~line.gap
    constant = np.flatnonzero(turning & ~varying)
    if np.setdiff1d(line.segment[turning], line.segment[constant]).size:
        return None
    along = line.end_rate()[constant] * axes[constant, motion.axis[constant], axis]
    return len(np.unique(np.round(np.degrees(along), 6)))


def _unseen_by_gravity(built: BuiltImu) -> list[str]:
    """Sentences on axes that are vertical in all of their turns, where gravity is the only reference of their angles;
    for the outermost one with what a tilt makes of the scale factor."""
    motion, table = built.motion, built.spec.rig.table
    if not table.by_gravity:
        return []
    moves = np.flatnonzero((motion.axis >= 0) & ~motion.line.gap)
    stages = frames(motion.geometry, motion.angles()[0][moves], motion.mounting[moves])
    sentences: list[str] = []
    for k, axis in enumerate(table.axis):
        own = np.flatnonzero(motion.axis[moves] == k)
        vertical = np.einsum("ni,ni->n", stages.axes[own, k], stages.attitude[own, 2])
        if not len(own) or np.min(np.abs(vertical)) < _UPRIGHT:
            continue
        cure = f'also turn "{axis.name}" while it is not vertical'
        if k == 0:
            cure = f'tilt the axis "{axis.name}" by {_TILT_DEG:g} deg{_when_tilted(built)}'
        sentences.append(
            f'gravity shows neither turns of "{axis.name}" (the axis is vertical in all of them) nor the azimuth: '
            f"without an encoder the scale factor of gyros along this axis is not observable: {cure}"
        )
    return sentences


def _when_tilted(built: BuiltImu) -> str:
    """The gyros' scale factor with the outermost axis tilted, after a colon."""
    spec, up = built.spec, built.spec.rig.table.axis[0].unit_vector
    wanted = next((r for r in spec.requirement if isinstance(r, GyroScaleFactorRequirement)), None)
    if wanted is None:
        return ""
    tilt = np.radians(_TILT_DEG)
    direction = [up[0], up[1] + np.tan(tilt) * abs(up[2]), up[2]]
    tilted = build_imu(changed(spec, {"rig.table.axis[0].direction": [float(round(x, 6)) for x in direction]}))
    quantity, known = quantity_of(tilted, wanted, _FEW), imu_posterior(tilted)
    now = quantity.residual(known).statistic()
    return "" if now is None else f": then the residual of '{wanted.name}' is {now:.3g} ppm"


def in_words(count: int) -> str:
    """A small number as a word, a larger one as it is."""
    words = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    return words[count] if count < len(words) else str(count)


def _orthogonality_is_hidden(built: BuiltImu, known: Posterior) -> bool:
    """Whether misalignments of gyros are estimated beside an angle between two axes that is not observed."""
    model, gyro = built.model, built.spec.sensor.gyro
    at = [i for i, name in enumerate(model.names()) if name.startswith("orthogonality_")]
    if gyro is None or gyro.misalignment is None or not at:
        return False
    after, before = known.deviations(model.to_reported[at]), prior_deviations(built)[at]
    return bool(np.any(after > NOT_OBSERVED * before))


def _reversals(built: BuiltImu, axes: np.ndarray) -> list[str]:
    """Sentences on outer axes without turns at opposite inner angles: there the misalignment towards the axis cannot be
    separated from the non-orthogonality of outer and inner axis."""
    motion, table = built.motion, built.spec.rig.table
    sentences: list[str] = []
    for k in range(len(table.axis) - 1):
        turning = np.unique(np.round(axes[motion.axis == k][:, k], 6), axis=0)
        if not len(turning):
            sentences.append(
                f'the axis "{table.axis[k].name}" never turns: misalignments towards it are not observable'
            )
        elif not np.any(turning @ turning.T < -_ALONG):
            inner = table.axis[k + 1].name
            sentences.append(
                f'no turn of "{table.axis[k].name}" is repeated with "{inner}" rotated by half a turn: '
                "misalignments cannot be separated from the non-orthogonality of the two axes; turn "
                f'"{inner}" by 180 deg and repeat the turns'
            )
    return sentences
