"""`gradcal instability` and `gradcal allan`: a sensor's noise from a record at rest, and how long that must be."""

import math
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from gradcal_jax.cli.output import (
    DONE,
    NOT_AS_WISHED,
    Flag,
    ForceOutput,
    JsonNumbers,
    OptionalOutput,
    Plot,
    as_json,
    drawable,
    save_figure,
    strong,
    writable,
)
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.recordings import LOG_HELP, WHOLE, LogFile, Recording, described, load, quantity, span
from gradcal_jax.tables.display import columns

if TYPE_CHECKING:
    from gradcal_jax.identify import AllanFit
    from gradcal_jax.identify.instability import Instability, RestRecord

    # A range of temperature, a branch (None: all), and the instability there or why there is none.
    _Piece = tuple[tuple[float, float] | None, str | None, Instability | str]

Axes = Annotated[
    tuple[str, ...], Parameter(name="--axis", negative="", help="Which axis; may be repeated; by default all.")
]
Unit = Annotated[str | None, Parameter(name="--unit", help="Which IMU, if the log has several.")]
_DEGREE = (
    "The bias over temperature is subtracted first, as a polynomial of this degree; -1: nothing is subtracted. By\n"
    "default 3 if the temperature changes by 5 K or more, and otherwise 0 (only the mean is subtracted)."
)
BiasDegree = Annotated[int | None, Parameter(name="--bias-degree", help=_DEGREE)]
_LAG = 'Lag of the bias behind the temperature: a time, "none", "fit", or "auto" (fitted, and used if it fits better).'
Lag = Annotated[str, Parameter(help=_LAG)]
_SPAN = 'A time span of the record to leave out, such as "123 s..130 s"; may be repeated.'
Without = Annotated[tuple[str, ...], Parameter(name="--without", negative="", help=_SPAN)]


def instability(
    log: LogFile,
    /,
    *,
    axis: Axes = (),
    unit: Unit = None,
    delta: str = "10 s",
    shortest: str = "1 s",
    longest: str = "20 min",
    margin: float = 2.5,
    random_walk: str | None = None,
    bias_degree: BiasDegree = None,
    lag: Lag = "auto",
    temperature: Annotated[tuple[str, str] | None, Parameter(negative="")] = None,
    ranges: int = 1,
    bins: str | None = None,
    branches: Flag = False,
    without: Without = (),
    source: Recording = WHOLE,
    json: JsonNumbers = False,
    plot: Plot = None,
) -> int:
    """Bound the drift in a record at rest by a Gauss-Markov process (the Direct Bound of Z. Berman), and print the
    standard deviation and correlation time of this process as a part of a spec.

    The exit status is 1 if the record shows no drift in addition to the angle random walk, or if the angle random walk
    is larger than that of any gyro.

    Parameters
    ----------
    delta
        Duration of the average that is subtracted before the drift is measured.
    shortest
        Shortest integration time.
    longest
        Longest integration time.
    margin
        The bound is this number of standard deviations of the drift; the data must stay within the bound.
    random_walk
        Angle random walk, such as "0.1 deg/sqrt(h)"; by default that of the Allan deviation.
    temperature
        Use only rows between two temperatures: --temperature "20 degC" "40 degC".
    ranges
        Also compute the bound for each of this number of equal temperature ranges.
    bins
        Also compute the bound for each temperature range of this width, such as "2 K".
    branches
        Also compute the results of heating and of cooling separately, for the whole record and for each temperature
        range.
    plot
        Draw the largest drifts and their bound into this file (.png, .svg, .pdf).
    """
    drawable(plot)
    delta_s = quantity(delta, "time", "--delta")
    shortest_s, longest_s = quantity(shortest, "time", "--shortest"), quantity(longest, "time", "--longest")
    walk = None if random_walk is None else quantity(random_walk, "angle random walk", "--random-walk")
    between = None
    if temperature is not None:
        low, high = (quantity(text, "temperature", "--temperature") for text in temperature)
        between = (low, high)
    lag_s = _lag(lag)
    if ranges < 1:
        raise ValueError(f"--ranges must be 1 or more, not {ranges}")
    width = _width(bins)
    if not (delta_s > 0 and 0 < shortest_s <= longest_s and margin > 0):
        raise ValueError("--delta, --shortest and --margin must be positive, and --longest no shorter than --shortest")
    left_out = [span(text, "--without") for text in without]
    recorded = load(log, source, unit=unit)
    use_float64()
    from gradcal_jax.identify import instability as work

    look = partial(
        work.instability, averaging_time_s=delta_s, shortest_s=shortest_s, longest_s=longest_s, margin=margin
    )
    results: list[Instability] = []
    parts: list[list[_Piece]] = []
    for name in work.axes_asked_for(recorded, axis):
        rest = work.at_rest(
            recorded, name, 0 if unit is None else unit, bias_degree=bias_degree, lag=lag_s, without=left_out
        )
        rest.walk_of_sensor(0.0)  # asks before anything is printed
        whole = look(rest, angle_random_walk=walk, temperature_c=between)
        results.append(whole)
        pieces: list[_Piece] = []
        for part, way in _parts(rest, ranges, width, branches):
            try:
                # The random walk is the sensor's own; a short range says less of it than the whole record.
                one = look(rest, angle_random_walk=whole.bound.angle_random_walk, temperature_c=part, branch=way)
                pieces.append((part, way, one))
            except ValueError as error:
                pieces.append((part, way, str(error)))
        parts.append(pieces)
    if json:
        rows = []
        for whole, pieces in zip(results, parts, strict=True):
            row = work.instability_row(whole)
            row["ranges"] = [
                {"temperature_c": part, "branch": way, "problem": one}
                if isinstance(one, str)
                else work.instability_row(one)
                for part, way, one in pieces
            ]
            rows.append(row)
        print(as_json({"simulated": recorded.simulated, "channels": rows}))
    else:
        print(described(recorded, str(log)))
        for whole, pieces in zip(results, parts, strict=True):
            print("\n" + _instability_text(whole, pieces))
    save_figure(lambda plots: plots.identification.draw_instability(results), plot, quiet=json)
    wished = all(
        whole.bound.drift_shows and work.plausible(work.of_sensor(whole.rest, whole.allan_fit)) for whole in results
    )
    return DONE if wished else NOT_AS_WISHED


def _write_noise(
    log: Path, form: Literal["kalibr", "ins"], output: Path, force: bool, unit: str | None, lag: str, source: Recording
) -> int:
    writable(output, force)
    recorded = load(log, source, unit=unit)
    use_float64()
    from gradcal_jax.identify.instability import noise_file, noise_of_imu
    from gradcal_jax.tables.writing import write_whole

    channels = noise_of_imu(recorded, 0 if unit is None else unit, lag=_lag(lag))
    name = f"{log.name}{' (simulated)' * recorded.simulated}"
    write_whole(output, noise_file(channels, form, 1.0 / recorded.sample_interval_s, name))
    print(f"wrote {output}")
    return DONE


def _width(bins: str | None) -> float | None:
    width = None if bins is None else quantity(bins, "temperature difference", "--bins")
    if width is not None and width <= 0.0:
        raise ValueError(f"--bins must be positive, not {bins}")
    return width


def _parts(
    rest: "RestRecord", ranges: int, width: float | None, branches: bool
) -> list[tuple[tuple[float, float] | None, str | None]]:
    """Ranges of temperature (None: all) and branches (None: both) besides the whole record."""
    from gradcal_jax.identify import instability as work

    divided = work.temperature_ranges(rest, ranges, width) if ranges > 1 or width else []
    ways = ("heating", "cooling")
    return [*product([None, *divided], ways)] if branches else [(part, None) for part in divided]


def _lag(text: str) -> float | str:
    return text if text in ("auto", "fit", "none") else quantity(text, "time", "--lag")


def _instability_text(result: "Instability", parts: "list[_Piece]") -> str:
    from gradcal_jax.identify import instability as work
    from gradcal_jax.units import DEG_PER_H, DEG_PER_SQRT_H

    bound = result.bound
    times = bound.integration_time_s
    lines = [
        strong(f"axis {result.rest.axis}, IMU {result.rest.unit}"),
        f"angle random walk {result.rest.walk_of_sensor(bound.angle_random_walk) * DEG_PER_SQRT_H:.4g} deg/sqrt(h); "
        f"drift over {times[0]:.4g} to {times[-1]:.4g} s, relative to the mean of the "
        f"{bound.averaging_time_s:g} s before",
    ]
    if bound.drift_shows:
        lines.append(
            f"bounded by {bound.drift_std * DEG_PER_H:.4g} deg/h with a correlation time of "
            f"{bound.correlation_time_s:.4g} s, at {bound.margin:g} sigma"
        )
        if result.scatter is not None:
            lines.append(
                f"uncertainty, from the scatter between blocks of the record: {result.scatter[0] * DEG_PER_H:.2g} "
                f"deg/h (1σ), correlation time within a factor of {math.exp(result.scatter[1]):.2g}"
            )
        first, last = result.deciding_span_s
        lines.append(
            f"the drift over {bound.deciding_time_s:.4g} s from {first:.6g} s to {last:.6g} s "
            f'of the record determines the bound; to leave this part out: --without "{first:.6g} s..{last:.6g} s"'
        )
    if (markov := result.markov) is not None:
        sigma_error, tau_error = (float(markov.covariance[k, k]) ** 0.5 for k in (1, 2))
        lines.append(
            f"a single Markov process, fitted by maximum likelihood: {markov.sigma * DEG_PER_H:.4g} deg/h (1σ: "
            f"{100.0 * sigma_error:.2g} %) with a correlation time of {markov.tau:.4g} s (1σ: a factor of "
            f"{math.exp(tau_error):.2g})"
        )
    if result.rest.thermal is not None:
        thermal = result.rest.thermal
        lines.append(
            f"B(T) of degree {len(thermal.coefficients) - 1} subtracted"
            + (f", with a lag of {thermal.lag_time_s:.0f} s" if thermal.lag_time_s > 0 else "")
            + f"; {thermal.residual_rms * DEG_PER_H:.4g} deg/h rms remain, including noise"
        )
    lines += [
        f"note: {message}"
        for message in (
            *result.rest.messages,
            *work.allan_notes(work.of_sensor(result.rest, result.allan_fit)),
            *bound.messages,
        )
    ]
    if parts:
        rows = [("temperature", "drift (1σ)", "correlation time")]
        for part, way, one in parts:
            where = ", ".join(
                [*(() if part is None else [f"{part[0]:.1f} … {part[1]:.1f} °C"]), *(() if way is None else [way])]
            )
            if isinstance(one, str):
                rows.append((where, one, ""))
            elif one.bound.drift_shows:
                std = one.bound.drift_std * DEG_PER_H
                rows.append((where, f"{std:.4g} deg/h", f"{one.bound.correlation_time_s:.4g} s"))
            else:
                rows.append(
                    (where, f"none visible; up to {one.bound.hidden_drift_std * DEG_PER_H:.3g} deg/h may be hidden", "")
                )
        lines.append(columns(rows))
    return "\n".join([*lines, "", result.drift_block()])


def allan(
    log: Annotated[Path | None, Parameter(help=LOG_HELP)] = None,
    /,
    *,
    axis: Axes = (),
    unit: Unit = None,
    terms: Annotated[str, Parameter(name="--terms")] = "Q,N,B,K",
    confidence: float = 0.683,
    delta: str = "10 s",
    bias_degree: BiasDegree = None,
    lag: Lag = "auto",
    bins: str | None = None,
    branches: Flag = False,
    without: Without = (),
    source: Recording = WHOLE,
    form: Annotated[Literal["kalibr", "ins"] | None, Parameter(name="--format")] = None,
    output: OptionalOutput = None,
    force: ForceOutput = False,
    plan: Annotated[bool, Parameter(negative="")] = False,
    noise: str | None = None,
    bias_instability: str | None = None,
    rate_random_walk: str | None = None,
    drift: str | None = None,
    duration: str | None = None,
    error: str | None = None,
    rate: str = "100 Hz",
    json: JsonNumbers = False,
    plot: Plot = None,
) -> int:
    """Print the noise coefficients of a record at rest, fitted to its overlapping Allan deviation.

    The exit status is 1 if the angle random walk is larger than that of any gyro: check the units. With --plan, before
    a recording is made: print the expected errors for a given duration of the record, or the duration that is necessary
    for a given error.

    Parameters
    ----------
    terms
        The terms of the fit: Q quantisation, N angle random walk, B bias instability, K rate random walk.
    confidence
        The confidence level of the interval about each point of the Allan deviation.
    delta
        For the Direct Bound in the figure: duration of the average that is subtracted first.
    form
        Write the noise of all gyros and accelerometers to the file --output, in the format of another program: kalibr's
        imu.yaml, or noise densities and bias instabilities for an INS.
    output
        The file that --format writes.
    plan
        Without a record: print the expected relative errors of N, B, K and of a drift's σ and τ, for a sensor with the
        noise that the options below state.
    noise
        Angle random walk, such as "0.1 deg/sqrt(h)".
    bias_instability
        Bias instability, such as "2 deg/h".
    rate_random_walk
        Rate random walk, such as "0.5 deg/h/sqrt(h)".
    drift
        Standard deviation and correlation time of a Markov process, such as "1 deg/h, 300 s".
    duration
        The duration of the record; by default several durations are compared.
    error
        The relative error that is allowed for each coefficient, such as "5 %": print how long the record must be for
        this error.
    rate
        Sample rate of the record.
    bins
        Also compute the results for each temperature range of this width, such as "2 K".
    branches
        Also compute the results of heating and of cooling separately, for the whole record and for each temperature
        range.
    plot
        Draw the Allan deviation, its fit and the curve of the Direct Bound into this file (.png, .svg, .pdf).
    """
    if plan:
        if log is not None:
            raise ValueError("--plan is used before a recording is made, and needs no record: leave LOG out")
        return plan_record(
            noise, bias_instability, rate_random_walk, drift, duration=duration, error=error, rate=rate, json=json
        )
    asked = {"--noise": noise, "--drift": drift, "--duration": duration, "--error": error}
    if used := [name for name, value in asked.items() if value is not None]:
        raise ValueError(f"{used[0]} has an effect only with --plan")
    if log is None:
        raise ValueError("LOG is missing: name the file of a record at rest, or plan a recording with --plan")
    if form is not None:
        if output is None:
            raise ValueError(f"--format {form} needs the file to write: --output imu.yaml")
        return _write_noise(log, form, output, force, unit, lag, source)
    if output is not None:
        raise ValueError("--output needs --format kalibr or --format ins")
    drawable(plot)
    delta_s, lag_s, width = quantity(delta, "time", "--delta"), _lag(lag), _width(bins)
    chosen = _terms(terms)
    left_out = [span(text, "--without") for text in without]
    recorded = load(log, source, unit=unit)
    use_float64()
    from gradcal_jax.identify import instability as work

    drawn, problems = [], list[str]()
    for name in work.axes_asked_for(recorded, axis):
        whole = work.at_rest(
            recorded, name, 0 if unit is None else unit, bias_degree=bias_degree, lag=lag_s, without=left_out
        )
        whole.walk_of_sensor(0.0)  # asks before anything is printed
        for part, way in [(None, None), *_parts(whole, 1, width, branches)]:
            try:
                rest = whole.within(part, way)
                deviation, fit = work.allan_of(rest, terms=chosen, confidence=confidence)
            except ValueError as problem:
                if part is None and way is None:
                    raise
                where = ("" if part is None else f"{part[0]:g} to {part[1]:g} °C ") + (way or "")
                problems.append(f"axis {name}, {where.strip()}: {problem}")
                continue
            drawn.append((rest, deviation, fit))
    if json:
        rows = [work.allan_row(*one) for one in drawn]
        print(as_json({"simulated": recorded.simulated, "channels": rows, "problems": problems}))
    else:
        print(described(recorded, str(log)))
        for rest, _, of_rows in drawn:
            fit = work.of_sensor(rest, of_rows)
            print("\n" + strong(f"axis {rest.axis}, IMU {rest.unit}" + (f", {rest.part}" if rest.part else "")))
            print(_allan_text(fit))
            for message in (*work.allan_notes(fit), *rest.messages):
                print(f"note: {message}")
        for problem in problems:
            print(f"note: {problem}")
    if plot is not None:
        bounds = []
        for rest, _, _ in drawn:
            try:
                bounds.append(work.instability(rest, averaging_time_s=delta_s))
            except ValueError as problem:
                bounds.append(None)
                if not json:
                    print(f"note: no Direct Bound of axis {rest.axis}: {problem}")
        save_figure(lambda plots: plots.identification.draw_allan_and_bound(drawn, bounds), plot, quiet=json)
    plausible = (work.plausible(work.of_sensor(rest, fit)) for rest, _, fit in drawn if not rest.part)
    return DONE if all(plausible) else NOT_AS_WISHED


_TERMS = {"q": "quantisation", "n": "angle_random_walk", "b": "bias_instability", "k": "rate_random_walk"}


def _terms(text: str) -> list[str]:
    letters = text.lower().replace(" ", "").split(",")
    if not set(letters) <= set(_TERMS):
        raise ValueError(f"--terms {text!r}: expected some of Q, N, B, K, separated by commas")
    return [_TERMS[letter] for letter in letters]


def _allan_text(fit: "AllanFit") -> str:
    from gradcal_jax.units import ARCSEC, DEG_PER_H, DEG_PER_SQRT_H

    rows = [("coefficient", "value", "standard error", "unit", "")]
    for name, coefficient, factor, unit in (
        ("Q quantisation", fit.quantisation, ARCSEC, "arcsec"),
        ("N angle random walk", fit.angle_random_walk, DEG_PER_SQRT_H, "deg/sqrt(h)"),
        ("B bias instability", fit.bias_instability, DEG_PER_H, "deg/h"),
        ("K rate random walk", fit.rate_random_walk, DEG_PER_H * 60.0, "deg/h/sqrt(h)"),
    ):
        shows = "" if coefficient.shows else "not significant"
        rows.append(
            (name, f"{coefficient.value * factor:.4g}", f"{coefficient.standard_error * factor:.2g}", unit, shows)
        )
    return columns(rows, indent="", right=(1, 2))


_DURATIONS_S = (600.0, 3600.0, 4 * 3600.0, 12 * 3600.0, 48 * 3600.0)


def plan_record(
    noise: str | None,
    instability: str | None,
    rate_walk: str | None,
    drift: str | None,
    *,
    duration: str | None,
    error: str | None,
    rate: str,
    json: bool,
) -> int:
    """Print the expected relative errors of N, B, K, σ and τ, or the length of the record for a given `error`."""
    if noise is None:
        raise ValueError('--plan needs the sensor\'s angle random walk, such as --noise "0.1 deg/sqrt(h)"')
    walk = quantity(noise, "angle random walk", "--noise")
    flicker = 0.0 if instability is None else quantity(instability, "angular rate", "--bias-instability")
    slow = 0.0 if rate_walk is None else quantity(rate_walk, "rate random walk", "--rate-random-walk")
    sigma, tau = _drift(drift)
    interval = 1.0 / quantity(rate, "frequency", "--rate")
    wanted = None if error is None else quantity(error, "scale factor", "--error")
    if not (walk > 0.0 and flicker >= 0.0 and slow >= 0.0 and interval > 0.0 and (wanted is None or wanted > 0.0)):
        raise ValueError("--noise, --rate and --error must be positive; the other figures must not be negative")
    use_float64()
    from gradcal_jax.identify.markov import coefficient_errors, drift_errors, shortest_record

    # (Kept: the search for the shortest record asks of each coefficient for mostly the same durations.)
    @cache
    def of_noise(duration_s: float) -> dict[str, float]:
        """Relative errors of N, B and K; infinite: the record is too short."""
        try:
            fit = coefficient_errors(duration_s, interval, walk, flicker, slow)
        except ValueError:
            fit = (math.inf,) * 3
        return {name: value for name, value in zip("NBK", fit, strict=True) if not math.isnan(value)}

    @cache
    def of_drift(duration_s: float) -> dict[str, float]:
        """Relative errors of σ and τ of a drift; infinite: the record is too short."""
        if not sigma > 0.0:
            return {}
        try:
            _, *both = drift_errors(duration_s, walk, sigma, tau)
        except ValueError:
            both = (math.inf,) * 2
        return dict(zip("στ", both, strict=True))

    if wanted is not None:
        lengths = {
            name: shortest_record(lambda t, of=of, n=name: of(t)[n], wanted, 100.0 * interval)
            for of in (of_noise, of_drift)
            for name in of(100.0 * interval)
        }
        if json:
            rows = {name: length if math.isfinite(length) else None for name, length in lengths.items()}
            print(as_json({"error": wanted, "duration_s": rows}))
        else:
            shown = [("coefficient", f"duration for a relative error of {wanted:.3g}")]
            shown += [(n, _length(t) if math.isfinite(t) else "more than 14 days") for n, t in lengths.items()]
            print(columns(shown, indent=""))
        return DONE if all(map(math.isfinite, lengths.values())) else NOT_AS_WISHED
    durations = _DURATIONS_S if duration is None else (quantity(duration, "time", "--duration"),)
    if not min(durations) > 0.0:
        raise ValueError("--duration must be positive")
    table = {t: of_noise(t) | of_drift(t) for t in durations}
    if json:
        rows = [
            {"duration_s": t, "relative_error": {n: e if math.isfinite(e) else None for n, e in row.items()}}
            for t, row in table.items()
        ]
        print(as_json({"records": rows}))
        return DONE
    names = list(next(iter(table.values())))
    shown = [("record", *names)]
    for t, row in table.items():
        shown.append((_length(t), *(_percent(e) for e in row.values())))
    print("expected relative errors (1σ) from a record at rest without gaps, at a constant temperature")
    print(columns(shown, indent="", right=tuple(range(1, len(names) + 1))))
    return DONE


def _length(seconds: float) -> str:
    """A length of a record to two digits, in the unit that people would use."""
    for size, word in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 1.5 * size:
            return f"{float(f'{seconds / size:.2g}'):g} {word}"
    return f"{float(f'{seconds:.2g}'):g} s"


def _percent(error: float) -> str:
    # (A standard deviation that is no smaller than the value says that nothing is known of it.)
    return f"{100.0 * error:.2g} %" if error < 1.0 else "not known"


def _drift(text: str | None) -> tuple[float, float]:
    if text is None:
        return 0.0, math.inf
    parts = text.split(",")
    if len(parts) != 2:
        raise ValueError(f'--drift {text!r}: expected σ and τ, such as "1 deg/h, 300 s"')
    sigma = quantity(parts[0].strip(), "angular rate", "--drift")
    tau = quantity(parts[1].strip(), "time", "--drift")
    if not (sigma > 0.0 and tau > 0.0):
        raise ValueError(f"--drift {text!r}: both must be positive")
    return sigma, tau
