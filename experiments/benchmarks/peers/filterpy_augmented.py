"""FilterPy: the same augmented filter, step by step in NumPy; it has no gradient, so finite differences.

One-sided differences take N·p + N + 1 runs of the filter; a single run is timed and the rest is multiplied.
"""

import importlib.metadata

import numpy as np
from filterpy.kalman import KalmanFilter

from peers.problem import Problem, state_space


def build(problem: Problem) -> dict:
    count, p = problem.columns.shape
    size = p + 2

    def forward():
        to_angle, kept, q_angle, q_cross, q_drift = state_space(problem, problem.durations, np)
        kalman = KalmanFilter(dim_x=size, dim_z=1)
        kalman.P = np.diag(np.concatenate([[problem.reading_std**2, problem.drift_std**2], 1.0 / problem.prior]))
        kalman.R = np.array([[problem.reading_std**2]])
        transition, noise, observed = np.eye(size), np.zeros((size, size)), np.zeros((1, size))
        observed[0, 0] = 1.0
        reading = np.zeros(1)
        for k in range(count):
            transition[0, 1], transition[1, 1] = to_angle[k], kept[k]
            noise[0, 0], noise[0, 1], noise[1, 0], noise[1, 1] = q_angle[k], q_cross[k], q_cross[k], q_drift[k]
            observed[0, 2:] = problem.columns[k]
            kalman.predict(F=transition, Q=noise)
            kalman.update(reading, H=observed)
        return np.linalg.inv(kalman.P[2:, 2:])

    return {
        "forward": forward,
        "gradient runs": count * p + count + 1,
        "version": f"filterpy {importlib.metadata.version('filterpy')}",
    }
