"""The data's side of the Direct Bound in its plain form: the drift of every start."""

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.identify.largest_drift import _whole_samples, running_angle


def drifts(rate, sample_interval_s, integration_time_s, averaging_time_s, *, valid=None):
    """D(t) of every start of one channel, by the plain formula."""
    before = _whole_samples(averaging_time_s, sample_interval_s)
    length = _whole_samples(integration_time_s, sample_interval_s)
    result = [np.zeros(0)]
    for start, stop in formulas.runs(np.ones(len(rate), bool) if valid is None else valid).tolist():
        if stop - start >= before + length:
            angle = running_angle(rate[start:stop])
            anchor = angle[before : len(angle) - length]
            ahead = (angle[before + length :] - anchor) / length
            result.append(ahead - (anchor - angle[: len(anchor)]) / before)
    return np.concatenate(result)
