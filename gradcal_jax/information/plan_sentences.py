"""Sentences on what a unit's plan cannot observe, and on requirements beyond what it visits.

One rule: a parameter whose posterior standard deviation exceeds `NOT_OBSERVED` of its prior's is not observed. It is
named, with what a plan needs to observe it; one of the installation, with the unit's parameters that it limits.
"""

from collections.abc import Iterator

import numpy as np

from gradcal_jax.information import Posterior, posterior, square_root
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.information.residual import UNITS_OF_TERMS
from gradcal_jax.model import AXIS_NAMES, Channel, Discrepancy, Hysteresis, ImuModel, OwnTerm, Term
from gradcal_jax.model.build import ROTATION, BuiltImu, build_imu
from gradcal_jax.motion import frames
from gradcal_jax.spec.absent import minutes_of_change
from gradcal_jax.spec.requirement import GyroScaleFactorRequirement
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec

# A parameter counts as not observed where its standard deviation is more than this share of its prior's.
NOT_OBSERVED = 0.9
# Share of the prior of a hysteresis beyond which a course hardly observes it.
_HARDLY_SEEN = 0.7
# Relative difference of rates that rounding to a controller's steps explains.
_NEARLY = 1e-3
# Points of a piece at which its largest rate is evaluated.
_PLACES = 33
# Change of temperature within a piece that counts as none, K.
_SAME_K = 1e-6
# What a plan needs to observe a term, by kind of channel and the beginning of the term's name.
_REMEDIES = {
    ("gyro", "scale_factor"): "turn about the gyro, at more rates and temperatures",
    ("gyro", "bias"): "rest at more temperatures, and in four directions that are not in one plane",
    ("gyro", "misalignment"): "turn about the other axes, and again with the inner axis rotated by 180 deg",
    ("gyro", "g_sensitivity"): "rest in four directions that are not in one plane",
    ("accelerometer", ""): "rest with the axis up, down and horizontal, at more temperatures",
}
_BY_GRAVITY = " (gravity does not show turns about a vertical axis: turn while it is tilted)"


def plan_warnings(built: BuiltImu, known: Posterior) -> list[str]:
    """A sentence for each thing that the plan cannot observe, with a remedy; and for rates beyond the full scale, and
    requirements beyond the plan's temperatures and rates."""
    fastest = _fastest(built)
    return [
        *_unobserved_sentences(built, known),
        *_limited_by_priors(built.model, known),
        *one_way_sentences(built, known),
        *_saturated(built, fastest),
        *_beyond_the_plan(built, fastest),
    ]


def check(spec: Spec) -> list[str]:
    """Warnings on a spec's prediction, in sentences: parameters that the plan cannot observe, and
    requirements beyond the temperatures (°C) and rates (deg/s) that the plan visits.

    Errors: none; `read_spec` has validated the spec.
    """
    built = build_imu(expect_spec(spec))
    return plan_warnings(built, imu_posterior(built))


def prior_deviations(model: ImuModel, rows: np.ndarray | None = None) -> np.ndarray:
    """Prior standard deviation of every reported parameter, or of functions of the parameters; `inf` where flat."""
    return posterior(square_root(model.prior_rows())).deviations(model.to_reported if rows is None else rows)


def _stays(model: ImuModel, known: Posterior) -> np.ndarray:
    """Which of all parameters are not observed."""
    after, before = known.deviations(model.to_reported), prior_deviations(model)
    return ~np.isfinite(after) | ((after > NOT_OBSERVED * before) & np.isfinite(before))


def unobserved_parameters(model: ImuModel, known: Posterior) -> list[str]:
    """Names of the unit's own parameters that a plan, or data, do not observe, those of hidden structure, of the state
    at the beginning, and of a lever arm in rotation (no requirement needs them) left out."""
    return [name for _, _, name in _unobserved(model, known)]


def _unobserved(model: ImuModel, known: Posterior) -> Iterator[tuple[Channel, Term, str]]:
    stays = _stays(model, known)
    for _, c, term, at in model.located():
        nuisances = term.nuisances if isinstance(term, OwnTerm) else []
        left_out = isinstance(term, Discrepancy) or term.name.startswith(ROTATION)
        for name, same in zip(term.names(), stays[at], strict=True):
            if same and not left_out and name not in nuisances:
                yield c, term, f"{c.name}.{name}"


def _unobserved_sentences(built: BuiltImu, known: Posterior) -> list[str]:
    """Sentences on parameters that nothing observes, or that keep their priors, each with what a plan needs."""
    more, groups = _BY_GRAVITY if built.spec.rig.table.by_gravity else "", dict[str, list[str]]()
    for c, term, name in _unobserved(built.model, known):
        if not isinstance(term, Hysteresis):
            fits = [of for (kind, head), of in _REMEDIES.items() if kind == c.kind and term.name.startswith(head)]
            groups.setdefault([*fits, "change the plan"][0], []).append(name)
    return [f"the plan cannot observe {', '.join(names)}: {of}, or state a prior{more}" for of, names in groups.items()]


def _limited_by_priors(model: ImuModel, known: Posterior) -> list[str]:
    """Errors of the installation that the plan does not observe and that dominate the error of a parameter of the unit:
    any plan, or this one, cannot separate the two (a gauge freedom of the measurement)."""
    own, names, units, priors = model.calibrated, model.names(), model.units(), prior_deviations(model)
    spread = model.to_reported @ known.spread
    spread = spread / np.maximum(np.linalg.norm(spread, axis=1, keepdims=True), np.finfo(float).tiny)
    limits = _stays(model, known)[:, None] & (np.abs(spread @ spread[:own].T) > NOT_OBSERVED)
    groups: dict[tuple[str, float], list[int]] = {}
    for k in range(own, model.size):
        if np.any(limits[k]):
            groups.setdefault((units[k], float(priors[k])), []).append(k)
    sentences: list[str] = []
    for (si, prior), members in groups.items():
        common = [names[k] for k in members]
        limited = [names[j] for j in np.flatnonzero(np.any(limits[members], axis=0))]
        unit, factor = UNITS_OF_TERMS[si]
        turned = any(name.startswith("orthogonality_") for name in common)
        cure = "repeat the turns with the inner axis rotated by 180 deg, or " if turned else ""
        sentences.append(
            f"the plan does not reduce the uncertainty of {', '.join(common)} ({prior * factor:.3g} {unit}), which "
            f"alone limits {', '.join(limited)}, however long the plan is: {cure}measure it by other means"
        )
    return sentences


def one_way_sentences(built: BuiltImu, known: Posterior) -> list[str]:
    """What a temperature that does not return leaves of the hystereses, and the shortest return that observes them: one
    sentence, or none."""
    model, remain, back = built.model, dict[str, list[str]](), 0.0
    plays: dict[tuple[int, bool], dict[int, Hysteresis]] = {}
    for number, _, term, at in model.located():
        if isinstance(term, Hysteresis):
            plays.setdefault((number, bool(term.signals)), {})[at.start] = term
    for (number, of_scale), own in plays.items():
        row, widths = np.zeros((1, model.size)), [float(play.width) for play in own.values()]
        row[0, list(own)] = widths
        after, before = float(known.deviations(row)[0]), float(prior_deviations(model, row)[0])
        if after > _HARDLY_SEEN * before:
            c, first = model.channels[number], next(iter(own.values()))
            unit, factor = UNITS_OF_TERMS[first.unit.removesuffix("/K")]
            size = f"±{after * factor:.3g} {unit} in the {'scale factor' if of_scale else 'bias'} of"
            remain.setdefault(size, []).append(f"{c.kind} {AXIS_NAMES[c.axis]}")
            back = max(back, *(2.0 * width for width in widths))
    if not remain:
        return []
    sizes = "; ".join(f"{size} {', '.join(channels)}" for size, channels in remain.items())
    return [
        f"hysteresis is not observable: {sizes} remain; change the temperature back by {back:g} K or "
        f"more{minutes_of_change(built.spec, back)}"
    ]


def _fastest(built: BuiltImu) -> np.ndarray:
    """The fastest turn along each of the body's axes, rad/s."""
    motion = built.motion
    turned = np.bincount(motion.kind[(motion.axis >= 0) & ~motion.line.gap], minlength=len(motion.example))
    moves = motion.example[np.flatnonzero(turned)]
    axes = frames(motion.geometry, motion.angles()[0][moves], motion.mounting[moves]).axes
    places = np.broadcast_to(np.linspace(0.0, 1.0, _PLACES), (len(moves), _PLACES))
    fastest = np.max(np.abs(motion.line.rate(places, moves)), axis=1, initial=0.0)
    own = axes[np.arange(len(moves)), motion.axis[moves]]
    return np.max(np.abs(own) * fastest[:, None], axis=0, initial=0.0)


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


def _beyond_the_plan(built: BuiltImu, fastest: np.ndarray) -> list[str]:
    """Sentences on requirements beyond the temperatures of the plan, or beyond the rates along their gyros."""
    line, beyond = built.motion.line, dict[str, list[str]]()
    both = np.concatenate([ends[~line.gap] for ends in line.ends()])
    low, high = float(np.min(both)), float(np.max(both))
    gyros = [c.axis for c in built.model.channels if c.kind == "gyro"]
    for r in built.spec.requirement:
        cold, warm = map(float, r.temperature)
        if cold < low - _SAME_K or warm > high + _SAME_K:
            within = f"required for {cold:g} … {warm:g} °C, but the sensor covers only {low:.4g} … {high:.4g} °C"
            beyond.setdefault(within, []).append(f"'{r.name}'")
        if not isinstance(r, GyroScaleFactorRequirement):
            continue
        widest = max(abs(float(rate)) for rate in r.rate)
        slow = [k for k in gyros if r.axis in ("all", "worst", AXIS_NAMES[k]) and widest > fastest[k] * (1.0 + _NEARLY)]
        if slow:
            asked, reached = np.degrees(widest), np.degrees(min(fastest[slow]))
            within = f"required up to {asked:.4g} deg/s, but the plan reaches only {reached:.4g} deg/s"
            within += f" about {', '.join(AXIS_NAMES[k] for k in slow)}"
            beyond.setdefault(within, []).append(f"'{r.name}'")
    return [
        f"{', '.join(names)}: {within}: beyond, the prediction relies on the form of the maps in the spec, which this "
        "plan cannot test"
        for within, names in beyond.items()
    ]
