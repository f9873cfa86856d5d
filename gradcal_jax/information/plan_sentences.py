"""Sentences on what a unit's plan cannot observe, and on requirements beyond what it visits.

One rule: a parameter whose posterior standard deviation exceeds `NOT_OBSERVED` of its prior's is not observed. It is
named, with what a plan needs to observe it; one of the installation, with the unit's parameters that it limits.
"""

import numpy as np

from gradcal_jax.information import Posterior, posterior, square_root
from gradcal_jax.information.imu_residual import UNITS_OF_TERMS
from gradcal_jax.model import AXIS_NAMES, Discrepancy, Hysteresis, OwnTerm
from gradcal_jax.model.build import HYSTERESIS, SCALE_FACTOR_HYSTERESIS, BuiltImu, build_imu, imu_posterior
from gradcal_jax.motion import Trajectory, frames
from gradcal_jax.spec.absent import minutes_of_change
from gradcal_jax.spec.requirement import GyroScaleFactorRequirement, MissionHeadingRequirement
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
_POSES = "rest with the axis up, down and horizontal, at more temperatures"
# What a plan needs to observe a term, by kind of channel and the beginning of the term's name.
_REMEDIES = {
    ("gyro", "scale_factor"): "turn about the gyro, at more rates and temperatures",
    ("gyro", "bias"): "rest at more temperatures, and in four directions that are not in one plane",
    ("gyro", "misalignment"): "turn about the other axes, and again with the inner axis rotated by 180 deg",
    ("gyro", "g_sensitivity"): "rest in four directions that are not in one plane",
    ("accelerometer", ""): _POSES,
}
# Cosine to the vertical beyond which gravity does not see an axis's turns.
_UPRIGHT = 0.995


def plan_warnings(built: BuiltImu, known: Posterior) -> list[str]:
    """A sentence for each thing that the plan cannot observe, with a remedy; and for rates beyond the full scale, and
    requirements beyond the plan's temperatures and rates."""
    fastest = _fastest(built)
    return [
        *_unobserved(built, known),
        *_limited_by_priors(built, known),
        *one_way_sentences(built, known),
        *_unseen_by_gravity(built),
        *_saturated(built, fastest),
        *_beyond_temperatures(built),
        *_beyond_rates(built, fastest),
    ]


def check(spec: Spec) -> list[str]:
    """Warnings on a spec's prediction, in sentences: parameters that the plan cannot observe, and
    requirements beyond the temperatures (°C) and rates (deg/s) that the plan visits.

    Errors: none; `read_spec` has validated the spec.
    """
    built = build_imu(expect_spec(spec))
    return plan_warnings(built, imu_posterior(built))


def unobserved_parameters(built: BuiltImu, known: Posterior) -> list[str]:
    """Names of the unit's own parameters that a plan, or data, do not observe, those of hidden structure and of the
    state at the beginning left out."""
    hidden = {
        f"{c.name}.{name}"
        for c in built.model.channels
        for t in c.terms
        if isinstance(t, Discrepancy | OwnTerm)
        for name in (t.nuisances if isinstance(t, OwnTerm) else t.names())
    }
    stays = _stays(built, known)[: built.model.calibrated]
    return [name for name, same in zip(built.model.names(), stays, strict=False) if same and name not in hidden]


def prior_deviations(built: BuiltImu) -> np.ndarray:
    """Prior standard deviation of every reported parameter; `inf` where flat."""
    return posterior(square_root(built.model.prior_rows())).deviations(built.model.to_reported)


def _stays(built: BuiltImu, known: Posterior) -> np.ndarray:
    """Which of all parameters are not observed."""
    after, before = known.deviations(built.model.to_reported), prior_deviations(built)
    return ~np.isfinite(after) | ((after > NOT_OBSERVED * before) & np.isfinite(before))


def _unobserved(built: BuiltImu, known: Posterior) -> list[str]:
    """Sentences on parameters that nothing observes, or that keep their priors, each with what a plan needs."""
    groups: dict[str, list[str]] = {}
    unobserved = {name for name in unobserved_parameters(built, known) if "hysteresis_" not in name}
    for c in built.model.channels:
        for term in c.terms:
            fits = [of for (kind, head), of in _REMEDIES.items() if kind == c.kind and term.name.startswith(head)]
            names = [f"{c.name}.{name}" for name in term.names()]
            groups.setdefault(fits[0] if fits else "change the plan", []).extend(n for n in names if n in unobserved)
    return [
        f"the plan cannot observe {', '.join(names)}: {of}, or state a prior" for of, names in groups.items() if names
    ]


def _limited_by_priors(built: BuiltImu, known: Posterior) -> list[str]:
    """Errors of the installation that the plan does not observe and that dominate the error of a parameter of the unit:
    any plan, or this one, cannot separate the two (a gauge freedom of the measurement)."""
    model, names, priors = built.model, built.model.names(), prior_deviations(built)
    spread = model.to_reported[: model.calibrated] @ known.spread
    size = np.linalg.norm(spread, axis=1)
    groups: dict[tuple[str, float], tuple[list[str], dict[str, None]]] = {}
    for i in np.flatnonzero(_stays(built, known)):
        std = float(np.linalg.norm(known.spread[i]))
        if i < model.calibrated or not std:
            continue
        share = np.abs(spread @ known.spread[i]) / np.where(size > 0.0, size * std, 1.0)
        limited = [names[j] for j in np.flatnonzero(share > NOT_OBSERVED)]
        if limited:
            common, own = groups.setdefault((model.units()[i], float(priors[i])), ([], {}))
            common.append(names[i])
            own |= dict.fromkeys(limited)
    return [
        f"the plan does not reduce the uncertainty of {', '.join(common)} ({prior * UNITS_OF_TERMS[si][1]:.3g} "
        f"{UNITS_OF_TERMS[si][0]}), which alone limits {', '.join(own)}, however long the plan is: {_cure(common)}"
        for (si, prior), (common, own) in groups.items()
    ]


def _cure(names: list[str]) -> str:
    """What observes parameters of the installation."""
    if any(name.startswith("orthogonality_") for name in names):
        return "repeat the turns with the inner axis rotated by 180 deg, or measure it by other means"
    return "measure it by other means"


def _unseen_by_gravity(built: BuiltImu) -> list[str]:
    """Sentences on axes that are vertical in all of their turns, where gravity alone refers their angles."""
    motion, table = built.motion, built.spec.rig.table
    moves = np.flatnonzero((motion.axis >= 0) & ~motion.line.gap)
    if not table.by_gravity or not len(moves):
        return []
    stages = frames(motion.geometry, motion.angles()[0][moves], motion.mounting[moves])
    sentences: list[str] = []
    for k, axis in enumerate(table.axis):
        own = np.flatnonzero(motion.axis[moves] == k)
        vertical = np.abs(np.einsum("ni,ni->n", stages.axes[own, k], stages.attitude[own, 2]))
        if len(own) and np.min(vertical) >= _UPRIGHT:
            sentences.append(
                f'gravity does not show turns of "{axis.name}", which is vertical in all of them: turn it also while '
                "it is tilted"
            )
    return sentences


def one_way_sentences(built: BuiltImu, known: Posterior, line: Trajectory | None = None) -> list[str]:
    """What a plan that does not return leaves of every hysteresis, and the shortest return that observes it. `line`: of
    an executed motion in the place of the plan's."""
    model, before = built.model, posterior(square_root(built.model.prior_rows()))
    course = _course_in_words(line or built.motion.line)
    sentences: list[str] = []
    for c in model.channels:
        for head, words in ((HYSTERESIS, "bias"), (SCALE_FACTOR_HYSTERESIS, "scale factor")):
            head = head.partition("{")[0]
            plays = [t for t in c.terms if isinstance(t, Hysteresis) and t.name.startswith(head)]
            row = np.zeros((1, model.size))
            for play in plays:
                row[0, model.where(c.kind, c.axis, play.name).start] = float(play.width)
            after = float(known.deviations(row)[0])
            if not plays or after <= _HARDLY_SEEN * float(before.deviations(row)[0]):
                continue
            unit, factor = UNITS_OF_TERMS[plays[0].unit.removesuffix("/K")]
            back = 2.0 * max(float(play.width) for play in plays)
            sentences.append(
                f"{course}: hysteresis is not observable; ±{after * factor:.3g} {unit} of hysteresis remain in the "
                f"{words} of {c.kind} {AXIS_NAMES[c.axis]}: change the temperature back by {back:g} K or "
                f"more{minutes_of_change(built.spec, back)}"
            )
    return sentences


def _course_in_words(line: Trajectory) -> str:
    """Why the branches of the temperature are not told apart."""
    begin, end = (of[~line.gap] for of in line.ends())
    ways = {1.0 if b > a else -1.0 for a, b in zip(begin, end, strict=True) if abs(b - a) > _SAME_K}
    return {0: "constant temperature", 1: "one-way ramp"}.get(len(ways), "legs too short")


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


def _beyond_temperatures(built: BuiltImu) -> list[str]:
    """Sentences on requirements beyond the temperatures of the plan."""
    line = built.motion.line
    both = np.concatenate([ends[~line.gap] for ends in line.ends()])
    low, high = float(np.min(both)), float(np.max(both))
    beyond: dict[tuple[float, float], list[str]] = {}
    for r in built.spec.requirement:
        if r.temperature[0] < low - _SAME_K or r.temperature[1] > high + _SAME_K:
            beyond.setdefault((float(r.temperature[0]), float(r.temperature[1])), []).append(f"'{r.name}'")
    return [
        f"{', '.join(names)}: required for {cold:g} … {warm:g} °C, but the sensor covers only {low:.4g} … {high:.4g} "
        "°C: outside this range, the prediction relies on the form of the maps in the spec, which this plan cannot test"
        for (cold, warm), names in beyond.items()
    ]


def _beyond_rates(built: BuiltImu, fastest: np.ndarray) -> list[str]:
    """Sentences on requirements beyond the rates along their gyros."""
    sentences: list[str] = []
    gyros = [c.axis for c in built.model.channels if c.kind == "gyro"]
    for r in built.spec.requirement:
        if not isinstance(r, GyroScaleFactorRequirement | MissionHeadingRequirement):
            continue
        widest = max(abs(float(rate)) for rate in r.rate)
        slow = [k for k in gyros if r.axis in ("all", "worst", AXIS_NAMES[k]) and widest > fastest[k] * (1.0 + _NEARLY)]
        if slow:
            sentences.append(
                f"'{r.name}': required up to {np.degrees(widest):.4g} deg/s, but the plan reaches only "
                f"{np.degrees(min(fastest[slow])):.4g} deg/s about {', '.join(AXIS_NAMES[k] for k in slow)}: beyond, "
                "the prediction relies on the form of the map in the spec, which this plan cannot test"
            )
    return sentences
