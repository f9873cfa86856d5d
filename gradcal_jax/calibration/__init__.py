"""Calibrations: their file, the correction of data by them, and their exports to other programs.

The kinds of channel are alike: a gyro axis is a calibration with one channel.
"""

from gradcal_jax.calibration.file import (
    FORMAT,
    FRAME_OF_CASE,
    LOG_HASH,
    ORDER,
    TEMPERATURE_RATE,
    CalibratedChannel,
    CalibratedTerm,
    Calibration,
    Covariance,
    FitTest,
    Noise,
    PathCoefficient,
    Residuals,
    Result,
    TableError,
    UnseenError,
    build_term,
    is_calibration,
    parse_calibration,
    read_calibration,
    write_calibration,
)

__all__ = [
    "FORMAT",
    "FRAME_OF_CASE",
    "LOG_HASH",
    "ORDER",
    "TEMPERATURE_RATE",
    "CalibratedChannel",
    "CalibratedTerm",
    "Calibration",
    "Covariance",
    "FitTest",
    "Noise",
    "PathCoefficient",
    "Residuals",
    "Result",
    "TableError",
    "UnseenError",
    "build_term",
    "is_calibration",
    "parse_calibration",
    "read_calibration",
    "write_calibration",
]
