"""The rows of a whole unit by every method that can say them: the information and its gradient in Φ and durations.

celerite2 cannot: its states decay one by one, and an integral that begins anew or an encoder's error that is passed on
is no such decay. dynamax could, and would hold N covariances of 144 × 144 for its result alone, 5 GB.
"""

import time

import numpy as np

from peers.imu_problem import STATES, UnitProblem, exact_information, initial, make_problem, steps_of

_open: dict = {}


def unit(asked: dict) -> dict:
    """Open (compile), time or check one method; processor time, s."""
    if asked["what"] == "open":
        problem = make_problem(asked["count"], asked["parameters"])
        _open["problem"], _open["tasks"] = problem, _METHODS[asked["of"]](problem)
        return {"version": _open["tasks"]["version"], "share": _open["tasks"].get("share", 1.0)}
    if asked["what"] == "time":
        return {"seconds": [_timed(_open["tasks"][asked["task"]]) for _ in range(asked["repeats"])]}
    found = {"information": np.asarray(_open["tasks"]["forward"]()).tolist(), "slope": None}
    if "gradient" in _open["tasks"]:
        by_columns, by_durations = (np.asarray(g) for g in _open["tasks"]["gradient"]()[1])
        of_columns, of_durations = direction(_open["problem"])
        found["slope"] = float(np.sum(by_columns * of_columns) + np.sum(by_durations * of_durations))
    return found


def hand2(asked: dict) -> dict:
    """The plan `hand2` compiled as a whole, from every number of motion and model to the logarithms of all standard
    deviations: processor time (s), forward and with the gradient.
    """
    from pathlib import Path

    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from gradcal_jax.information import SquareRootInformation, imu_system, whitened_factor
    from gradcal_jax.model.build import build_imu
    from gradcal_jax.motion import body_nodes
    from gradcal_jax.spec.spec import read_spec

    jax.config.update("jax_enable_x64", True)
    built = build_imu(read_spec(Path(__file__).resolve().parents[2] / "imu" / "hand2.toml"))
    wanted = jax.tree.map(lambda x: isinstance(x, np.ndarray) and x.dtype == float, (built.motion, built.model))
    # Whether a rate drives a process is structure.
    gains = lambda t: [g for c in t[1].channels for g in (c.processes.rate_gain, c.processes.bias_gain)]  # noqa: E731
    wanted = eqx.tree_at(gains, wanted, replace_fn=lambda _: False)
    numbers, rest = eqx.partition((built.motion, built.model), wanted)
    numbers, reported = jax.tree.map(jnp.asarray, numbers), jnp.asarray(built.model.to_reported)

    def value(numbers):
        motion, model = eqx.combine(numbers, rest)
        system = imu_system(motion, model, body_nodes(motion, built.points))
        info = SquareRootInformation(*whitened_factor(*system, jnp.asarray(model.prior_rows()))[:3])
        return jnp.sum(jnp.log(info.deviations(reported)))

    found: dict = {}
    for task, made in {"forward": jax.jit(value), "gradient": jax.jit(jax.value_and_grad(value))}.items():
        jax.block_until_ready(made(numbers))
        every = [_timed(lambda f=made: jax.block_until_ready(f(numbers))) for _ in range(asked["repeats"])]
        found[task] = every
    return found


def direction(problem: UnitProblem) -> tuple[np.ndarray, np.ndarray]:
    """A random direction in Φ and in the durations."""
    rng = np.random.default_rng(1)
    return 0.05 * problem.columns * rng.standard_normal(problem.columns.shape), rng.standard_normal(
        problem.durations.shape
    )


def exact_slope(problem: UnitProblem) -> float:
    """Derivative of `log det G` in that direction, by central differences in extended precision."""
    from peers.problem import exact_log_det

    of_columns, of_durations = direction(problem)
    step = np.longdouble(1e-4)

    def value(s):
        return exact_log_det(
            exact_information(problem, problem.durations + s * of_durations, problem.columns + s * of_columns)
        )

    return float((8 * (value(step) - value(-step)) - (value(2 * step) - value(-2 * step))) / (12 * step))


def _timed(task) -> float:
    begin = time.process_time()
    task()
    return time.process_time() - begin


def _by_jax(problem: UnitProblem, information) -> dict:
    import jax

    from peers.jax_tasks import jax_tasks

    return jax_tasks(problem, information) | {"version": f"jax {jax.__version__}"}


def _ours(problem: UnitProblem) -> dict:
    import jax.numpy as jnp

    from gradcal_jax.information import NoiseSteps, gram

    fresh, count = np.flatnonzero(problem.first), len(problem.segment)

    def information(columns, durations):
        transition, noise = steps_of(problem, durations, jnp)
        steps = NoiseSteps(
            jnp.broadcast_to(jnp.eye(STATES), (count, STATES, STATES)).at[fresh].set(transition),
            jnp.zeros((count, STATES, STATES)).at[fresh].set(noise),
            jnp.asarray(problem.observation),
            jnp.zeros(count),
            jnp.ones(count, bool),
            jnp.asarray(initial()),
        )
        return gram(steps, columns) + jnp.diag(jnp.asarray(problem.prior))

    return _by_jax(problem, information)


def _floor(problem: UnitProblem) -> dict:
    import jax.numpy as jnp

    return _by_jax(problem, lambda columns, _: columns.T @ columns + jnp.diag(jnp.asarray(problem.prior)))


def _tinygp(problem: UnitProblem) -> dict:
    """Element (i, j), i > j, is `H_i F_i … F_{j+1} P_j H_jᵀ`, P_j the state's own covariance at row j."""
    import jax
    import jax.numpy as jnp
    import tinygp
    from tinygp.solvers.quasisep.core import DiagQSM, StrictLowerTriQSM, SymmQSM

    def information(columns, durations):
        transition, noise = steps_of(problem, durations, jnp)

        def step(covariance, now):
            covariance = now[0] @ covariance @ now[0].T + now[1]
            return covariance, covariance

        _, of_segment = jax.lax.scan(step, jnp.asarray(initial()), (transition, noise))
        observed, at = jnp.asarray(problem.observation), problem.segment
        still = jnp.broadcast_to(jnp.eye(STATES), (len(at), STATES, STATES))
        through = still.at[np.flatnonzero(problem.first)].set(transition)
        seen = (of_segment[at] @ observed[:, :, None])[..., 0]
        lower = StrictLowerTriQSM(p=(observed[:, None] @ through)[:, 0], q=seen, a=through)
        factor = SymmQSM(diag=DiagQSM(jnp.sum(observed * seen, axis=1)), lower=lower).cholesky()
        white = factor.solve(columns)
        return white.T @ white + jnp.diag(jnp.asarray(problem.prior))

    return _by_jax(problem, information) | {"version": f"tinygp {tinygp.__version__}"}


def _filterpy(problem: UnitProblem) -> dict:
    """The parameters in the state; of a hundredth of the rows, where there are many."""
    import importlib.metadata

    from filterpy.kalman import KalmanFilter

    count, p = problem.columns.shape
    rows = count if count < 3000 else count // 100
    transition, noise = steps_of(problem, problem.durations, np)

    def forward():
        kalman = KalmanFilter(dim_x=STATES + p, dim_z=1)
        kalman.P, kalman.R = np.zeros((STATES + p,) * 2), np.zeros((1, 1))
        kalman.P[:STATES, :STATES] = initial()
        kalman.P[STATES:, STATES:] = np.diag(1.0 / problem.prior)
        whole, added, reading = np.eye(STATES + p), np.zeros((STATES + p,) * 2), np.zeros(1)
        for k in range(rows):
            if problem.first[k]:
                whole[:STATES, :STATES] = transition[problem.segment[k]]
                added[:STATES, :STATES] = noise[problem.segment[k]]
                kalman.predict(F=whole, Q=added)
            kalman.update(reading, H=np.concatenate([problem.observation[k], problem.columns[k]])[None])
        return np.linalg.inv(kalman.P[STATES:, STATES:])

    version = f"filterpy {importlib.metadata.version('filterpy')}"
    return {"forward": forward, "version": version, "share": rows / count}


_METHODS = {"ours": _ours, "floor": _floor, "tinygp": _tinygp, "filterpy": _filterpy}
