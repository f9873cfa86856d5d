"""Random specs of one gyro axis that moves, small enough that one costs little: `random_spec(rng, family)`.

A spec is a dict of TOML tables (gradcal-spec/1) with quantities as text, as people write them. Everything is drawn from
one generator, so a seed names a spec.
"""

from typing import Any

import numpy as np

FAMILIES = ("dynamic gradient", "tactical", "consumer", "hand")
"""The kinds of preset: the paper's, typical sensors of two grades on a motor table, a gimbal moved by hand."""

SHAPES = ("cosine ramps", "linear ramps")
BASES = ("polynomial", "b-spline", "bins")
MOST_READINGS = 1500

Table = dict[str, Any]
# Of the plan's temperatures, °C, and of the axis, deg/s.
Range = tuple[float, float]


def random_spec(rng: np.random.Generator, family: str) -> Table:
    """A valid spec whose requirements its plan (or a prior) observes."""
    cycle, moving = _cycle(rng, family == "hand")
    plan: Table = {"method": "gradient"}
    kind = _one(rng, (_ramp, _ramp, _list, _programme, _programme))
    visited = kind(rng, plan, cycle, moving)
    plan["cycle"] = cycle
    box, fastest = (min(visited), max(visited)), 120.0 if family == "hand" else 300.0
    sensor = _sensor(rng, family, box, fastest)
    return {
        "format": "gradcal-spec/1",
        "title": f"Random, {family}",
        "sensor": sensor,
        "rig": _rig(rng, family, fastest),
        "requirement": _requirements(rng, sensor["gyro"], box, fastest),
        "plan": plan,
    }


def _one(rng: np.random.Generator, choices) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _chance(rng: np.random.Generator, share: float) -> bool:
    return bool(rng.random() < share)


def _size(rng: np.random.Generator, usual: float, spread: float = 3.0) -> float:
    """About `usual`, up to `spread` times more or less."""
    return float(usual * spread ** rng.uniform(-1.0, 1.0))


def _text(value: float, unit: str, digits: int = 4) -> str:
    return f"{value:.{digits}g} {unit}"


def _between(rng: np.random.Generator, low: float, high: float, digits: int = 4) -> float:
    """Rounded as people write figures: the round ones put breaks of the bases and ends of moves on one instant."""
    return float(f"{rng.uniform(low, high):.{digits}g}")


# --- plans ------------------------------------------------------------------------------------------------------------


def _stay(rng: np.random.Generator, moving: float) -> float:
    """Seconds that a used stretch lasts: the moves fit at least once, and not too often."""
    return float(rng.uniform(1.1, 4.5) * moving)


def _ramp(rng: np.random.Generator, plan: Table, cycle: Table, moving: float) -> list[float]:
    span = _stay(rng, moving)
    start, slope = _between(rng, -25, 30, 2), _between(rng, 0.8, 6, 2)
    change = min(slope * span / 60.0, 40.0)
    slope = float(f"{change / span * 60.0:.4g}")
    end = float(f"{start + _one(rng, (-1, 1)) * change:.4g}")
    if end < -38.0:
        end = float(f"{start + change:.4g}")
    plan["temperature"] = [_text(start, "degC"), _text(end, "degC")]
    plan["gradient"] = _text(slope, "K/min")
    if _chance(rng, 0.6):
        duration = _stay(rng, moving) if _chance(rng, 0.5) else float(rng.uniform(100, 3000))
        used = _chance(rng, 0.5)
        plan["soak"] = {"duration": _text(min(duration, 500.0) if used else duration, "s"), "used": used}
    return [start, end]


def _list(rng: np.random.Generator, plan: Table, cycle: Table, moving: float) -> list[float]:
    period = moving + _seconds(cycle.get("other_axes", {}).get("duration"))
    period = max(period, _seconds(cycle.get("duration")))
    here = _between(rng, -10, 30, 2)
    visited, slopes = [here], []
    for _ in range(int(rng.integers(2, 5))):
        change = float(rng.uniform(3, 15) * _one(rng, (1, 1, -1)))
        slope = float(f"{np.clip(change / period * 60.0, -9.0, 9.0):.3g}")
        if not -38.0 < visited[-1] + slope * period / 60.0 < 83.0:
            slope = -slope
        slopes.append(slope)
        visited.append(visited[-1] + slope * period / 60.0)
    plan["temperature"] = [_text(here, "degC")]
    plan["gradient"] = [_text(s, "K/min") for s in slopes]
    if _chance(rng, 0.5):
        plan["soak"] = {"duration": _text(_between(rng, 60, 400, 2), "s"), "used": _chance(rng, 0.4)}
    return visited


def _programme(rng: np.random.Generator, plan: Table, cycle: Table, moving: float) -> list[float]:
    here = _between(rng, -20, 30, 2)
    first: Table = {"soak": _text(_between(rng, 60, 900, 2), "s"), "at": _text(here, "degC")}
    if _chance(rng, 0.3):
        first |= {"soak": _text(min(_stay(rng, moving), 400.0), "s"), "used": True}
    items, visited = [first], [here]

    def ramp(used: bool | None) -> None:
        goal = _between(rng, -30, 70, 3)
        while abs(goal - visited[-1]) < 3.0:
            goal = _between(rng, -30, 70, 3)
        seconds = min(_stay(rng, moving), 600.0) if used is not False else float(rng.uniform(100, 400))
        rate = float(f"{min(abs(goal - visited[-1]) / seconds * 60.0, 9.5):.4g}")
        items.append({"ramp_to": _text(goal, "degC"), "rate": _text(rate, "K/min")})
        if used is not None:
            items[-1]["used"] = used
        visited.append(goal)

    def soak() -> None:
        items.append({"soak": _text(_between(rng, 50, 300, 3), "s")})
        if _chance(rng, 0.6):
            items[-1]["used"] = _chance(rng, 0.4)

    def step() -> None:
        goal = _between(rng, -30, 70, 3)
        while abs(goal - visited[-1]) < 3.0:
            goal = _between(rng, -30, 70, 3)
        items.append({"step_to": _text(goal, "degC")})
        if _chance(rng, 0.2):
            items[-1]["used"] = True
        visited.append(goal)

    # One long used ramp, in which the moves fit for certain; around it whatever comes.
    before = int(rng.integers(0, 2))
    for k in range(int(rng.integers(2, 5))):
        if k == before:
            goal = 60.0 if visited[-1] < 20.0 else -20.0
            seconds = max(1.2 * moving, 300.0)
            rate = float(f"{min(abs(goal - visited[-1]) / seconds * 60.0, 9.5):.4g}")
            items.append({"ramp_to": _text(goal, "degC"), "rate": _text(rate, "K/min"), "used": True})
            visited.append(goal)
        _one(rng, (lambda: ramp(None), lambda: ramp(False), soak, soak, step))()
    plan["programme"] = items
    return visited


def _seconds(text: str | None) -> float:
    return 0.0 if text is None else float(text.removesuffix(" s"))


# --- motion -----------------------------------------------------------------------------------------------------------


def _cycle(rng: np.random.Generator, by_hand: bool) -> tuple[Table, float]:
    """A cycle and what its own moves take (s)."""
    end_reads = _chance(rng, 0.2)
    # The first rest is read while it lasts, so that there is a reading in any case.
    rest = lambda: _rest(rng, end_reads)  # noqa: E731
    moves: list[Table] = [{"rest": _text(_between(rng, 4, 12, 2), "s"), "read_every": _text(_one(rng, (1, 2)), "s")}]
    turns = int(rng.integers(2, 6))
    moving = _seconds(moves[0]["rest"])
    for _ in range(turns):
        turn, seconds = _by_hand(rng) if by_hand else _turn(rng)
        moves.append(turn)
        moving += seconds
        if _chance(rng, 0.75):
            moves.append(rest())
            moving += _seconds(moves[-1]["rest"]) * moves[-1].get("repeat", 1)
    cycle: Table = {"moves": moves}
    if _chance(rng, 0.65):
        others: Table = {"duration": _text(_between(rng, 10, 60, 2), "s")}
        if _chance(rng, 0.7):
            others["read"] = _chance(rng, 0.75)
            if others["read"]:
                others["read_every"] = _text(_one(rng, (1, 2.5, 4)), "s")
        cycle["other_axes"] = others
    if _chance(rng, 0.15):
        other = _seconds(cycle.get("other_axes", {}).get("duration"))
        cycle["duration"] = _text(float(np.ceil(1.02 * moving + other + rng.uniform(0, 20))), "s", 6)
    return cycle, moving


def _rest(rng: np.random.Generator, end_reads: bool) -> Table:
    rest: Table = {"rest": _text(_between(rng, 2, 12, 2), "s")}
    if end_reads and _chance(rng, 0.6):
        rest["read"] = "end"
    elif _chance(rng, 0.75):
        rest["read_every"] = _text(_one(rng, (1, 1, 2, 0.7)), "s")
    else:
        rest["read"] = "none"
    if _chance(rng, 0.08):
        rest["repeat"] = 2
    return rest


def _reads(rng: np.random.Generator, move: Table, duration: float) -> None:
    kind = _one(rng, ("", "", "end", "none", "every"))
    if kind == "every":
        move["read_every"] = _text(float(f"{duration / rng.uniform(2, 5):.2g}"), "s")
    elif kind:
        move["read"] = kind


def _turn(rng: np.random.Generator) -> tuple[Table, float]:
    """A turn and how long it takes, all within 300 deg/s and 600 deg/s²."""
    shape = _one(rng, SHAPES)
    move: Table = {"shape": shape}
    sign, peak = _one(rng, (-1.0, 1.0)), _between(rng, 15, 280, 3)
    # Peak acceleration over peak rate is steepness/ramp.
    least = {"cosine ramps": np.pi / 2.0, "linear ramps": 1.0}[shape] * peak / 600.0
    duration = float(f"{2.0 * least * 1.1 + rng.uniform(3, 12):.3g}")
    ramp = least * 1.1 + 0.05
    kind = _one(rng, ("rate and duration", "with ramp", "angle and rate", "whole turns"))
    if kind == "angle and rate":
        angle = float(f"{peak * (duration - ramp):.4g}")
        move |= {"turn": _text(sign * angle, "deg"), "peak_rate": _text(peak, "deg/s")}
        duration = angle / peak + least
    elif kind == "whole turns":
        turns = max(1, round(peak * (duration - ramp) / 360.0))
        # At the rate that this angle needs the largest acceleration must still suffice.
        duration = float(f"{max(duration, 360.0 * turns / 280.0 + 2.2):.3g}")
        move |= {"turns": float(sign * turns), "duration": _text(duration, "s")}
    else:
        move |= {"peak_rate": _text(sign * peak, "deg/s"), "duration": _text(duration, "s")}
        if kind == "with ramp":
            move["ramp"] = _text(float(rng.uniform(least * 1.1 + 0.02, 0.48 * duration)), "s", 3)
    _reads(rng, move, duration)
    return move, duration


def _by_hand(rng: np.random.Generator) -> tuple[Table, float]:
    turns = float(_one(rng, (-1, 1, 1, -2, 2)))
    duration = float(f"{abs(turns) * rng.uniform(9, 16):.3g}")
    move: Table = {"shape": "hand", "turns": turns, "duration": _text(duration, "s")}
    if _chance(rng, 0.7):
        move["unevenness"] = _between(rng, 0.0, 0.4, 2)
    if _chance(rng, 0.3):
        move["read"] = _one(rng, ("end", "none"))
    return move, duration


# --- sensor -----------------------------------------------------------------------------------------------------------


def _sensor(rng: np.random.Generator, family: str, box: Range, fastest: float) -> Table:
    grade = {"consumer": 10.0, "tactical": 0.7, "hand": 0.7}.get(family, 1.0)
    sensor: Table = {}
    gyro: Table = {"axes": ["x"], "angle_random_walk": _text(_size(rng, 0.1 * grade), "deg/sqrt(h)")}
    both = family != "dynamic gradient"
    has_bias = both or _chance(rng, 0.35)
    has_scale = not has_bias or both or _chance(rng, 0.7)
    if _chance(rng, 0.93):
        _processes(rng, sensor, gyro, grade)
    if _chance(rng, 0.35):
        gyro["turn_on_bias"] = _text(_size(rng, 10 * grade), "deg/h")
    if _chance(rng, 0.4):
        sensor["thermal_lag"] = _text(_between(rng, 60, 400, 2), "s")
    if has_bias and _chance(rng, 0.25):
        gyro["bias_temperature_gradient"] = {}
        if _chance(rng, 0.7):
            gyro["bias_temperature_gradient"]["prior"] = _text(_size(rng, 5), "deg/h/(K/min)")
    if has_bias:
        gyro["bias"] = _bias(rng, box, grade)
    if has_scale:
        gyro["scale_factor"] = _scale_factor(rng, box, fastest, grade)
    return sensor | {"gyro": gyro}


def _processes(rng: np.random.Generator, sensor: Table, gyro: Table, grade: float) -> None:
    def rows(count: int, size: float, unit: str) -> list[Table]:
        return [
            {"standard_deviation": _text(_size(rng, size), unit), "correlation_time": _text(_size(rng, 250, 8.0), "s")}
            for _ in range(count)
        ]

    if drifts := _one(rng, (0, 1, 1, 2, 3)):
        gyro["drift"] = rows(drifts, 1.0 * grade, "deg/h")
    if _chance(rng, 0.25):
        gyro["rate_random_walk"] = _text(_size(rng, 1.0 * grade), "deg/h/sqrt(h)")
    if _chance(rng, 0.4):
        gyro["scale_factor_instability"] = rows(_one(rng, (1, 1, 2)), 20 * grade, "ppm")
    if _chance(rng, 0.3):
        error: Table = {"standard_deviation": _text(_size(rng, 0.1), "K")}
        if _chance(rng, 0.6):
            error["correlation_time"] = _text(_size(rng, 400, 5.0), "s")
        slopes = _one(rng, ("bias", "scale", "both"))
        if slopes != "scale":
            error["bias_slope"] = _text(_size(rng, 5 * grade), "deg/h/K")
        if slopes != "bias":
            error["scale_factor_slope"] = _text(_size(rng, 15 * grade), "ppm/K")
        gyro["temperature_error"] = error
    if _chance(rng, 0.4):
        sensor["sample_clock_error"] = _text(_size(rng, 20 * grade), "ppm")


def _bias(rng: np.random.Generator, box: Range, grade: float) -> Table:
    basis = _temperature_basis(rng, box)
    section: Table = {"temperature": basis}
    _priors(rng, section, (500 * grade, "deg/h"), (2 * grade, "deg/h"))
    if basis["basis"] == "polynomial" and _chance(rng, 0.2):
        section["discrepancy"] = {
            "standard_deviation": _text(_size(rng, 1 * grade), "deg/h"),
            "temperature_degree": basis["degree"] + int(rng.integers(1, 3)),
        }
    return section


def _scale_factor(rng: np.random.Generator, box: Range, fastest: float, grade: float) -> Table:
    temperature = _temperature_basis(rng, box)
    rate = _rate_basis(rng, fastest)
    section: Table = {"temperature": temperature, "rate": rate}
    _priors(rng, section, (5000 * grade, "ppm"), (100 * grade, "ppm"))
    if temperature["basis"] == rate["basis"] == "polynomial" and _chance(rng, 0.25):
        section["discrepancy"] = {
            "standard_deviation": _text(_size(rng, 5 * grade), "ppm"),
            "temperature_degree": temperature["degree"] + int(rng.integers(0, 2)),
            "rate_degree": rate["degree"] + int(rng.integers(1, 3)),
        }
    return section


def _priors(rng: np.random.Generator, section: Table, prior: tuple[float, str], smoothness: tuple[float, str]) -> None:
    """What a plan may not observe gets a prior: all but polynomials of low degree."""
    polynomials = all(basis["basis"] == "polynomial" for basis in section.values())
    low = polynomials and section["temperature"]["degree"] <= 2 and section.get("rate", {}).get("degree", 0) <= 1
    if _chance(rng, 0.6 if low else 1.0):
        section["prior"] = _text(_size(rng, prior[0]), prior[1])
    if not polynomials and _chance(rng, 0.4):
        section["smoothness"] = _text(_size(rng, smoothness[0]), smoothness[1])


def _temperature_basis(rng: np.random.Generator, box: Range) -> Table:
    low, high = box
    kind = _one(rng, ("polynomial", *BASES))
    if kind != "polynomial":
        return _pieces(rng, kind, low - 6.0, high + 6.0, "degC")
    centre = {"centre": _text(0.5 * (low + high), "degC", 2)} if _chance(rng, 0.7) else {}
    scale = _text(max(0.6 * (high - low), 10.0), "K", 2)
    return {"basis": kind, "degree": int(rng.integers(0, 4)), "scale": scale} | centre


def _rate_basis(rng: np.random.Generator, fastest: float) -> Table:
    kind = _one(rng, ("polynomial", *BASES))
    if kind != "polynomial":
        return _pieces(rng, kind, -fastest, fastest, "deg/s")
    centre = {"centre": _text(_between(rng, -20, 20, 2), "deg/s")} if _chance(rng, 0.15) else {}
    return {"basis": kind, "degree": int(rng.integers(0, 4)), "scale": _text(fastest, "deg/s")} | centre


def _pieces(rng: np.random.Generator, kind: str, low: float, high: float, unit: str) -> Table:
    """B-splines or bins over a range, with one to three breaks inside."""
    inner = int(rng.integers(1, 4))
    at = np.linspace(low, high, inner + 2)
    shift = 0.3 * (at[1] - at[0])
    breaks = [at[0], *(a + rng.uniform(-shift, shift) for a in at[1:-1]), at[-1]]
    values = [_text(b, unit, 3) for b in breaks]
    if kind == "bins":
        return {"basis": "bins", "edges": values}
    basis: Table = {"basis": "b-spline", "knots": values}
    if _chance(rng, 0.8):
        basis["degree"] = int(rng.integers(0, 4))
    return basis


# --- rig and requirements ---------------------------------------------------------------------------------------------


def _rig(rng: np.random.Generator, family: str, fastest: float) -> Table:
    angle: Table = {"read_every": _text(_between(rng, 3, 20, 2), "s")}
    if _chance(rng, 0.85):
        angle["reading_noise"] = _text(_size(rng, 0.02, 6.0), "deg")
    if _chance(rng, 0.45):
        angle["standstill_offset"] = _text(_size(rng, 20, 6.0), "arcsec")
    if _chance(rng, 0.4):
        angle["timing_error"] = _text(_size(rng, 0.2), "ms")
    if _chance(rng, 0.35):
        orders = sorted(int(n) for n in rng.permutation([1, 2, 3, 5, 36])[: int(rng.integers(1, 4))])
        angle["harmonics"] = [{"order": n, "amplitude": _text(_size(rng, 15), "arcsec")} for n in orders]
    axis: Table = {
        "name": "x",
        "direction": [0.0, 0.0, 1.0],
        "max_rate": _text(fastest, "deg/s"),
        "max_acceleration": "600 deg/s^2",
        "travel": "unlimited",
        "angle": angle,
    }
    table: Table = {"standing": "read", "mounting": [{"x": "+z", "y": "+x", "z": "+y"}], "axis": [axis]}
    if family == "hand":
        table["drive"] = "hand"
    chamber = {"range": ["-40 degC", "85 degC"], "max_heating": "10 K/min", "max_cooling": "10 K/min"}
    return {"table": table, "chamber": chamber}


def _requirements(rng: np.random.Generator, gyro: Table, box: Range, fastest: float) -> list[Table]:
    temperatures = [_text(end, "degC", 3) for end in box]
    if float(temperatures[0].split()[0]) >= float(temperatures[1].split()[0]):
        temperatures = [_text(box[0] - 3.0, "degC", 3), _text(box[1] + 3.0, "degC", 3)]
    rows: list[Table] = []
    if "scale_factor" in gyro:
        top = 0.9 * fastest
        rows.append(
            {
                "name": "scale factor",
                "quantity": "gyro_scale_factor",
                "temperature": temperatures,
                "rate": [_text(-top, "deg/s"), _text(_one(rng, (top, 0.4 * top)), "deg/s")],
                "statistic": _one(rng, ("mean of max", "max", "mean", "rms")),
                "grid": [int(rng.integers(4, 9)), int(rng.integers(4, 11))],
            }
        )
    if "bias" in gyro:
        rows.append(
            {
                "name": "bias",
                "quantity": "gyro_bias",
                "temperature": temperatures,
                "statistic": _one(rng, ("max", "mean", "rms")),
                "grid": [int(rng.integers(4, 12))],
            }
        )
    return rows
