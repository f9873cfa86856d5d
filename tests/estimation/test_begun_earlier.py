"""Of the margin at the begin of a run's standstills what the gyros do not need is rest."""

import numpy as np
import pytest
from scipy import signal

from gradcal_jax.estimation.standstill import begun_earlier
from gradcal_jax.records.table_angles import SETTLED_S

INTERVAL_S = 0.008
# Rows of the margin that a log has.
MARGIN = int(SETTLED_S / INTERVAL_S)
NOISE = 3e-4


def record(moves: int, *, filtered_hz: float = 0.0, slow_every: int = 0, noise: float = NOISE, seed: int = 0):
    """Turns of two axes to and fro with linear ramps, between rests of 2 s: time, rates of three gyros, usable rows,
    the standstills less the margin, and the angles there."""
    ramp = np.linspace(0.0, 3.0, 60)
    move, rest = np.concatenate([ramp, np.full(100, 3.0), ramp[::-1]]), np.zeros(250)
    parts, spans, angles = [np.zeros((250, 3))], [(0, 249)], [np.zeros(2)]
    for k in range(moves):
        turn = np.zeros((len(move) + len(rest), 3))
        sign = 1.0 if k % 4 < 2 else -1.0
        turn[: len(move), k % 2] = sign * move
        if slow_every and k % slow_every == 0:
            # The drive creeps to its place, from either side.
            turn[len(move) - 1 : len(move) + 8, k % 2] = sign * (0.01, -0.01)[k // slow_every % 2]
        begin = sum(map(len, parts))
        spans.append((begin + len(move) + MARGIN, begin + len(turn) - 1))
        angles.append(angles[-1] + np.eye(2)[k % 2] * sign * np.sum(move) * INTERVAL_S)
        parts.append(turn)
    rates = np.concatenate(parts)
    if filtered_hz:
        rates = signal.lfilter(*signal.butter(1, filtered_hz, fs=1.0 / INTERVAL_S), rates, axis=0)
    rates = rates + noise * np.random.default_rng(seed).standard_normal(rates.shape) + 1e-3
    time = np.arange(len(rates)) * INTERVAL_S
    return time, rates, np.ones(len(rates), bool), spans, np.array(angles)


def earlier(*of) -> list[int]:
    spans = of[3]
    return [a[0] - b[0] for a, b in zip(spans, begun_earlier(*of), strict=True)]


def test_after_moves_that_end_at_once_the_whole_margin_is_rest():
    rows = [max(earlier(*record(200, seed=seed))) for seed in range(20)]
    # A mean is beyond two of its standard deviations now and then.
    assert rows.count(MARGIN) >= 10
    taken = earlier(*record(200, seed=int(np.argmax(rows))))
    assert taken == [0] + 200 * [MARGIN]


@pytest.mark.parametrize("filtered_hz", [5.0, 10.0, 15.0])
def test_what_a_filter_shows_of_the_move_stays_with_it(filtered_hz):
    """To what remains of an angle in the rest the noise of the move's own rows is several times larger, on average over
    all moves, too."""
    _, clean, _, spans, _ = record(4, filtered_hz=filtered_hz, noise=0.0)
    moves, taken = 200, []
    for seed in range(10):
        (rows,) = set(earlier(*record(moves, filtered_hz=filtered_hz, seed=seed))[1:])
        first = spans[1][0]
        left = INTERVAL_S * np.sum(clean[first - rows + 1 : first + 1, 0] - clean[-1, 0])
        assert abs(left) < NOISE * INTERVAL_S * 220**0.5 / (moves / 2) ** 0.5
        taken.append(rows)
    assert max(taken) < MARGIN
    assert max(taken) > 0 or filtered_hz < 15.0


def test_some_moves_that_creep_keep_the_margin_of_all():
    assert max(earlier(*record(200, slow_every=10))) <= MARGIN - 6


def test_few_moves_tell_nothing():
    assert set(earlier(*record(30))) == {0}


def test_rows_that_are_lost_are_not_rest():
    of = list(record(200))
    lost = of[3][7][0] - 3
    of[2][lost] = False
    rows = earlier(*of)
    assert rows[7] == 0
    assert rows[8] == MARGIN
