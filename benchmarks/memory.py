"""The three tanks with eight effects that remember, estimated with the five faults: ours, and the same by hand.

Both pumps act late and follow with a lag, h1 is read late, and all sensors follow with a lag; the pumps switch every
120 s. Each simulator maps theta (L, 13) to readings (L, 101, 3) at t = 0, 10, ..., 1000 s, in steps of 10 s.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.physics import START, make_rates, make_step, widths
from benchmarks.simulators import NAMES, Simulator, load_jax
from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import placements_for
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.experiment import Experiment, lay_out

STEP, STEPS, MAX_FLOW = 10.0, 100, 90e-6
LATE = ("Q1.pump_delay.delay", "Q2.pump_delay.delay", "h1.sensor_delay.delay")
LAGGING = tuple(f"{place}_lag.time_constant" for place in ("Q1.pump", "Q2.pump", "h1.sensor", "h2.sensor", "h3.sensor"))
ORDER = NAMES + LATE + LAGGING
REACH = 8  # samples that the longest delay may reach back, and one more


def flows() -> np.ndarray:
    """What is asked of the two pumps from sample to sample, (101, 2) m^3/s."""
    k = np.arange(STEPS + 1)
    return np.stack([30e-6 + 40e-6 * (k // 12 % 2), 60e-6 - 35e-6 * ((k + 6) // 12 % 2)], axis=1)


def plant() -> tuple[TankNetwork, ParameterSpace]:
    description = load_plant("three_tank")
    tanks = tuple(replace(t, start_level=h) for t, h in zip(description.tanks, START, strict=True))
    network = TankNetwork(replace(description, tanks=tanks), placements_for(ORDER))
    return network, ParameterSpace(network.constants[n] for n in ORDER)


def experiment() -> Experiment:
    time = STEP * torch.arange(STEPS + 1, dtype=torch.float64)
    nothing = torch.zeros(STEPS + 1, 3, dtype=torch.float64)
    units = ("m^3/s", "m^3/s"), ("m", "m", "m")
    recording = Recording(time, torch.from_numpy(flows()), nothing, ("Q1", "Q2"), ("h1", "h2", "h3"), *units)
    return lay_out(recording, ("Q1", "Q2"), STEP)


def random_theta(count: int, seed: int = 0) -> np.ndarray:
    """Faults anywhere in their box, delays and time constants up to 60 s."""
    _, space = plant()
    share = torch.rand(count, len(space), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    high = torch.where(space.high() > 1.0, space.high().clamp(max=60.0), space.high().clamp(max=1.0))
    return (space.low() + (high - space.low()) * share).numpy()


def fdi() -> Simulator:
    engine = CompiledEngine(*plant(), experiment())
    engine.prepare()
    return lambda theta: engine.readings(torch.from_numpy(theta)).numpy()


def tables() -> tuple[np.ndarray, np.ndarray]:
    """The integral of the flows up to each sample (m^3), and the flow from there on, (100, 2) each."""
    held = flows()[:-1]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(held * STEP, axis=0)[:-1]]), held


def make_parts(exp: Callable, maximum: Callable, minimum: Callable, index: Callable, jit: Callable) -> tuple[Any, ...]:
    """delayed(integral, flow, t, delay): mean flow; follow, read: lags of a pump's command and of a reading."""

    @jit
    def up_to(integral, flow, t):  # type: ignore[no-untyped-def]
        k = index(maximum(t, 0.0) / STEP - 1e-10)
        return integral[k] + flow[k] * (t - STEP * k)

    @jit
    def delayed(integral, flow, t, delay):  # type: ignore[no-untyped-def]
        return (up_to(integral, flow, t + STEP - delay) - up_to(integral, flow, t - delay)) / STEP

    @jit
    def follow(u, v, tau):  # type: ignore[no-untyped-def]
        decay = exp(-1.0 / maximum(tau / STEP, 1e-3))
        mean = u + (v - u) * (tau / STEP) * (1.0 - decay)
        return minimum(maximum(mean, 0.0), MAX_FLOW), u + (v - u) * decay

    @jit
    def read(y, seen, before, tau):  # type: ignore[no-untyped-def]
        decay = exp(-1.0 / maximum(tau / STEP, 1e-3))
        return y - (y - before) * (tau / STEP) * (1.0 - decay) + (seen - before) * decay

    return delayed, follow, read


def numba_blocks() -> Simulator:
    """Blocks of trajectories side by side."""
    run, settings = _numba_blocks(), (*(np.ascontiguousarray(t.T) for t in tables()), *widths(STEP))
    return lambda theta: run(theta, np.empty((len(theta), STEPS + 1, 3)), *settings)


@lru_cache(maxsize=1)
def _numba_blocks(width: int = 64):  # type: ignore[no-untyped-def]
    import numba

    jit = numba.njit(fastmath=True, error_model="numpy", inline="always")
    maximum, minimum = jit(lambda a, b: a if a > b else b), jit(lambda a, b: a if a < b else b)
    rates = make_rates(math.sqrt, maximum, jit(lambda c, a, b: a if c else b), jit)
    one = make_step(rates, jit)
    delayed, follow, read = make_parts(math.exp, maximum, minimum, jit(lambda x: max(int(x), 0)), jit)

    @numba.njit(fastmath=True, error_model="numpy")
    def advance(h, v, t, integral, flow, k, wp, wo):  # type: ignore[no-untyped-def]
        for i in range(width):
            u1 = delayed(integral[0], flow[0], k * STEP, t[5, i])
            u2 = delayed(integral[1], flow[1], k * STEP, t[6, i])
            q1, v[0, i] = follow(u1, u1 if k == 0 else v[0, i], t[8, i])
            q2, v[1, i] = follow(u2, u2 if k == 0 else v[1, i], t[9, i])
            h[0, i], h[1, i], h[2, i] = one(
                h[0, i], h[1, i], h[2, i], t[0, i], t[1, i], t[2, i], t[3, i], t[4, i], wp, wo, STEP, q1, q2
            )

    @numba.njit(fastmath=True, error_model="numpy")
    def look(h, past, memory, t, k):  # type: ignore[no-untyped-def]
        for i in range(width):
            past[k, i] = h[0, i]
            ago = max(k - t[7, i] / STEP, 0.0)
            left = min(int(ago), max(k - 1, 0))
            late = past[left, i] + (ago - left) * (past[min(left + 1, k), i] - past[left, i])
            for c, y in ((0, late), (1, h[1, i]), (2, h[2, i])):
                seen = y if k == 0 else read(y, memory[c, i], memory[3 + c, i], t[10 + c, i])
                memory[c, i], memory[3 + c, i] = seen, y

    @numba.njit(fastmath=True, error_model="numpy")
    def run(theta, out, integral, flow, wp, wo):  # type: ignore[no-untyped-def]
        t, h, v = np.empty((13, width)), np.empty((3, width)), np.empty((2, width))
        past, memory = np.empty((STEPS + 1, width)), np.empty((6, width))
        for first in range(0, len(theta), width):
            for i in range(width):
                h[0, i], h[1, i], h[2, i] = START
                for c in range(13):
                    t[c, i] = theta[min(first + i, len(theta) - 1), c]
            for k in range(STEPS + 1):
                if k > 0:
                    advance(h, v, t, integral, flow, k - 1, wp, wo)
                look(h, past, memory, t, k)
                for i in range(min(width, len(theta) - first)):
                    for c in range(3):
                        out[first + i, k, c] = memory[c, i]
        return out

    return run


def make_array_step(exp, sqrt, at_least, at_most, where, whole, take, push):  # type: ignore[no-untyped-def]
    """One step of arrays of lanes, of JAX or torch: k, state, columns of theta and tables -> state with its readings.

    state: levels (3), pump lags (2), readings (3), what they follow (3), and the last REACH levels of T1.
    """
    rates, (wp, wo) = make_rates(sqrt, at_least, where), widths(STEP)
    one = make_step(rates)
    delayed, follow, read = make_parts(exp, at_least, at_most, whole, lambda f: f)

    def step(k, state, t, integral, flow):  # type: ignore[no-untyped-def]
        h, v, seen, before, past = state[:3], state[3:5], state[5:8], state[8:11], state[11]
        u = [delayed(integral[i], flow[i], k * STEP, t[5 + i]) for i in (0, 1)]
        q, v = zip(*(follow(u[i], where(k == 0, u[i], v[i]), t[8 + i]) for i in (0, 1)), strict=True)
        h = one(*h, *t[:5], wp, wo, STEP, *q)
        past = push(past, h[0])
        ago = at_most(t[7] / STEP, k + 1.0)
        right = at_most(whole(ago), REACH - 2)
        near, far = take(past, REACH - 1 - right), take(past, REACH - 2 - right)
        y = near + (ago - right) * (far - near), h[1], h[2]
        seen = tuple(read(y[c], seen[c], before[c], t[10 + c]) for c in range(3))
        return (*h, *v, *seen, *y, past)

    return step


def jax_scan() -> Simulator:
    """lax.scan over a step on arrays of lanes."""
    jax, jnp = load_jax()
    step = make_array_step(
        jnp.exp, jnp.sqrt, jnp.maximum, jnp.minimum, jnp.where, lambda x: jnp.maximum(x, 0).astype(jnp.int32),
        lambda past, i: jnp.take_along_axis(past, i[None], axis=0)[0],
        lambda past, h: jnp.concatenate([past[1:], h[None]]),
    )  # fmt: skip
    integral, flow = (jnp.asarray(x.T) for x in tables())

    @jax.jit
    def run(theta):  # type: ignore[no-untyped-def]
        t = tuple(theta.T)
        h = tuple(jnp.full(len(theta), x) for x in START)
        nothing = (jnp.zeros(len(theta)),) * 2

        def advance(state, k):  # type: ignore[no-untyped-def]
            state = step(k, state, t, integral, flow)
            return state, jnp.stack(state[5:8])

        start = (*h, *nothing, *h, *h, jnp.tile(h[0], (REACH, 1)))
        _, rows = jax.lax.scan(advance, start, jnp.arange(STEPS))
        return jnp.concatenate([jnp.stack(h)[None], rows]).transpose(2, 0, 1)

    return lambda theta: np.asarray(run(theta))


def torch_compiled_step() -> Simulator:
    """One step of plain torch under torch.compile."""
    step = torch.compile(
        make_array_step(
            torch.exp, torch.sqrt, lambda x, low: torch.clamp(x, min=low), lambda x, high: torch.clamp(x, max=high),
            torch.where, lambda x: torch.clamp(x, min=0).to(torch.int64),
            lambda past, i: torch.gather(past, 0, i[None])[0], lambda past, h: torch.cat([past[1:], h[None]]),
        ),
        dynamic=True,
    )  # fmt: skip
    integral, flow = (torch.from_numpy(np.ascontiguousarray(x.T)) for x in tables())

    def run(theta: np.ndarray) -> np.ndarray:
        t: tuple[Tensor, ...] = tuple(c.contiguous() for c in torch.from_numpy(theta).unbind(1))
        h = tuple(torch.full_like(t[0], x) for x in START)
        nothing = (torch.zeros_like(t[0]),) * 2
        state: tuple[Tensor, ...] = (*h, *nothing, *h, *h, h[0].repeat(REACH, 1))
        rows = [torch.stack(h, dim=-1)]
        for k in range(STEPS):
            state = step(torch.tensor(float(k), dtype=torch.float64), state, t, integral, flow)
            rows.append(torch.stack(state[5:8], dim=-1))
        return torch.stack(rows, dim=1).numpy()

    return run


SIMULATORS: dict[str, Callable[[], Simulator]] = {
    "fdi_torch, compiled": fdi,
    "torch.compile of one step": torch_compiled_step,
    "numba, by hand, blocks of lanes": numba_blocks,
    "JAX lax.scan, by hand": jax_scan,
}
