"""What flight controllers make of their parameters, from their sources (PX4 `TemperatureCompensation`, ArduPilot
`AP_InertialSensor_TCal`), in float32: what each takes off a reading, in SI. `values`: the parameters by name."""

import numpy as np

F = np.float32


def parameters_of(text, target):
    """The parameters in an exported text."""
    rows = [line.split() for line in text.splitlines()]
    name, value = (2, 3) if target == "px4" else (0, 1)
    return {row[name]: float(row[value]) for row in rows}


def px4(values, axis, temperature, number=0, kind="gyro"):
    head = f"TC_{'G' if kind == 'gyro' else 'A'}{number}"
    low, high, about, *x = (
        F(values[f"{head}_{k}"]) for k in ("TMIN", "TMAX", "TREF", *(f"X{k}_{axis}" for k in range(4)))
    )
    delta = np.clip(np.asarray(temperature, F), low, high) - about
    return sum(x[k] * delta**k for k in range(4)).astype(float)


def ardupilot(values, axis, temperature, number=1, kind="gyro"):
    """The polynomial, if enabled, less its value at CALTEMP, and the offset; not the scale of accelerometers."""
    kind = "GYR" if kind == "gyro" else "ACC"
    f = lambda name: F(values.get(f"INS_{name}", 0.0))  # noqa: E731
    low, high = f(f"TCAL{number}_TMIN"), f(f"TCAL{number}_TMAX")

    def polynomial(t):
        d = np.clip(np.asarray(t, F), low, high) - F(35)
        return sum(f(f"TCAL{number}_{kind}{k}_{'XYZ'[axis]}") * F(1e-6) * d**k for k in (1, 2, 3))

    at = polynomial(f(f"{kind}{number}_CALTEMP"))
    offset = f(f"{kind}{number if number > 1 else ''}OFFS_{'XYZ'[axis]}")
    enabled = f(f"TCAL{number}_ENABLE") == 1.0
    return (enabled * (polynomial(temperature) - at) + offset).astype(float)


TAKEN_OFF = {"px4": px4, "ardupilot": ardupilot}
