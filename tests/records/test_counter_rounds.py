"""How long a gap is, of a counter that begins anew every few samples: as the computer's clock says.

Samples come in bursts, the host has each of them late, and samples are lost between bursts, with damaged bytes or
cleanly. In every quiet stretch a few bursts come with hardly any delay; all others may be seconds late.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.hardware.sample_times import SampleDecoder
from gradcal_jax.records.clockmap import bridge_gaps
from gradcal_jax.records.sessions import SampleFile

SAMPLE_S, ROUND, BURST = 0.008, 16, 10
ROUND_S = ROUND * SAMPLE_S
QUICK_S = 0.2 * ROUND_S


def sent(folder, bursts, lost, late_s, damaged):
    """The samples of `bursts` bursts, the samples `lost` before some of them, and each sample's true number."""
    decoder = SampleDecoder("count", 1.0 / SAMPLE_S, SAMPLE_S, ROUND)
    truth, count, arrived = [], 0, 0.0
    file = SampleFile(folder)
    for number in range(bursts):
        count += lost.get(number, 0)
        index = count + np.arange(BURST)
        count += BURST
        arrived = max(arrived + 1e-5, count * SAMPLE_S + late_s[number])
        first = (np.arange(BURST) == 0) & (number in lost) & damaged
        stamps = (index % ROUND).astype(float)
        file.push(decoder._batch(arrived, stamps, {"gyro": np.zeros((BURST, 3))}, first))
        truth.append(index)
    return file.rows(), np.concatenate(truth)


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
def test_behind_a_loss_the_clock_goes_on_by_the_computers_however_late_the_others_are(tmp_path_factory, stream):
    bursts, lost, late, damaged = stream
    # Without damaged bytes a loss of whole rounds leaves no trace; a sample with the last stamp again is left out.
    lost = {number: count if damaged or count % ROUND else count + 1 for number, count in lost.items()}
    lost = {number: count + 2 if count % ROUND == ROUND - 1 else count for number, count in lost.items()}
    rows, truth = sent(tmp_path_factory.mktemp("rows"), bursts, lost, late, damaged)
    bridge_gaps(rows, ROUND_S, SAMPLE_S)
    # As well as the quickest arrivals on both sides say; where less than a round is lost, to the sample.
    within_s = QUICK_S * len(lost) + 1e-9
    np.testing.assert_allclose(rows["time_s"] - rows["time_s"][0], (truth - truth[0]) * SAMPLE_S, atol=within_s)
    assert rows["gap"][1:].sum() == pytest.approx(sum(lost.values()), abs=within_s / SAMPLE_S + len(lost))
