"""The compiled engine: the plant's equations, traced and compiled into one C++ loop over blocks of lanes."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.build import load_library
from fdi_torch.simulate.cpp_source import emit
from fdi_torch.simulate.engine import Engine, Readings, expect_no_gradient, expect_problems
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.injection import Injection, expect_injectable
from fdi_torch.simulate.program import Program, build_program

_INTEGERS = (
    "lanes", "lanes_per_problem", "steps", "samples", "signal_samples", "mode", "threads", "gain_stride",
    "start_width", "out_bytes", "jacobian_bytes",
)  # fmt: skip
_ARRAYS = (
    "theta", "nominal", "lifted", "resolution", "starts", "spans", "means", "first_sample", "sample_times",
    "sample_intervals", "sample_shares", "signal_times", "signal_integral", "signal_slopes", "values", "weights",
    "centres", "gains", "start", "start_memory", "out", "jacobian",
)  # fmt: skip
_STEP_CONTROL = ("tolerance", "slope_tolerance", "shortest")
_MODES = {"levels": 0, "readings": 1, "moments": 2, "linearise": 3, "gram": 4, "observe": 5}
_REALS = {torch.float64: "double", torch.float32: "float"}
VALUE_LANES, TANGENT_LANES = 32, 16
# Steps of plants with up to this many states are unrolled, which is faster but takes longer to compile.
MOST_UNROLLED = 6
# -O3 takes a third longer to compile, and the loops run no faster: their vectors are written out.
LEVEL = "-O2"


class _Python(ctypes.Structure):
    """`struct Python` of kernel.hpp."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("release", "take", "signals")]


class _Job(ctypes.Structure):
    """`struct Job` of kernel.hpp."""

    _fields_ = [(n, ctypes.c_int64) for n in _INTEGERS]
    _fields_ += [(n, ctypes.c_double) for n in _STEP_CONTROL] + [(n, ctypes.c_void_p) for n in _ARRAYS]
    _fields_ += [("python", ctypes.POINTER(_Python))]


_API = ("PyEval_SaveThread", "PyEval_RestoreThread", "PyErr_CheckSignals")
_PYTHON = _Python(*(ctypes.cast(getattr(ctypes.pythonapi, name), ctypes.c_void_p) for name in _API))
_RUN = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)  # called with Python's global lock, which the loop releases


class CompiledEngine(Engine):
    """Readings of many parameter vectors at once, by the same fixed-step RK4 as the reference engine.

    Each variant (values or sensitivities; float64 or float32, as theta) is compiled at its first use and cached on the
    machine. Runs on as many threads as torch is set to. Raises BuildError without a compiler, and passes on an
    exception that a signal handler raises while a loop runs.
    """

    name, own_steps = "compiled", True

    def __init__(self, network: TankNetwork, space: ParameterSpace, experiment: Experiment, why: str = "") -> None:
        super().__init__(network, space, experiment, why)
        shares = experiment.sample_share
        inner = bool(((shares > 0) & (shares < 1)).any())
        self._form = experiment.step_control is not None, inner
        self._tables: dict[torch.dtype, dict[str, Tensor]] = {}

    def _simulate(self, mode: str, theta: Tensor) -> tuple[Tensor, Tensor | None]:
        out = self._empty(theta, len(self.network.description.tanks) if mode == "levels" else self._sensors)
        jacobian = self._empty(theta, self._sensors, len(self.space)) if mode == "linearise" else None
        self._run(mode, theta, out, jacobian)
        return out, jacobian

    def moments(self, theta: Float[Tensor, "*problems N P"], data: Readings) -> Float[Tensor, "*problems N C 3"]:
        expect_no_gradient(self, theta, "moments")
        out = theta.new_empty(*theta.shape[:-1], self._sensors, 3)
        self._run("moments", theta, out, data=data)
        return out

    def gram(self, theta: Float[Tensor, "*problems N P"], data: Readings) -> Float[Tensor, "*problems N C W W"]:
        expect_no_gradient(self, theta, "gram")
        width = len(self.space) + 3
        out = theta.new_empty(*theta.shape[:-1], self._sensors, width, width)
        self._run("gram", theta, out, data=data)
        return out

    def observe(
        self, theta: Float[Tensor, "*batch P"], data: Readings, injection: Injection
    ) -> Float[Tensor, "*batch S columns"]:
        expect_no_gradient(self, theta, "observe")
        memory = self.network.command_memory + self.network.reading_memory
        out = self._empty(theta, self.network.order + memory + self._sensors)
        expect_injectable(self.experiment, injection, memory)
        self._run("observe", theta, out, data=data, injection=injection)
        return out

    def prepare(self, tangent: bool = False, dtype: torch.dtype = torch.float64) -> None:
        """Compile before the first use."""
        _kernel(self.network, self.space.names, tangent, *self._form, _REALS[dtype])

    @property
    def _sensors(self) -> int:
        return len(self.network.description.sensors)

    def _empty(self, theta: Tensor, *width: int) -> Tensor:
        shape = (*theta.shape[:-1], len(self.experiment.sample_times), *width)
        lanes, samples = theta.shape[:-1].numel(), len(self.experiment.sample_times)
        what = f"{lanes:.3g} simulations of {samples:.3g} samples"
        expect_room(float(torch.Size(shape).numel()), what, "ask for fewer at once")
        return theta.new_empty(shape)

    def _run(
        self,
        mode: str,
        theta: Tensor,
        out: Tensor,
        jacobian: Tensor | None = None,
        data: Readings | None = None,
        injection: Injection | None = None,
    ) -> None:
        lanes = self._lanes(theta)
        tangent = mode in ("linearise", "gram")
        run, lifted = _kernel(self.network, self.space.names, tangent, *self._form, _REALS[theta.dtype])
        arrays = self._experiment(theta)
        arrays |= {"theta": lanes, "out": out, "jacobian": jacobian, "lifted": lifted.to(theta)}
        per_problem = max(len(lanes), 1)
        if data is not None:
            expect_problems(theta, data)
            arrays |= self._data(theta, data)
            if data.values.dim() > 2:
                per_problem = theta.shape[-2]
        if injection is not None:
            arrays |= injection.tables(theta)
        if len(lanes) == 0:
            return
        sizes = {
            "lanes": len(lanes),
            "lanes_per_problem": per_problem,
            "steps": len(self.experiment.nodes) - 1,
            "samples": len(self.experiment.sample_times),
            "signal_samples": len(self.experiment.signal.time),
            "mode": _MODES[mode],
            "threads": torch.get_num_threads(),
            "gain_stride": 0 if injection is None else injection.stride,
            "start_width": 0 if injection is None else injection.start.shape[-1],
            "out_bytes": out.nbytes,
            "jacobian_bytes": 0 if jacobian is None else jacobian.nbytes,
        }
        pointers = {name: None if a is None else a.data_ptr() for name, a in arrays.items()}
        step_control = self.experiment.step_control
        control = {} if step_control is None else {name: getattr(step_control, name) for name in _STEP_CONTROL}
        run(ctypes.byref(_Job(**sizes, **control, **pointers, python=ctypes.pointer(_PYTHON))))

    def _lanes(self, theta: Tensor) -> Tensor:
        if theta.dtype not in _REALS or theta.device.type != "cpu":
            raise ValueError(
                f"expected theta in float64 or float32 on the CPU, got {theta.dtype} on {theta.device}; the compiled "
                "engine computes there only, so move theta with .to('cpu'), or choose engine='traced' in set_up"
            )
        return theta.detach().reshape(theta.shape[:-1].numel(), len(self.space)).contiguous()

    def _experiment(self, like: Tensor) -> dict[str, Tensor | None]:
        if like.dtype not in self._tables:
            e = self.experiment
            times, steps = e.sample_times, torch.arange(len(e.nodes), device=e.nodes.device)
            tables = {
                "nominal": self.network.nominal,
                "resolution": e.resolution,
                "starts": e.nodes[:-1],
                "spans": e.steps,
                "means": e.inputs,
                "sample_times": times,
                "sample_intervals": e.sample_intervals,
                "sample_shares": e.sample_share,
                "signal_times": e.signal.time,
                "signal_integral": e.signal.integral,
                "signal_slopes": e.signal.slopes,
            }
            converted = {name: t.detach().to(like.dtype).contiguous() for name, t in tables.items()}
            converted["first_sample"] = torch.searchsorted(e.sample_step.contiguous(), steps).contiguous()
            self._tables[like.dtype] = converted
        return dict(self._tables[like.dtype])

    def _data(self, like: Tensor, data: Readings) -> dict[str, Tensor | None]:
        expected = (len(self.experiment.sample_times), self._sensors)
        if data.values.shape[-2:] != expected:
            raise ValueError(f"expected data of {expected} samples and sensors, got {tuple(data.values.shape[-2:])}")

        def table(t: Tensor) -> Tensor:
            return t.detach().to(like.dtype).contiguous()

        return {"values": table(data.known), "weights": table(data.weight), "centres": table(data.centre)}


@lru_cache(maxsize=128)
def _source(program: Program, inner: bool, real: str) -> str:
    # With adaptive steps the lanes of a block wait for the slowest one; one register's width keeps that short.
    lanes = "VECTOR" if program.adaptive else TANGENT_LANES if program.tangent else VALUE_LANES
    return emit(program, inner, real, lanes)


@lru_cache(maxsize=128)
def _kernel(
    network: TankNetwork, names: tuple[str, ...], tangent: bool, adaptive: bool, inner: bool, real: str
) -> tuple[Any, Tensor]:
    """The compiled function, and the numbers of the equations that are its arguments."""
    program = build_program(network, names, tangent, adaptive, network.order <= MOST_UNROLLED)
    run = _RUN(("run", load_library(_source(program, inner, real), "run", level=LEVEL)))
    return run, torch.tensor(program.graph.lifted or [0.0], dtype=torch.float64)
