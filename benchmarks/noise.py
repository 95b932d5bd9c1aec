"""CPU seconds of a study of 1000 noise draws (Table 3's fault, 30 dB, 1001 samples), and how good its estimates are.

All rows estimate the same readings. Only ours searches the whole box before it refines; the others descend from the
fault-free plant, which is what their users write.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import simulators
from benchmarks.physics import START, make_rates, make_step, widths
from fdi_torch.config.study_file import load_study
from fdi_torch.study.monte_carlo import make_trials, run_block
from fdi_torch.study.study_plan import Block, Plan

TRIALS, SCIPY_TRIALS, ITERATIONS, STEP = 200, 2, 25, 1.0
NOMINAL = np.array([0.0, 1.0, 0.0, 1.0, 1.0])
STUDY = Path(__file__).parents[1] / "configs/studies/table3_noise.yaml"
ASTRAY = 6.0  # bounds away from the truth: not this minimum, or no minimum at all
Estimator = Callable[[np.ndarray], np.ndarray]
Row = tuple[str, float, float, int, int]


def fdi_study(plan: Plan, block: Block) -> np.ndarray:
    """Search, refinement and standard errors of every trial, as `fdi study` does it."""
    return np.array([trial.numbers["free"] for trial in run_block(plan, block)])


def jax_descent() -> Estimator:
    """Levenberg-Marquardt on a hand-written RK4 in lax.scan, with forward-mode Jacobians, vmapped over trials."""
    jax, jnp = simulators.load_jax()
    one, (wp, wo) = make_step(make_rates(jnp.sqrt, jnp.maximum, jnp.where)), widths(STEP)

    def readings(theta):  # type: ignore[no-untyped-def]
        def step(h, _):  # type: ignore[no-untyped-def]
            h = one(*h, *theta, wp, wo, STEP)
            return h, jnp.stack(h)

        start = tuple(jnp.asarray(x) for x in START)
        return jnp.concatenate([jnp.stack(start)[None], jax.lax.scan(step, start, None, length=1000)[1]])

    def fit(values):  # type: ignore[no-untyped-def]
        def cost(theta):  # type: ignore[no-untyped-def]
            return jnp.sum((values - readings(theta)) ** 2)

        def iterate(_, state):  # type: ignore[no-untyped-def]
            theta, least, damping = state
            j = jax.jacfwd(readings)(theta).reshape(-1, 5)
            r = (values - readings(theta)).reshape(-1)
            normal = j.T @ j
            moved = theta + jnp.linalg.solve(normal + damping * jnp.diag(jnp.diag(normal)), j.T @ r)
            new = cost(moved)
            better = new < least
            pick = lambda a, b: jnp.where(better, a, b)  # noqa: E731
            return pick(moved, theta), pick(new, least), pick(damping * 0.2, damping * 10.0)

        theta = jnp.asarray(NOMINAL)
        return jax.lax.fori_loop(0, ITERATIONS, iterate, (theta, cost(theta), jnp.asarray(1e-3)))[0]

    run = jax.jit(jax.vmap(fit))
    return lambda values: np.asarray(run(values))


def scipy_descent() -> Estimator:
    """scipy.optimize.least_squares on LSODA, one trial after the other."""
    from scipy.integrate import odeint
    from scipy.optimize import least_squares

    rates, (wp, wo) = make_rates(lambda x: x**0.5, max, lambda c, a, b: a if c else b), widths(simulators.SHARP)
    times = np.arange(1001.0)

    def fit(values: np.ndarray) -> np.ndarray:
        def residual(theta: np.ndarray) -> np.ndarray:
            law = lambda h, _: rates(*h.tolist(), *theta.tolist(), wp, wo, simulators.SHARP)  # noqa: E731
            return (odeint(law, START, times, rtol=1e-8, atol=1e-8) - values).ravel()

        return least_squares(residual, NOMINAL, x_scale=0.1).x

    return lambda values: np.stack([fit(v) for v in values])


def measure(budget: float) -> list[Row]:
    """Name, CPU seconds for 1000 trials, RMSE over the Cramer-Rao bound (mean square over parameters), astray, trials.

    budget is not used: the number of trials is what makes the figures sure. RMSE is that of the trials not astray.
    """
    changes = ["study.snr_db=[30]", f"study.trials={TRIALS}", "study.estimators=[free]", f"study.block={TRIALS}"]
    plan = load_study(STUDY, changes).plan
    block = next(iter(plan.blocks()))
    trials = make_trials(plan, block)
    bound = np.array(run_block(plan, Block(0, 0, 1, 0))[0].numbers["bound"])
    truth, values = trials.truth[0].numpy(), trials.readings.numpy()
    runs = {"fdi_torch, search and refinement": (lambda v: fdi_study(plan, block), TRIALS)}
    for name, make, count in (
        ("JAX, by hand: descent from the fault-free plant", jax_descent, TRIALS),
        ("SciPy least_squares + LSODA, from the fault-free plant", scipy_descent, SCIPY_TRIALS),
    ):
        try:
            runs[name] = (make(), count)
        except ImportError:
            continue
    return [_row(name, run, values[:count], truth, bound) for name, (run, count) in runs.items()]


def _row(name: str, run: Estimator, values: np.ndarray, truth: np.ndarray, bound: np.ndarray) -> Row:
    if len(values) == TRIALS:
        run(values)  # compiles
    start = time.process_time()
    off = (run(values) - truth) / bound
    seconds = (time.process_time() - start) * 1000 / len(values)
    astray = ~(np.abs(off).max(axis=1) < ASTRAY)
    rmse = float(np.sqrt(np.mean(off[~astray] ** 2))) if not astray.all() else float("nan")
    return name, seconds, rmse, int(astray.sum()), len(values)


def table(rows: list[Row]) -> str:
    lines = [
        "| estimator | CPU seconds for 1000 trials | over ours | RMSE over the bound | astray |",
        "|---|---|---|---|---|",
    ]
    ours = rows[0][1]
    return "\n".join(
        lines + [f"| {n} | {s:,.0f} | {s / ours:.1f} | {e:.3f} | {bad} of {all_} |" for n, s, e, bad, all_ in rows]
    )
