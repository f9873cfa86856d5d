"""A unit held and turned by hand, calibrated by gravity alone: against a twin of rotations.

The twin draws positions and turns of its own, and writes what each sensor says from the file's coefficients.
"""

from dataclasses import replace

import numpy as np
import pytest
from imu_twin import OMEGA, said_by
from scipy import stats
from scipy.spatial.transform import Rotation

from gradcal_jax.calibration.correction import apply
from gradcal_jax.estimation.hand_estimate import HandReport, estimate_by_hand
from gradcal_jax.records.log import Log, LogError

G = 9.81
LATITUDE = np.radians(45.0)
EARTH = OMEGA * np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)])
AT = {"temperature_c": 23.0}
HZ = 50.0
WHITE = {"gyro": 0.15 / 60.0 * np.pi / 180.0, "accelerometer": 0.05 / 60.0}  # rad/√s, m/s/√s


def drawn(rng: np.random.Generator) -> dict[str, float]:
    """Errors of a unit in the accelerometers' frame, by the names of the file's coefficients (SI)."""
    sizes = {}
    for j, a in enumerate("xyz"):
        sizes |= {f"gyro_{a}.a": 0.01, f"gyro_{a}.b00": 0.01} | {f"gyro_{a}.m_{b}": 0.01 for b in "xyz" if b != a}
        sizes |= {f"gyro_{a}.g_{b}": 1e-5 for b in "xyz"}
        sizes |= {f"accelerometer_{a}.a": 0.1, f"accelerometer_{a}.s": 0.01}
        sizes |= {f"accelerometer_{a}.m_{b}": 0.01 for b in "xyz"[:j]}
    return {name: size * rng.standard_normal() for name, size in sizes.items()}


def path(x, attitude, change, swing, amount) -> Rotation:
    """Attitudes at shares of a move's duration: a turn that begins and ends smoothly, and a swing there and back."""
    smooth = x - np.sin(2.0 * np.pi * x) / (2.0 * np.pi)
    there_and_back = amount * np.sin(np.pi * np.clip(x, 0.0, 1.0)) ** 4
    return (
        attitude
        * Rotation.from_rotvec(smooth[:, None] * change)
        * Rotation.from_rotvec(there_and_back[:, None] * swing)
    )


def held(
    truth: dict[str, float], rng: np.random.Generator, *, count: int = 30, rest: float = 6.0, first: float = 30.0,
    only=None, noisy: bool = True, earth=EARTH,
) -> Log:  # fmt: skip
    """A recording: `count` standstills in directions all round (or that `only` gives), each reached by two turns at
    once that begin and end smoothly; the hand's shaking goes to the forces.
    """
    attitude, rates, forces, standing = Rotation.identity(), [], [], []
    sub = 4
    dt = 1.0 / HZ / sub
    for k in range(count):
        for moving in (True, False) if k else (False,):
            if moving:
                lasting = rng.uniform(1.5, 3.0)
                to = Rotation.from_quat(rng.standard_normal(4), scalar_first=True) if only is None else only(k, rng)
                # On the way the hand also swings about another axis, there and back.
                swing, amount = rng.standard_normal(3), rng.uniform(0.2, 0.8)
                swing /= np.linalg.norm(swing)
            else:
                lasting = first if k == 0 else rest
            rows = round(lasting * HZ)
            t = (np.arange(rows * sub) + 0.5) * dt
            if moving:
                x, h = t / (rows / HZ), 1e-4
                move = attitude, (attitude.inv() * to).as_rotvec(), swing, amount
                q = path(x, *move)
                # Rates by differences over the path itself.
                step = h / (rows / HZ)
                omega = (path(x - step, *move).inv() * path(x + step, *move)).as_rotvec() / (2.0 * h)
                force = q.apply([0.0, 0.0, G], inverse=True)
                force = force + 0.3 * G * np.sin(np.pi * x)[:, None] * rng.standard_normal(3)
                attitude = to
            else:
                q, omega = attitude, np.zeros((len(t), 3))
                force = np.tile(q.apply([0.0, 0.0, G], inverse=True), (len(t), 1))
            omega = omega + q.apply(earth, inverse=True)
            rates.append(omega.reshape(rows, sub, 3).mean(axis=1))
            forces.append(force.reshape(rows, sub, 3).mean(axis=1))
            # A hand that sets down still touches for a moment: the first and the last tenth of a second do not count.
            own = np.full(rows, -1 if moving else k)
            own[:5], own[-5:] = -1, -1
            standing.append(own)
    omega, force = np.concatenate(rates), np.concatenate(forces)
    rate, felt = (said_by(truth, kind, of, force, 0.0) for kind, of in (("gyro", omega), ("accelerometer", force)))
    # A record without any noise would count as frozen.
    for of, white in ((rate, WHITE["gyro"]), (felt, WHITE["accelerometer"])):
        of += (1.0 if noisy else 1e-8) * white * np.sqrt(HZ) * rng.standard_normal(of.shape)
    return Log(
        np.arange(len(rate)) / HZ, rate[None], ("SN 7",), tuple("xyz"), standstill=np.concatenate(standing),
        specific_force_m_per_s2=felt[None], force_axes=tuple("xyz"), simulated=True,
    )  # fmt: skip


def values_of(report: HandReport) -> dict[str, float]:
    return {
        f"{c.name}.{name}": value
        for c in report.calibration.channel
        for term in c.term
        for name, value in term.coefficients.items()
    }


def squared(report: HandReport, truth: dict[str, float], only: str = "", earth=EARTH) -> tuple[float, int]:
    """Error of the coefficients (of one kind), normalised by their covariance, and how many they are. The Earth's
    vertical rate is part of what gyros show of gravity."""
    found, known = values_of(report), report.calibration.covariance
    truth = truth | {f"gyro_{a}.g_{a}": truth[f"gyro_{a}.g_{a}"] + earth[2] / G for a in "xyz"}
    at = [k for k, name in enumerate(known.names) if name.startswith(only)]
    error = np.array([found[known.names[k]] - truth[known.names[k]] for k in at])
    return float(error @ np.linalg.solve(np.array(known.matrix)[np.ix_(at, at)], error)), len(at)


@pytest.fixture(scope="module")
def sound() -> tuple[dict[str, float], Log, HandReport]:
    rng = np.random.default_rng(5)
    truth = drawn(rng)
    log = held(truth, rng)
    (report,) = estimate_by_hand(log, G, **AT)
    return truth, log, report


def test_a_simulated_unit_is_found_within_its_covariance(sound):
    truth, log, report = sound
    assert report.calibration.simulated
    assert set(values_of(report)) == set(truth)
    square, size = squared(report, truth)
    assert size == 30
    assert stats.chi2.sf(square, size) > 1e-3
    # The gyros find how fast the Earth turns in the horizontal, at 45° as fast as in the vertical.
    assert abs(np.linalg.norm(report.solution.parameters[30:]) / np.linalg.norm(EARTH[:2]) - 1.0) < 0.25
    assert all(test.probability > 1e-4 for test in report.solution.tests.values())
    # Three g of hand-made error become a tenth of a milligram and less.
    assert report.gravity_left < 1e-4 * G
    rests = log.standstill >= 0
    force = apply(report.calibration, log).log.specific_force_m_per_s2[0][rests]
    assert abs(np.linalg.norm(force, axis=1).mean() / G - 1.0) < 1e-4
    assert not any("bridged" in words or "neighbours" in words for words in report.messages)


def test_without_noise_the_estimate_is_the_truth():
    """What is left is the twin's integration and the Earth's rate that is not there."""
    rng = np.random.default_rng(1)
    truth = drawn(rng)
    log = held(truth, rng, noisy=False, earth=np.zeros(3))
    (report,) = estimate_by_hand(log, G, **AT)
    found = values_of(report)
    for name, value in truth.items():
        allowed = 2e-5 if name.startswith("gyro") else 1e-9
        assert abs(found[name] - value) < allowed, (name, found[name], value)


def about_x(k: int, rng: np.random.Generator) -> Rotation:
    """Positions in one plane: rolled about x alone."""
    return Rotation.from_rotvec([rng.uniform(-3.0, 3.0), 0.0, 0.0])


def faces(k: int, rng: np.random.Generator) -> Rotation:
    """Six faces up, again and again."""
    turns = [(0, 0, 0), (90, 0, 0), (180, 0, 0), (270, 0, 0), (0, 90, 0), (0, 270, 0)]
    return Rotation.from_rotvec(turns[k % 6], degrees=True)


def test_positions_in_one_plane_are_said_to_be():
    rng = np.random.default_rng(3)
    ideal = dict.fromkeys(drawn(rng), 0.0)
    (report,) = estimate_by_hand(held(ideal, rng, only=about_x), G, **AT)
    said = " ".join(report.messages)
    assert "axis x was never held within 60° of up" in said
    unseen = report.calibration.unobservable
    assert {"accelerometer_x.s", "accelerometer_x.a"} <= set(unseen) | {"accelerometer_x.a"}
    assert "accelerometer_x.s" in unseen
    assert "accelerometer_z.s" not in unseen
    assert not report.as_wished


def test_six_faces_tell_no_angle_between_the_accelerometers():
    """Norms of gravity along ± x, y, z see six of nine coefficients (`imu.md`: rank 6 of 9)."""
    rng = np.random.default_rng(4)
    ideal = dict.fromkeys(drawn(rng), 0.0)
    (report,) = estimate_by_hand(held(ideal, rng, only=faces), G, **AT)
    angles = {"accelerometer_y.m_x", "accelerometer_z.m_x", "accelerometer_z.m_y"}
    assert {name for name in report.calibration.unobservable if name.startswith("acc")} == angles


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda log: replace(log, specific_force_m_per_s2=None, force_axes=()), "no accelerometer x, accelerometer y"),
        (lambda log: replace(log, standstill=np.minimum(log.standstill, 3)), "standstills of a second"),
        (lambda log: replace(log, rate_rad_per_s=-log.rate_rad_per_s), "do both triads have the same axes"),
        (
            lambda log: replace(log, rate_rad_per_s=np.degrees(log.rate_rad_per_s)),
            "the scale and the zero of the rates",
        ),
        (
            lambda log: replace(log, specific_force_m_per_s2=log.specific_force_m_per_s2 / G),
            "at rest the accelerometers",
        ),
    ],
)
def test_what_cannot_be_is_a_sentence(change, words):
    rng = np.random.default_rng(8)
    log = change(held(drawn(rng), rng))
    with pytest.raises(LogError, match=words):
        estimate_by_hand(log, G, **AT)


@pytest.mark.evidence
@pytest.mark.parametrize("earth", [True, False])
def test_a_hundred_and_twenty_units_err_as_their_covariance_says(earth):
    """NEES of all coefficients, and of either triad's, in its 99 % band, and χ² of each kind of rows."""
    units, sums, sizes = 120, {"": 0.0, "gyro": 0.0, "accelerometer": 0.0}, {"": 0, "gyro": 0, "accelerometer": 0}
    chi, degrees = np.zeros(3), np.zeros(3)
    for seed in range(units):
        rng = np.random.default_rng(4000 + seed)
        truth = drawn(rng)
        log = held(truth, rng, earth=EARTH if earth else np.zeros(3))
        (report,) = estimate_by_hand(log, G, **AT)
        for kind in sums:
            square, size = squared(report, truth, kind, EARTH if earth else np.zeros(3))
            sums[kind] += square
            sizes[kind] += size
        for k, test in enumerate(report.solution.tests.values()):
            chi[k] += test.statistic
            degrees[k] += test.degrees
    ratio = {kind or "all": sums[kind] / sizes[kind] for kind in sums}
    print("earth", earth, "NEES over its degrees", ratio, "χ² over degrees", chi / degrees)
    for kind in sums:
        low, high = stats.chi2.ppf([0.005, 0.995], sizes[kind])
        assert low < sums[kind] < high, (kind, sums[kind] / sizes[kind])
    for k in range(3):
        low, high = stats.chi2.ppf([0.005, 0.995], degrees[k])
        assert low < chi[k] < high, chi / degrees


def test_turns_that_contradict_the_model_enlarge_the_covariance_and_are_said():
    """Gains that wander by 3 % with the time, and biases by 40 deg/h: no constant scale factor turns gravity as the
    accelerometers see it. A first pass then explains the turns by a rate of the Earth that no prior allows."""
    rng = np.random.default_rng(1)
    truth = drawn(rng)
    log = held(truth, rng, first=4.0, rest=4.0)
    wandering = 1.0 + 0.03 * np.sin(log.time_s / 7.0)
    drift = np.repeat(2e-4 * rng.standard_normal((len(wandering) // 200 + 1, 3)), 200, axis=0)[: len(wandering)]
    log = replace(log, rate_rad_per_s=log.rate_rad_per_s * wandering[None, :, None] + drift[None])
    (report,) = estimate_by_hand(log, G, **AT)
    assert not report.solution.tests["gyros: turns of gravity"].passed
    assert report.solution.factors[1] > 10.0
    assert any("gravity's direction after a turn" in message for message in report.messages)
    square, size = squared(report, truth, "gyro")
    assert square < stats.chi2.isf(1e-3, size)


# --- records with spikes and rows of zeros ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["spikes", "zeros"])
def test_rare_wrong_rows_are_left_out(sound, kind: str):
    truth, log, _ = sound
    rng = np.random.default_rng(3)
    rate, force = log.rate_rad_per_s.copy(), log.specific_force_m_per_s2.copy()
    rows = rng.choice(len(log.time_s) - 20, 40, replace=False) + 10
    if kind == "spikes":
        rate[0, rows, 1] += 5.0
        force[0, rows[:20], 2] -= 40.0
    else:
        rate[0, rows], force[0, rows] = 0.0, 0.0
    (report,) = estimate_by_hand(
        replace(log, rate_rad_per_s=rate, specific_force_m_per_s2=force, standstill=None), G, **AT
    )
    (alone,) = estimate_by_hand(replace(log, standstill=None), G, **AT)
    assert len(alone.solution.positions.duration) == 30
    assert any("30 were detected" in message for message in alone.messages)
    assert report.solution.turns >= 0.6 * alone.solution.turns
    assert any("differ from their neighbours by more than" in words for words in report.messages)
    assert any("gaps of one or two rows are bridged" in words for words in report.messages)
    distance, count = squared(report, truth)
    assert distance < 2.0 * count
