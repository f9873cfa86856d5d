"""How quickly is a plan found? `gradcal optimise`'s search against what one would do today, each in its own process.

    python experiments/benchmarks/design.py [--minutes N] [--write FILE]

The problem: the headline case with one cycle of four turns repeated 17 times (about 20 free numbers). Peers:

* SciPy's SLSQP with finite differences over a FilterPy model: parameters in the state, reading by reading, one a second
  (that many readings of one standstill are worth a few is no part of such a model). It searches the same feasible
  coordinates from the same random starts, the best one first, the next where it stops; the regressors and noise
  matrices of each plan are given to it and not timed. It is stopped after some minutes.
* pydex: an optimal design on a grid of candidates (temperature × rate), as it minimises the mean variance of the
  prediction; it knows white noise alone, so its efforts are made into a plan of turns, which the full model judges.

`pip install "gradcal_jax[peers]"`; what is not installed is left out, with the reason.
"""

import argparse
import contextlib
import json
import os
import platform
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

HERE = Path(__file__).resolve().parent
SPEC = HERE.parent / "designs" / "headline.toml"
METHODS = ("ours", "slsqp", "pydex")
STARTS = 8
# The axis stands for 240 s while others turn, and for some seconds between its own turns.
READINGS = (8, 240)
# A search has arrived where it is within this share of the best value that ours found.
ARRIVED = 1.02


def problem():
    """The spec, the coordinates that are searched, and what is minimised over them (ppm)."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from gradcal_jax.design.turn_plan import measure, structures
    from gradcal_jax.spec.changes import changed
    from gradcal_jax.spec.spec import read_spec

    spec = changed(read_spec(SPEC), {"design.cycles": "alike", "design.moves": 4, "design.starts": STARTS})
    return spec, structures(spec, [])[0].coordinates, measure(spec)


def ours(seconds: float) -> dict:
    """Values of the best start against time: once with compiling, once after it."""
    del seconds
    import numpy as np

    from gradcal_jax.design import search

    _, coordinates, of = problem()
    objective = of.compiled(coordinates)
    histories = []
    for _ in range(2):
        begin = time.perf_counter()
        steps = search(objective, starts=STARTS, seed=0)
        histories.append([(time.perf_counter() - begin, p.best) for p in steps])
    start = np.random.default_rng(0).standard_normal((STARTS, coordinates.size))
    values = np.array([float(np.exp(objective(z).logs[0])) for z in start])
    order = np.argsort(np.where(np.isfinite(values), values, np.inf))
    return {
        "cold": histories[0],
        "history": histories[1],
        "starts": start[order].tolist(),
        "first_value": float(values[order[0]]),
        "size": coordinates.size,
    }


def slsqp(seconds: float) -> dict:
    """The same numbers by SciPy and FilterPy, from the same starts; only the filter's time counts."""
    import importlib.metadata

    import numpy as np
    from filterpy.kalman import KalmanFilter
    from scipy.optimize import minimize

    from gradcal_jax.design import coordinates as room
    from gradcal_jax.design import criterion
    from gradcal_jax.information import at_readings, noise_steps
    from gradcal_jax.information.imu_residual import box
    from gradcal_jax.model.build import assemble

    room._PIECES_A_REST, room._PIECES_OF_OTHERS = READINGS
    spec, coordinates, _ = problem()
    model = assemble(spec).model
    requirement = spec.requirement[0]
    grid = criterion(model, "scale_factor", *box(requirement, 41), requirement.statistic)
    rows = np.asarray(grid.rows)

    def given(z):
        line = coordinates.decode(z).trajectory()
        return noise_steps(line, model), at_readings(line, model)

    spent, history, best, readings = 0.0, [], np.inf, 0

    class Done(Exception):
        pass

    def residual(z):
        nonlocal spent, best, readings
        steps, columns = given(z)
        f_all, q_all, h_all, r_all, used, initial = (np.asarray(x) for x in steps)
        columns = np.asarray(columns)
        begin = time.perf_counter()
        n, p = h_all.shape[1], columns.shape[1]
        kalman = KalmanFilter(dim_x=n + p, dim_z=1)
        kalman.P = np.zeros((n + p, n + p))
        # A prior of 1000 ppm: no more than this filter's digits bear, and hundreds of times what is left.
        kalman.P[:n, :n], kalman.P[n:, n:] = initial, 1e-6 * np.eye(p)
        f, q, h, zero = np.eye(n + p), np.zeros((n + p, n + p)), np.zeros((1, n + p)), np.zeros(1)
        for k in range(len(h_all)):
            f[:n, :n], q[:n, :n] = f_all[k], q_all[k]
            kalman.predict(F=f, Q=q)
            if used[k]:
                h[0, :n], h[0, n:] = h_all[k], columns[k]
                kalman.update(zero, R=r_all[k], H=h)
        left = np.sqrt(np.einsum("gi,ij,gj->g", rows, kalman.P[n:, n:], rows, optimize=True))
        value = float(np.mean(np.max(left.reshape(grid.shape), axis=0))) * 1e6
        spent += time.perf_counter() - begin
        best, readings = min(best, value), int(np.sum(used))
        history.append((spent, best))
        if best <= asked["goal"] or spent > seconds:
            raise Done
        return np.log(value)

    asked, begun = json.load(sys.stdin), 0
    with contextlib.suppress(Done):
        for start in asked["starts"]:
            begun += 1
            minimize(residual, start, method="SLSQP", options={"maxiter": 1000, "ftol": 1e-9, "eps": 1e-4})
    version = importlib.metadata.version("filterpy")
    counts = {"evaluations": len(history), "readings": readings, "starts": begun, "first_value": history[0][1]}
    return {"history": history, **counts, "version": f"FilterPy {version}"}


def pydex(seconds: float) -> dict:
    """Efforts on a grid of temperatures and rates, made into turns at each visit and judged by the full model."""
    del seconds
    import importlib.metadata

    import jax

    jax.config.update("jax_enable_x64", True)
    import numpy as np
    from pydex.core.designer import Designer

    from gradcal_jax.information.prediction import predict
    from gradcal_jax.spec.changes import changed
    from gradcal_jax.spec.spec import read_spec

    spec = read_spec(SPEC)
    visits = 17
    temperature = np.linspace(-30.0, 70.0, visits)
    rates = np.linspace(-300.0, 300.0, 25)
    candidates = np.array([(t, w) for t in temperature for w in rates if w])

    def simulate(ti_controls, model_parameters):
        x, y = (ti_controls[0] - 20.0) / 50.0, ti_controls[1] / 300.0
        return np.array([sum(y * x**i * y**j * model_parameters[4 * i + j] for i in range(4) for j in range(4))])

    begin = time.perf_counter()
    designer = Designer()
    designer.simulate = simulate
    designer.ti_controls_candidates = candidates
    designer.model_parameters = np.ones(16)
    with contextlib.redirect_stdout(sys.stderr):
        designer.initialize(verbose=0)
        designer.design_experiment(designer.d_opt_criterion, package="cvxpy", optimizer="CLARABEL")
    took = time.perf_counter() - begin
    efforts = np.asarray(designer.efforts).reshape(visits, -1)
    axis = rates[rates != 0.0]
    moves: list[dict] = []
    for k in range(visits):
        # The four rates with the most effort share the visit, five rests of 5 s between and about them left out.
        top = np.sort(np.argsort(efforts[k])[-4:])
        share = np.maximum(efforts[k][top], 1e-9)
        seconds_of = np.maximum(np.round((120.0 - 25.0) * share / share.sum(), 1), 3.0)
        seconds_of[np.argmax(seconds_of)] += 95.0 - seconds_of.sum()
        for rate, time_ in zip(axis[top], seconds_of, strict=True):
            # Within what the acceleration of 300 deg/s² allows in so long a turn.
            size = min(abs(rate), 300.0 * (time_ / 2.0) / (np.pi / 2.0))
            moves.append({"rest": "5 s", "read_every": "1 s"})
            moves.append({"peak_rate": f"{np.copysign(size, rate):.6g} deg/s", "duration": f"{time_:.6g} s",
                          "shape": "cosine ramps"})  # fmt: skip
        moves.append({"rest": "5 s", "read_every": "1 s"})
        if k < visits - 1:
            moves.append({"rest": "240 s", "read_every": "1 s", "other_axes": True})
    plan = changed(spec, {"plan.cycle": {"moves": moves}})
    value = predict(plan).requirements[0].mean_of_max
    return {"history": [(took, value)], "version": f"pydex {importlib.metadata.version('pydex')}"}


def asked_of(method: str, seconds: float, given: str = "") -> dict:
    """A method's answer, from its own process."""
    done = subprocess.run(
        [sys.executable, __file__, "--method", method, "--seconds", str(seconds)],
        input=given,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        return {"absent": done.stderr.strip().splitlines()[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def when(history: list, value: float) -> float | None:
    """The first time at which the best value is no larger."""
    return next((t for t, v in history if v <= value), None)


def main() -> None:
    """Ask every method, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="after which SLSQP is stopped")
    parser.add_argument("--write", metavar="FILE", help="the table in Markdown, besides the screen")
    parser.add_argument("--method", choices=METHODS, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=0.0, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.method:
        print(json.dumps({"ours": ours, "slsqp": slsqp, "pydex": pydex}[asked.method](asked.seconds)))
        return
    mine = asked_of("ours", 0.0)
    if "absent" in mine:
        raise SystemExit(mine["absent"])
    goal = mine["history"][-1][1] * ARRIVED
    lines = [
        "# Benchmark of the search",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} cores, Python {platform.python_version()}; "
        "`python experiments/benchmarks/design.py`. "
        f"One cycle of four turns for all 17 visits, {mine['size']} free numbers; arrived: at {goal:.4g} ppm, "
        f"{100 * (ARRIVED - 1):.0f} % above the best that ours finds.",
        "",
        "| method | to the goal, s | best value, ppm | × ours |",
        "|---|---|---|---|",
    ]
    first, again = when(mine["cold"], goal), when(mine["history"], goal)
    assert again is not None
    lines.append(f"| ours, {STARTS} random starts, compiled before | {again:.3g} | {mine['history'][-1][1]:.4g} | 1 |")
    lines.append(f"| ours, compiling counted | {first:.3g} | {mine['cold'][-1][1]:.4g} | {first / again:.3g} |")
    peers = {
        "SLSQP with finite differences over FilterPy": asked_of(
            "slsqp", asked.minutes * 60, json.dumps({"starts": mine["starts"], "goal": goal})
        ),
        "pydex, D-optimal efforts on a grid": asked_of("pydex", 0.0),
    }
    notes = []
    for name, answer in peers.items():
        if "absent" in answer:
            notes.append(f"* {name}: left out, {answer['absent']}")
            continue
        reached, (end, best) = when(answer["history"], goal), answer["history"][-1]
        if reached is None:
            lines.append(f"| {name} | not in {end:.3g} | {best:.4g} | more than {end / again:.3g} |")
        else:
            lines.append(f"| {name} | {reached:.3g} | {best:.4g} | {reached / again:.3g} |")
        notes.append(
            f"* {answer['version']}"
            + (
                f": {answer['evaluations']} evaluations from {answer['starts']} starts, {answer['readings']} readings "
                f"each; the first start is worth {answer['first_value']:.5g} ppm there, "
                f"{mine['first_value']:.5g} ppm here"
                if "evaluations" in answer
                else ""
            )
            + "."
        )
    notes.append(
        "* pydex knows neither drift nor readings, nor that a turn takes time: its efforts (four rates a visit, rests "
        "of 5 s between) are judged by the full model; it has no other value to reach."
    )
    text = "\n".join([*lines, "", *notes]) + "\n"
    print(text)
    if asked.write:
        Path(asked.write).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
