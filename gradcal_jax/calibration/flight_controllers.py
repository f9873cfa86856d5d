"""Biases over temperature as parameters of flight controllers: cubics in float32, by the formulas of their public
sources; not run on a controller.

    ArduPilot   INS_TCALn_*: cubics about 35 °C, and the accelerometers' scale at one temperature
    PX4         TC_G*, TC_A*: cubics, in steps of 1 °C; no scale factor
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from gradcal_jax.calibration.equation import SIGNALS, linear_part, map_of
from gradcal_jax.calibration.file import CalibratedChannel, Calibration
from gradcal_jax.calibration.losses import Export, losses_of
from gradcal_jax.records.log import Floats
from gradcal_jax.spec.bases import PolynomialKeys

_REFERENCE, _DEGREE, _POINTS = 35.0, 3, 201
_F = np.float32
_LETTERS = {"gyro": ("GYR", "G"), "accelerometer": ("ACC", "A")}


def bias_polynomial(channel: CalibratedChannel, about_c: float) -> Floats:
    """B(T) in powers of (T − about), `(4,)`; a fit over the channel's range where it is no such polynomial. Raises
    `ValueError` without a bias."""
    term = channel.term_of("bias")
    if term is None:
        raise ValueError(
            f"the target takes the bias over temperature, and this calibration has no bias of {channel.label}: zeros "
            "would look like a calibration. Estimate the bias with a spec that has it, or export to c-header or csv"
        )
    basis, _ = term.bases
    if isinstance(basis, PolynomialKeys) and basis.degree <= _DEGREE:
        x = Polynomial([about_c - basis.centre, 1.0]) / basis.scale
        powers: Any = Polynomial(term.table[:, 0])(x).coef
    else:
        low, high = (end - about_c for end in channel.valid_temperature)
        t = np.linspace(low, high, _POINTS)
        values = map_of(channel, term, t + about_c)(0.0 * t)
        powers = Polynomial.fit(t, values, _DEGREE, domain=[low, max(high, low + 1e-6)]).convert().coef
    return np.pad(powers, (0, _DEGREE + 1 - len(powers)))


def _notes(calibration: Calibration, low: float, high: float, *more: str) -> tuple[str, ...]:
    """Sentences for the user, the first of channels whose data cover more than the target's range (°C)."""
    words = f"the target's range is {low:g} … {high:g} °C; outside it, the value at its edge is used"
    wider = [
        f"{channel.label}: {words}"
        for channel in calibration.channel
        if low > channel.valid_temperature[0] + 1e-6 or high < channel.valid_temperature[1] - 1e-6
    ]
    return (*wider, *more)


def _cubic(c: Iterable[float], temperature_c: Any, low: float, high: float, about: float) -> Any:
    """c0 + c1 d + c2 d² + c3 d³ of d = T − `about` within the range, in float32."""
    c0, c1, c2, c3 = map(_F, c)
    d = np.clip(_F(temperature_c), _F(low), _F(high)) - _F(about)
    return c0 + d * c1 + d * d * c2 + d * d * d * c3


def ardupilot(calibration: Calibration, number: int) -> Export:
    """INS_TCAL* of sensor 1 to 3. Raises `ValueError` for another, without a bias, and for less than 10 K."""
    if not 1 <= number <= 3:
        raise ValueError(f"ArduPilot numbers its sensors 1 to 3, not {number}")
    cold, warm = calibration.valid_temperature
    low, high = max(float(cold), -70.0), min(float(warm), 80.0)
    if high - low < 10.0:
        raise ValueError(f"ArduPilot needs a range of at least 10 K, and this calibration covers {low:g} … {high:g} °C")
    at, place = 0.5 * (low + high), "" if number == 1 else str(number)
    parameters = {f"INS_TCAL{number}_ENABLE": 1.0, f"INS_TCAL{number}_TMIN": low, f"INS_TCAL{number}_TMAX": high}
    cubics: dict[str, tuple[list[float], float, float]] = {}
    for channel in calibration.channel:
        kind, letter = _LETTERS[channel.kind][0], channel.axis.upper()
        b = bias_polynomial(channel, _REFERENCE)
        offset, scale = float(Polynomial(b)(at - _REFERENCE)), 1.0
        parameters |= {f"INS_TCAL{number}_{kind}{k}_{letter}": 1e6 * b[k] for k in (1, 2, 3)}
        parameters |= {f"INS_{kind}{number}_CALTEMP": at, f"INS_{kind}{place}OFFS_{letter}": offset}
        if kind == "ACC":
            scale = 1.0 / linear_part([channel], at, [channel.input])[0][0, 0]
            parameters[f"INS_{kind}{place}SCAL_{letter}"] = scale
        cubics[channel.input] = [0.0, *(1e6 * b[1:])], offset, scale

    def corrected(raw: Floats, temperature_c: Floats) -> Floats:
        done = raw.copy()
        for name, (c, offset, scale) in cubics.items():
            moved, there = (_cubic(c, t, low, high, _REFERENCE) * _F(1e-6) for t in (temperature_c, at))
            k = SIGNALS.index(name)
            done[k] = (raw[k] - (moved - there + _F(offset))) * scale
        return done

    words = (
        "sensor's own axes, before the board's rotation; corrected = raw - P(T-35) + P(Tcal-35) - OFFS; accelerometers "
        "also times SCAL, which is that of the middle of the temperature range"
    )
    text = "".join(f"{name} {np.float32(value):.9g}\n" for name, value in parameters.items())
    return Export(text, losses_of(calibration, SIGNALS, corrected), _notes(calibration, low, high, words))


def px4(calibration: Calibration, number: int, identity: int | None) -> Export:
    """TC_* of sensor 0 to 3. Raises `ValueError` for another, without a bias, and where channels have no range in
    common."""
    if not 0 <= number <= 3:
        raise ValueError(f"PX4 numbers its sensors 0 to 3, not {number}")
    low, high = map(float, calibration.valid_temperature)
    if not high >= low:
        raise ValueError("the channels' temperature ranges do not overlap, and PX4 has one range for all of them")
    about = float(round(0.5 * (low + high)))
    switches: dict[str, int] = {}
    parameters: dict[str, float] = {}
    cubics: dict[str, Floats] = {}
    for channel in calibration.channel:
        letter, place = _LETTERS[channel.kind][1], "xyz".index(channel.axis)
        head, b = f"TC_{letter}{number}", bias_polynomial(channel, about)
        switches |= {f"TC_{letter}_ENABLE": 1, f"{head}_ID": identity or 0}
        parameters |= {f"{head}_TREF": about, f"{head}_TMIN": low, f"{head}_TMAX": high}
        parameters |= {f"{head}_X{k}_{place}": float(b[k]) for k in range(4)}
        cubics[channel.input] = b

    def corrected(raw: Floats, temperature_c: Floats) -> Floats:
        done = raw.copy()
        for name, b in cubics.items():
            # Between two updates, the temperature changes by 1 °C.
            done[SIGNALS.index(name)] -= _cubic(b, np.floor(temperature_c), low, high, about)
        return done

    lines = [f"1\t1\t{name}\t{value}\t6\n" for name, value in switches.items()]
    lines += [f"1\t1\t{name}\t{np.float32(value):.9g}\t9\n" for name, value in parameters.items()]
    notes = [
        "offsets CAL_GYRO and CAL_ACC must be zero; corrected = R (raw - offset), offset = X0 + X1 d + X2 d^2 + X3 d^3"
    ]
    if identity is None:
        notes.append("TC_*_ID must be the sensor's device id, or PX4 ignores these parameters: give --device-id")
    return Export("".join(lines), losses_of(calibration, SIGNALS, corrected), _notes(calibration, low, high, *notes))
