"""Everyone who simulates the same work: theta (L, 5) -> levels (L, 11, 3) at t = 0, 100, ..., 1000 s.

Each is a function of the step's length (or of a tolerance) that returns such a function, or raises ImportError.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from benchmarks.physics import INFLOW, START, make_rates, make_step, widths
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import placements_for
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.experiment import Experiment, lay_out
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.step_control import StepControl

NAMES = ("T1.leak.size", "OUT2.net_outlet.size", "T3.leak.size", "P13.openness.size", "P32.openness.size")
SAMPLES, INTERVAL = 11, 100.0
SHARP = 0.02  # s; the steps for which the adaptive solvers' equations are as sharp
Simulator = Callable[[np.ndarray], np.ndarray]


def plant() -> tuple[TankNetwork, ParameterSpace]:
    description = load_plant("three_tank")
    tanks = tuple(replace(t, start_level=h) for t, h in zip(description.tanks, START, strict=True))
    network = TankNetwork(replace(description, tanks=tanks), placements_for(NAMES))
    return network, ParameterSpace(network.constants[n] for n in NAMES)


def experiment(step: float, tolerance: float | None = None) -> Experiment:
    time = INTERVAL * torch.arange(SAMPLES, dtype=torch.float64)
    flows = torch.full((SAMPLES, 2), INFLOW, dtype=torch.float64)
    nothing = torch.zeros(SAMPLES, 3, dtype=torch.float64)
    units = ("m^3/s", "m^3/s"), ("m", "m", "m")
    recording = Recording(time, flows, nothing, ("Q1", "Q2"), ("h1", "h2", "h3"), *units)
    own = None if tolerance is None else StepControl.for_tolerance(tolerance, plant()[0].description)
    return lay_out(recording, ("Q1", "Q2"), step, own)


def random_faults(count: int, seed: int = 0) -> np.ndarray:
    _, space = plant()
    share = torch.rand(count, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (space.low() + (space.high().clamp(max=1.0) - space.low()) * share).numpy()


def fdi(step: float, dtype: torch.dtype = torch.float64) -> Simulator:
    engine = CompiledEngine(*plant(), experiment(step))
    engine.prepare(dtype=dtype)
    return lambda theta: engine.levels(torch.from_numpy(theta).to(dtype)).numpy()


def fdi_own_steps(tolerance: float) -> Simulator:
    """Steps of each trajectory's own, for a tolerance in m."""
    engine = CompiledEngine(*plant(), experiment(INTERVAL, tolerance))
    return lambda theta: engine.levels(torch.from_numpy(theta)).numpy()


def fdi_float32(step: float) -> Simulator:
    return fdi(step, torch.float32)


def torchdiffeq(step: float) -> Simulator:
    engine = ReferenceEngine(*plant(), experiment(step))
    return lambda theta: engine.levels(torch.from_numpy(theta)).numpy()


def torch_compiled_step(step: float) -> Simulator:
    """One RK4 step of plain torch under torch.compile."""
    rates = make_rates(torch.sqrt, lambda x, low: torch.clamp(x, min=low), torch.where)
    one, (wp, wo) = make_step(rates), widths(step)

    @torch.compile(dynamic=True)
    def advance(h: tuple[Tensor, ...], theta: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return one(*h, *theta, wp, wo, step)

    def run(theta: np.ndarray) -> np.ndarray:
        columns = tuple(c.contiguous() for c in torch.from_numpy(theta).unbind(1))
        h = tuple(torch.full_like(columns[0], x) for x in START)
        rows = [torch.stack(h, dim=-1)]
        for _ in range(SAMPLES - 1):
            for _ in range(round(INTERVAL / step)):
                h = advance(h, columns)
            rows.append(torch.stack(h, dim=-1))
        return torch.stack(rows, dim=1).numpy()

    return run


def numba_lanes(step: float) -> Simulator:
    """One trajectory after the other."""
    return _numba_simulator(_numba_lanes(), step)


@lru_cache(maxsize=1)
def _numba_lanes():  # type: ignore[no-untyped-def]
    import numba

    one = _numba_step(numba)

    @numba.njit(fastmath=True, error_model="numpy")
    def run(theta, out, wp, wo, step, per_sample):  # type: ignore[no-untyped-def]
        for lane in range(len(theta)):
            t1, t2, t3, t4, t5 = theta[lane]
            h1, h2, h3 = START
            for s in range(SAMPLES):
                out[lane, s, 0], out[lane, s, 1], out[lane, s, 2] = h1, h2, h3
                if s < SAMPLES - 1:
                    for _ in range(per_sample):
                        h1, h2, h3 = one(h1, h2, h3, t1, t2, t3, t4, t5, wp, wo, step)
        return out

    return run


def numba_blocks(step: float) -> Simulator:
    """Blocks of trajectories side by side, so that the compiler can use vector instructions."""
    return _numba_simulator(_numba_blocks(), step)


@lru_cache(maxsize=1)
def _numba_blocks(width: int = 64):  # type: ignore[no-untyped-def]
    import numba

    one = _numba_step(numba)

    @numba.njit(fastmath=True, error_model="numpy")
    def advance(h1, h2, h3, t, wp, wo, step):  # type: ignore[no-untyped-def]
        for i in range(width):
            h1[i], h2[i], h3[i] = one(h1[i], h2[i], h3[i], t[0, i], t[1, i], t[2, i], t[3, i], t[4, i], wp, wo, step)

    @numba.njit(fastmath=True, error_model="numpy")
    def run(theta, out, wp, wo, step, per_sample):  # type: ignore[no-untyped-def]
        t, h1, h2, h3 = np.empty((5, width)), np.empty(width), np.empty(width), np.empty(width)
        for first in range(0, len(theta), width):
            for i in range(width):
                h1[i], h2[i], h3[i] = START
                for c in range(5):
                    t[c, i] = theta[min(first + i, len(theta) - 1), c]
            for s in range(SAMPLES):
                for i in range(min(width, len(theta) - first)):
                    out[first + i, s, 0], out[first + i, s, 1], out[first + i, s, 2] = h1[i], h2[i], h3[i]
                if s < SAMPLES - 1:
                    for _ in range(per_sample):
                        advance(h1, h2, h3, t, wp, wo, step)
        return out

    return run


def _numba_simulator(run, step: float) -> Simulator:  # type: ignore[no-untyped-def]
    settings = *widths(step), step, round(INTERVAL / step)
    return lambda theta: run(theta, np.empty((len(theta), SAMPLES, 3)), *settings)


def _numba_step(numba):  # type: ignore[no-untyped-def]
    jit = numba.njit(fastmath=True, error_model="numpy", inline="always")
    maximum = numba.njit(inline="always")(lambda a, b: a if a > b else b)
    where = numba.njit(inline="always")(lambda c, a, b: a if c else b)
    return make_step(make_rates(math.sqrt, maximum, where, jit), jit)


def jax_scan(step: float) -> Simulator:
    """lax.scan over a hand-written RK4 step on arrays of lanes."""
    run = jax_scan_traced(step)
    return lambda theta: np.asarray(run(theta))


def jax_scan_traced(step: float):  # type: ignore[no-untyped-def]
    """The same as a function of JAX arrays."""
    jax, jnp = load_jax()
    one, (wp, wo) = make_step(make_rates(jnp.sqrt, jnp.maximum, jnp.where)), widths(step)

    @jax.jit
    def run(theta):  # type: ignore[no-untyped-def]
        columns = tuple(theta.T)
        start = tuple(jnp.full(len(theta), x) for x in START)

        def sample(h, _):  # type: ignore[no-untyped-def]
            after = jax.lax.fori_loop(0, round(INTERVAL / step), lambda _, h: one(*h, *columns, wp, wo, step), h)
            return after, jnp.stack(after)

        _, rows = jax.lax.scan(sample, start, None, length=SAMPLES - 1)
        return jnp.concatenate([jnp.stack(start)[None], rows]).transpose(2, 0, 1)

    return run


def diffrax(tolerance: float) -> Simulator:
    """Tsit5 with its own step for each trajectory (vmap), on equations as sharp as for SHARP."""
    import diffrax as dx

    jax, jnp = load_jax()
    rates, (wp, wo) = make_rates(jnp.sqrt, jnp.maximum, jnp.where), widths(SHARP)
    times = jnp.arange(SAMPLES) * INTERVAL

    def one(theta):  # type: ignore[no-untyped-def]
        law = dx.ODETerm(lambda t, h, args: jnp.stack(rates(*h, *theta, wp, wo, SHARP)))
        control = dx.PIDController(rtol=tolerance, atol=tolerance)
        solved = dx.diffeqsolve(
            law, dx.Tsit5(), 0.0, times[-1], 1.0, jnp.array(START), saveat=dx.SaveAt(ts=times),
            stepsize_controller=control, max_steps=100000, throw=False,
        )  # fmt: skip
        return solved.ys

    run = jax.jit(jax.vmap(one))
    return lambda theta: np.asarray(run(theta))


def scipy_lsoda(tolerance: float, sharp: float = SHARP) -> Simulator:
    """scipy.integrate.odeint (LSODA), one trajectory after the other, with the same sharp equations in Python."""
    from scipy.integrate import odeint

    rates, (wp, wo) = make_rates(math.sqrt, max, lambda c, a, b: a if c else b), widths(sharp)
    times = np.arange(SAMPLES) * INTERVAL

    def one(theta: np.ndarray) -> np.ndarray:
        t = theta.tolist()
        law = lambda h, _: rates(*h.tolist(), *t, wp, wo, sharp)  # noqa: E731
        return odeint(law, START, times, rtol=tolerance, atol=tolerance, mxstep=20000)

    return lambda theta: np.stack([one(t) for t in theta])


def load_jax():  # type: ignore[no-untyped-def]
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    return jax, jnp


FIXED: dict[str, Callable[[float], Simulator]] = {
    "fdi_torch, compiled": fdi,
    "fdi_torch, compiled, float32": fdi_float32,
    "torchdiffeq rk4, eager": torchdiffeq,
    "torch.compile of one RK4 step": torch_compiled_step,
    "numba, by hand, lane after lane": numba_lanes,
    "numba, by hand, blocks of lanes": numba_blocks,
    "JAX lax.scan, by hand": jax_scan,
}
ADAPTIVE: dict[str, Callable[[float], Simulator]] = {
    "diffrax Tsit5, vmap": diffrax,
    "SciPy LSODA, one by one": scipy_lsoda,
}
