"""`gradcal allan --plan`: how long a record at rest must be, before it is recorded."""

import math

from gradcal_jax.cli.output import as_json
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.recordings import quantity
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED
from gradcal_jax.pages.plain_text import columns

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
        raise ValueError('--plan needs the sensor\'s angle random walk: --noise "0.1 deg/sqrt(h)"')
    walk = quantity(noise, "angle random walk", "--noise")
    flicker = 0.0 if instability is None else quantity(instability, "angular rate", "--bias-instability")
    slow = 0.0 if rate_walk is None else quantity(rate_walk, "rate random walk", "--rate-random-walk")
    sigma, tau = _drift(drift)
    interval = 1.0 / quantity(rate, "frequency", "--rate")
    wanted = None if error is None else quantity(error, "scale factor", "--error")
    if not (walk > 0.0 and flicker >= 0.0 and slow >= 0.0 and interval > 0.0 and (wanted is None or wanted > 0.0)):
        raise ValueError("--noise, --rate and --error must be positive, and the other figures zero or more")
    use_float64()
    from gradcal_jax.identify.record_length import coefficient_errors, drift_errors, shortest_record

    def errors(duration_s: float) -> dict[str, float]:
        """By name; infinite where the record is too short."""
        try:
            fit = coefficient_errors(duration_s, interval, walk, flicker, slow)
        except ValueError:
            fit = (math.inf,) * 3
        found = {name: value for name, value in zip("NBK", fit, strict=True) if not math.isnan(value)}
        if sigma > 0.0:
            try:
                _, found["σ"], found["τ"] = drift_errors(duration_s, walk, sigma, tau)
            except ValueError:
                found["σ"] = found["τ"] = math.inf
        return found

    if wanted is not None:
        names = list(errors(100.0 * interval))
        lengths = {name: shortest_record(lambda t, n=name: errors(t)[n], wanted, 100.0 * interval) for name in names}
        if json:
            rows = {name: length if math.isfinite(length) else None for name, length in lengths.items()}
            print(as_json({"error": wanted, "duration_s": rows}))
        else:
            shown = [("coefficient", f"record for {wanted:.3g} of it")]
            shown += [(n, _length(t) if math.isfinite(t) else "more than 14 days") for n, t in lengths.items()]
            print(columns(shown, indent=""))
        return DONE if all(map(math.isfinite, lengths.values())) else NOT_AS_WISHED
    durations = _DURATIONS_S if duration is None else (quantity(duration, "time", "--duration"),)
    if not min(durations) > 0.0:
        raise ValueError("--duration must be positive")
    table = {t: errors(t) for t in durations}
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
    print("expected relative errors (1σ) of a record at rest without gaps, at a constant temperature")
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
