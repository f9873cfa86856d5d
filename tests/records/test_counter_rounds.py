"""How many samples are missing at a gap, of a counter that begins anew every few samples.

Samples come in bursts, the host has each of them late, and samples are lost between bursts, with damaged bytes or
cleanly. In every quiet stretch a few bursts come with hardly any delay; all others may be seconds late.
"""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.hardware.drivers.listening import SampleTimes
from gradcal_jax.hardware.roles import imu_batch
from gradcal_jax.records.parts import count_rounds
from gradcal_jax.records.spool import SampleSpool

SAMPLE_S, ROUND, BURST = 0.008, 16, 10
ROUND_S = ROUND * SAMPLE_S
QUICK_S = 0.2 * ROUND_S


def sent(bursts, lost, late_s, damaged):
    """A spool of `bursts` bursts, the samples `lost` before some of them, and each sample's true number."""
    times = SampleTimes("count", 1.0 / SAMPLE_S, SAMPLE_S, ROUND)
    spool = SampleSpool()
    truth, count, arrived = [], 0, 0.0
    for number in range(bursts):
        count += lost.get(number, 0)
        index = count + np.arange(BURST)
        count += BURST
        arrived = max(arrived + 1e-5, count * SAMPLE_S + late_s[number])
        device, gaps, _ = times.push(index % ROUND)
        first = (np.arange(BURST) == 0) & (number in lost) & damaged
        none = np.zeros((BURST, 3))
        spool.push(imu_batch(arrived, device, none, none, none, gap_before=gaps, disturbed=first))
        truth.append(index)
    return spool, np.concatenate(truth)


@st.composite
def streams(draw, quick):
    """Stretches of 30 bursts of which the first and the last three come within `quick` of a loss-free time."""
    stretches = draw(st.integers(2, 4))
    losses = draw(st.lists(st.integers(1, 600), min_size=stretches - 1, max_size=stretches - 1))
    late = []
    for _ in range(stretches):
        # What comes late keeps the next bursts waiting: until the last three of the stretch at most.
        latest = [quick] * 3 + [BURST * SAMPLE_S * (27 - number) for number in range(3, 27)] + [quick] * 3
        late += [draw(st.floats(0.0, most)) for most in latest]
    return 30 * stretches, {30 * (n + 1): loss for n, loss in enumerate(losses)}, late, draw(st.booleans())


@settings(max_examples=60, deadline=None)
@given(streams(QUICK_S))
def test_every_loss_is_counted_with_its_rounds_however_late_the_others_are(stream):
    bursts, lost, late, damaged = stream
    # Without damaged bytes a loss of whole rounds leaves no trace.
    lost = {number: count if damaged or count % ROUND else count + 1 for number, count in lost.items()}
    spool, truth = sent(bursts, lost, late, damaged)
    with spool:
        assert count_rounds(spool, 0, len(spool), ROUND, SAMPLE_S) == []
        found = spool.read(0, len(spool))
    np.testing.assert_allclose(found["device_s"] - found["device_s"][0], (truth - truth[0]) * SAMPLE_S, atol=1e-9)
    assert found["gap"][1:].sum() == sum(lost.values())


def test_a_loss_whose_rounds_the_arrivals_do_not_tell_is_returned_and_not_counted():
    late = [0.0] * 30 + [0.4 * ROUND_S] * 30
    spool, _ = sent(60, {30: 37}, late, damaged=True)
    with spool:
        assert count_rounds(spool, 0, len(spool), ROUND, SAMPLE_S) == [30 * BURST]
        assert spool.read(0, len(spool))["gap"].sum() == 37 % ROUND


def test_a_long_counter_counts_by_itself():
    spool, _ = sent(10, {5: 3}, [0.0] * 10, damaged=False)
    with spool:
        assert count_rounds(spool, 0, len(spool), 0, SAMPLE_S) == []


def test_a_stream_without_samples_has_no_gaps():
    with SampleSpool() as spool:
        assert count_rounds(spool, 0, 0, ROUND, SAMPLE_S) == []
