"""Texts of calibration files with any bases, for the tests of this folder."""

import numpy as np

POLYNOMIAL_T = 'temperature = { basis = "polynomial", degree = 3, centre = "20 degC", scale = "50 K" }'
POLYNOMIAL_W = 'rate = { basis = "polynomial", degree = 3, scale = "300 deg/s" }'
SPLINE_T = 'temperature = { basis = "b-spline", knots = ["-30 degC", "0 degC", "40 degC", "70 degC"] }'
BINS_W = 'rate = { basis = "bins", edges = ["-300 deg/s", "0 deg/s", "300 deg/s"] }'


def axis_text(name, temperature=POLYNOMIAL_T, rate=POLYNOMIAL_W, seed=0, size=3e-3, n_t=4, n_w=4, more=""):
    rng = np.random.default_rng(seed)
    a = [f"a{i}" if "poly" in temperature else f"a_spline{i}" for i in range(n_t)]
    both = "poly" in temperature and "poly" in rate
    b = [
        f"b{j}{i}"
        if both
        else f"b{'_bin' if 'bins' in rate else ''}{j}_{'_spline' if 'spline' in temperature else ''}{i}"
        for i in range(n_t)
        for j in range(n_w)
    ]
    lines = ["[[axis]]", f'name = "{name}"', 'valid_temperature = ["-30 degC", "70 degC"]']
    lines += ['valid_rate = ["-300 deg/s", "300 deg/s"]', more, "[axis.bias]", temperature, "[axis.bias.coefficients]"]
    lines += [f"{n} = {v!r}" for n, v in zip(a, (1e-3 * rng.standard_normal(n_t)).tolist(), strict=True)]
    lines += ["[axis.scale_factor]", temperature, rate, "[axis.scale_factor.coefficients]"]
    lines += [f"{n} = {v!r}" for n, v in zip(b, (size * rng.standard_normal(n_t * n_w)).tolist(), strict=True)]
    return "\n".join(lines) + "\n"


HEAD = """format = "gradcal-calibration/1"
serial_number = "SN-7"
quantity = "gyro"
simulated = true
frame = "the sensor's own axes"
order = "measured = (1 + M(T, rate)) * rate + B(T)"
"""
WHOLE = HEAD + axis_text("x") + axis_text("y", seed=1) + axis_text("z", seed=2)
