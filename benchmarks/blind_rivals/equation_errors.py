"""Equation errors of a recording in integral form, and the columns that effects add, for the regression baselines.

Over each block of `BLOCK` samples, and for each tank whose level and neighbours are measured:
    y = A (h_end - h_begin) - sum over samples of F(h, u) dt      (m^3)
with F the net inflow that the nominal plant expects. Levels are means of a few readings, and so are commands. An effect
of small size s adds s times its column; that of a sensor whose reading is off by s e(t) is the derivative of y with
respect to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fdi_torch.blind.deviation import Array, Index
from fdi_torch.blind.places import Cause
from fdi_torch.blind.simulator import conductance
from fdi_torch.plant.description import OUTSIDE, PlantDescription
from fdi_torch.recording import Recording

BLOCK, SMOOTHED = 30, 9
_STEP = 1e-4  # m, of derivatives with respect to readings
_SMALLEST_HEAD = 1e-4  # m


@dataclass(frozen=True)
class EquationErrors:
    """y (K, N): integrated balance error of each block and tank, NaN for tanks that cannot be balanced. nuisance:
    columns of the discharge coefficients. columns: of each effect at each location. local: by location, its variable
    (K,) and how a flow there enters the balances (N,).
    """

    y: Array
    nuisance: list[Array]
    columns: dict[Cause, Array]
    local: dict[str, tuple[Array, Array]]


def equation_errors(plant: PlantDescription, recording: Recording) -> EquationErrors:
    """Equation errors of an evenly sampled recording whose sensors read levels."""
    names = [t.name for t in plant.tanks]
    area, dt = np.array([t.area for t in plant.tanks]), recording.interval
    level = np.full((len(recording), len(names)), np.nan)
    for k, sensor in enumerate(plant.sensors):
        read = (recording.outputs[:, k].numpy() - sensor.offset) / sensor.gain
        level[:, names.index(sensor.tank)] = _smooth(read)
    channels = list(recording.input_names)
    pumped = [
        np.clip(p.gain * recording.inputs[:, channels.index(p.channel)].numpy(), 0, p.max_flow) for p in plant.pumps
    ]
    ends = [
        (names.index(p.source), None if p.target == OUTSIDE else names.index(p.target), 0.0 if p.is_outlet else 1.0)
        for p in plant.pipes
    ]
    time = np.arange(len(recording)) / len(recording)
    fed = np.stack([_enters(len(names), names.index(p.target), None, -1.0) for p in plant.pumps])
    through = np.stack([_enters(len(names), source, target) for source, target, _ in ends])

    def heads(h: Array) -> list[Array]:
        wet = [np.maximum(h - p.elevation, 0.0) for p in plant.pipes]
        return [w[:, s] - (0.0 if t is None else joined * w[:, t]) for w, (s, t, joined) in zip(wet, ends, strict=True)]

    def flows(h: Array) -> list[Array]:
        pairs = zip(conductance(plant), heads(h), strict=True)
        return [_over_the_sample(k * np.sign(x) * np.sqrt(np.abs(x))) for k, x in pairs]

    def error(h: Array) -> Array:
        inflow = sum(_shared(q, b) for q, b in zip([*map(_smooth, pumped), *flows(h)], [*fed, *through], strict=True))
        return _changes(h) * area - _sums(np.asarray(inflow)) * dt

    def at(q: Array, balance: Array) -> Array:
        return _sums(_shared(q, balance)) * dt

    columns: dict[Cause, Array] = {}
    for pump, u, b in zip(plant.pumps, pumped, fed, strict=True):
        h = level[:, names.index(pump.target)]
        columns |= {(e, pump.name): at(_smooth(c), b) for e, c in _pump_columns(u, h)}
    for pipe, q, x, b in zip(plant.pipes, flows(level), heads(level), through, strict=True):
        columns |= {(e, pipe.name): at(c, b) for e, c in _pipe_columns(q, x, time, pipe.is_outlet)}
    for i, name in enumerate(names):
        inflow_at = _enters(len(names), i, None, -1.0)
        columns |= {(e, name): at(c, inflow_at) for e, c in _tank_columns(level[:, i], time)}
        columns["area_taper", name] = _shared(-_changes(0.5 * level[:, i] ** 2) * area[i], inflow_at)
        joined = {j for s, t, _ in ends for j in (s, t) if i in (s, t)}
        for j in set(range(i + 1, len(names))) - joined:
            x = level[:, i] - level[:, j]
            path = at(np.sign(x) * np.sqrt(np.abs(x)), _enters(len(names), i, j))
            columns["cross_flow", f"{name}-{names[j]}"] = path
    y = error(level)
    for sensor in plant.sensors:
        i = names.index(sensor.tank)
        for effect, e in _sensor_columns(level[:, i], time, dt):
            moved = level.copy()
            scale = _STEP / max(float(np.abs(e).max()), 1e-12)
            moved[:, i] += scale * e
            columns[effect, sensor.name] = (error(moved) - y) / scale
    local = {p.name: (_means(u), b) for p, u, b in zip(plant.pumps, pumped, fed, strict=True)}
    local |= {p.name: (_means(x), b) for p, x, b in zip(plant.pipes, heads(level), through, strict=True)}
    local |= {n: (_means(level[:, i]), _enters(len(names), i, None)) for i, n in enumerate(names)}
    nuisance = [at(q, b) for q, b in zip(flows(level), through, strict=True)]
    whole = {cause: c for cause, c in columns.items() if np.isfinite(c[:, np.isfinite(y).all(axis=0)]).all()}
    return EquationErrors(y, nuisance, whole, {p: v for p, v in local.items() if np.isfinite(v[0]).all()})


def _enters(count: int, source: int, target: int | None, sign: float = 1.0) -> Array:
    """(N,): -1 at the tank that a flow leaves, 1 at the tank that it enters."""
    out = np.zeros(count)
    out[source] = -sign
    if target is not None:
        out[target] = sign
    return out


def _smooth(x: Array) -> Array:
    """(T,): moving average over `SMOOTHED` samples."""
    padded = np.pad(x, SMOOTHED // 2, mode="edge")
    return np.convolve(padded, np.ones(SMOOTHED) / SMOOTHED, "valid")


def _over_the_sample(x: Array) -> Array:
    """(T,): mean of each value and the next one, for inputs held between samples."""
    return np.append(0.5 * (x[1:] + x[:-1]), x[-1])


def _shared(q: Array, balance: Array) -> Array:
    """(T, N): a flow in each tank's balance; 0 in tanks that it does not enter, even if it is unknown."""
    return np.where(balance != 0, q[:, None] * balance, 0.0)


def _pump_columns(u: Array, h: Array) -> Iterator[tuple[str, Array]]:
    late = np.concatenate((np.full(10, u[0]), u[:-10]))
    kernel = np.exp(-np.arange(100) / 10.0)
    slow = np.convolve(np.concatenate((np.full(99, u[0]), u)), kernel / kernel.sum(), "valid")
    yield from (("pump_gain", u), ("pump_dead_zone", -(u > 0).astype(float)), ("pump_back_pressure", -u * h))
    yield from (("pump_lag", slow - u), ("pump_delay", late - u))
    yield "pump_saturation", -np.maximum(u - np.quantile(u, 0.7), 0.0)


def _pipe_columns(q: Array, x: Array, time: Array, outlet: bool) -> Iterator[tuple[str, Array]]:
    head = np.maximum(np.abs(x), _SMALLEST_HEAD)
    yield from (("plugging", -q * (time > 0.5)), ("laminar_flow", -q / np.sqrt(head)))
    yield from (("flow_exponent", q * np.log(head)), ("coefficient_drift", q * time))
    if outlet:
        yield "outlet_drop", q / head


def _tank_columns(h: Array, time: Array) -> Iterator[tuple[str, Array]]:
    yield from (("leak", -np.sqrt(np.maximum(h, 0.0))), ("unmetered_flow", ((time > 0.3) & (time < 0.6)).astype(float)))
    yield "overflow", -(np.maximum(h - np.quantile(h, 0.8), 0.0) ** 1.5)


def _sensor_columns(h: Array, time: Array, dt: float) -> Iterator[tuple[str, Array]]:
    yield from (("sensor_bias", np.ones_like(h)), ("sensor_gain", h), ("sensor_drift", time))
    yield from (("sensor_lag", -np.gradient(h, dt)), ("sensor_saturation", -np.maximum(h - np.quantile(h, 0.8), 0.0)))


def _blocks(count: int) -> Index:
    return np.arange(SMOOTHED, count - SMOOTHED, BLOCK, dtype=np.intp)


def _changes(x: Array) -> Array:
    return np.diff(x[_blocks(len(x))], axis=0)


def _sums(x: Array) -> Array:
    edges = _blocks(len(x))
    return np.add.reduceat(x, edges, axis=0)[:-1]


def _means(x: Array) -> Array:
    return _sums(x) / BLOCK
