"""Execution of an expression graph on arrays in time, without compilation for each plant.

A compiled interpreter carries out one instruction after the other on a block of steps. Every plant and every set of
effects uses the same interpreter, so that a new structure costs a trace instead of a compilation. Without a compiler,
and for tensors that it cannot take (gradients, float32, GPU), torch does the same on whole arrays.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fdi_torch.simulate.build import BuildError, load_library
from fdi_torch.simulate.cpp_source import primitives
from fdi_torch.simulate.expression import Graph, Place, Varies
from fdi_torch.simulate.operations import OPERATIONS
from fdi_torch.simulate.scan import is_plain

NUMBER = {name: i for i, name in enumerate(OPERATIONS)}
"""The number of each operation in an instruction."""


@dataclass
class _Registers:
    """Allocation of registers; one that is free is used again."""

    count: int = 0
    free: list[int] = field(default_factory=list)

    def take(self) -> int:
        if self.free:
            return self.free.pop()
        self.count += 1
        return self.count - 1


@dataclass(frozen=True)
class Instructions:
    """Instructions (N, 5), int32. order: of the outputs, as they are completed; stores and output_registers follow it.

    stores: number of varying instructions after which an output is complete.
    """

    registers: int
    scalar_registers: Tensor
    array_registers: Tensor
    fixed: Tensor
    varying: Tensor
    order: list[int]
    stores: Tensor
    output_registers: Tensor


def assemble(
    graph: Graph, nodes: Sequence[int], scalars: Sequence[int], arrays: Sequence[int], outputs: Sequence[int]
) -> Instructions:
    registers, places = _Registers(), {}
    for i in (*scalars, *arrays):
        places[i] = registers.take()
    computed = [i for i in nodes if graph.nodes[i].arguments]
    fixed = [i for i in computed if not graph.nodes[i].varies & Varies.STEP]
    varying = [i for i in computed if graph.nodes[i].varies & Varies.STEP]
    code: dict[str, list[tuple[int, ...]]] = {"fixed": [], "varying": []}

    def write(part: str, i: int, arguments: Sequence[int]) -> None:
        used = [*(places[a] for a in arguments), 0, 0]
        code[part].append((NUMBER[graph.nodes[i].operation], places[i], *used[:3]))

    for i in fixed:
        places[i] = registers.take()
        write("fixed", i, graph.nodes[i].arguments)
    last_use = {a: i for i in varying for a in graph.nodes[i].arguments}
    wanted: dict[int, list[int]] = {}
    for k, i in enumerate(outputs):
        wanted.setdefault(i, []).append(k)
    order, stores = [k for i, ks in wanted.items() if i not in set(varying) for k in ks], []
    stores += [0] * len(order)
    output_registers = [places[outputs[k]] for k in order]
    for done, i in enumerate(varying, 1):
        arguments = graph.nodes[i].arguments
        places[i] = registers.take()  # before its arguments are freed: an operation may not overwrite them
        write("varying", i, arguments)
        for k in wanted.get(i, ()):
            order.append(k)
            stores.append(done)
            output_registers.append(places[i])
        ended = {a for a in arguments if last_use[a] == i and a in places and graph.nodes[a].arguments}
        ended |= {i} if i not in last_use else set()
        registers.free += [places[a] for a in ended if graph.nodes[a].varies & Varies.STEP]
    return Instructions(
        registers.count,
        _int32([places[i] for i in scalars]),
        _int32([places[i] for i in arrays]),
        _int32(code["fixed"]),
        _int32(code["varying"]),
        order,
        torch.tensor(stores, dtype=torch.int64),
        _int32(output_registers),
    )


def _int32(values: Sequence[object]) -> Tensor:
    return torch.tensor(values, dtype=torch.int32)


BLOCK = 64
"""Steps in a block; a multiple of the numbers in a vector register."""
_SKELETON = Path(__file__).with_name("array_program.hpp")


class ArrayProgram:
    """The values of some nodes of a graph on arrays in time.

    Inputs that vary in time (`Varies.STEP`) are arrays (L or 1, K), all others are numbers (L or 1,) of a lane.
    outputs: the nodes to compute, in this order.
    """

    def __init__(self, graph: Graph, outputs: Sequence[int]) -> None:
        self._graph, self._nodes = graph, graph.reach(outputs)
        self._outputs = list(outputs)
        leaves = [i for i in self._nodes if not graph.nodes[i].arguments]
        self._arrays = [i for i in leaves if self._varies_in_time(i)]
        self._scalars = [i for i in leaves if not self._varies_in_time(i)]

    def run(self, inputs: Mapping[Place, Tensor], into: Sequence[Tensor], lanes: int, steps: int) -> None:
        """Write each output into its array (lanes, steps). inputs: by kind and index."""
        scalars, arrays = self._leaves(inputs, into[0], lanes, steps)
        library = _library() if all(is_plain(x) for x in (*scalars, *arrays, *into)) else None
        if library is None:
            return self._by_torch(scalars, arrays, into)
        program = self._program(scalars, arrays, into)
        library.run_on_arrays(ctypes.c_int64(lanes), ctypes.c_int64(steps), ctypes.byref(program))

    def solve_trajectories(
        self,
        inputs: Mapping[Place, Tensor],
        middle: Tensor,
        slopes: Sequence[tuple[int, int]],
        span: Tensor,
        path: Tensor,
        guessed: bool,
        tolerance: float,
        rounds: int,
    ) -> bool:
        """Solve trajectories path (L, n, K+1) from their first states by the implicit midpoint rule, in place.

        Some of the inputs are views of middle (n, K), which holds the states in the middle of each step. The program
        computes the n rates, and then their slopes by (rate, state). span (K,): lengths of the steps, s. guessed:
        whether the path is a guess of the trajectory. tolerance: largest correction, m, at which Newton's method has
        converged. rounds: maximum number of corrections of a block of steps. Returns False without a compiler.
        """
        (lanes, n, _), steps, library = path.shape, len(span), _library()
        if library is None:
            return False
        values = path.new_empty(n + len(slopes), steps)  # all lanes share them
        into = values.unsqueeze(1).expand(-1, lanes, -1).unbind()
        program = self._program(*self._leaves(inputs, path, lanes, steps), into)
        entries = torch.tensor(slopes, dtype=torch.int64).reshape(-1, 2).T.contiguous()
        addresses = [x.data_ptr() for x in (*entries, span, values, values[n:], middle, path)]
        trajectory = _Trajectory(lanes, n, steps, len(slopes), *addresses)
        library.solve_trajectories(
            ctypes.byref(program),
            ctypes.byref(trajectory),
            ctypes.c_int64(guessed),
            ctypes.c_double(tolerance),
            ctypes.c_int64(rounds),
        )
        return True

    def _leaves(
        self, inputs: Mapping[Place, Tensor], like: Tensor, lanes: int, steps: int
    ) -> tuple[list[Tensor], list[Tensor]]:
        scalars = [self._scalar(i, inputs, like) for i in self._scalars]
        return scalars, [inputs[self._place(i)].expand(lanes, steps) for i in self._arrays]

    def _place(self, i: int) -> Place:
        return self._graph.nodes[i].kind, self._graph.nodes[i].index

    def _varies_in_time(self, i: int) -> bool:
        return bool(self._graph.nodes[i].varies & Varies.STEP)

    def _scalar(self, i: int, inputs: Mapping[Place, Tensor], like: Tensor) -> Tensor:
        value = self._graph.nodes[i].value
        return inputs[self._place(i)] if value is None else like.new_full((1,), value)

    def _by_torch(self, scalars: Sequence[Tensor], arrays: Sequence[Tensor], into: Sequence[Tensor]) -> None:
        values = dict(zip(self._scalars, (s.unsqueeze(-1) for s in scalars), strict=True))
        values |= dict(zip(self._arrays, arrays, strict=True))
        for i in self._nodes:
            if i not in values:
                node = self._graph.nodes[i]
                values[i] = OPERATIONS[node.operation].torch(*(values[a] for a in node.arguments))
        for node_index, array in zip(self._outputs, into, strict=True):
            array.copy_(values[node_index])

    def _program(self, scalars: Sequence[Tensor], arrays: Sequence[Tensor], into: Sequence[Tensor]) -> _Program:
        code, (lanes, steps) = self._code, into[0].shape
        together = torch.cat([s.expand(lanes).unsqueeze(-1) for s in scalars], dim=-1) if scalars else into[0][:, :0]
        rows = [a if a.stride(-1) == 1 or steps == 1 else a.contiguous() for a in arrays]
        into = [into[k] for k in code.order]
        program = _Program(
            *(code.registers, len(scalars), len(rows), len(into), len(code.fixed), len(code.varying)),
            *(t.data_ptr() for t in (together, code.scalar_registers, code.array_registers, code.output_registers)),
            *(t.data_ptr() for t in (code.fixed, code.varying, code.stores)),
            *(*_rows(rows), *_rows(into)),
        )
        program.kept = together, rows  # their memory
        return program

    @cached_property
    def _code(self) -> Instructions:
        return assemble(self._graph, self._nodes, self._scalars, self._arrays, self._outputs)


def _fields(kind: Any, names: str) -> tuple[tuple[str, Any], ...]:
    return tuple((name, kind) for name in names.split())


class _Program(ctypes.Structure):
    """`Program` of array_program.hpp."""

    _fields_ = (
        *_fields(ctypes.c_int64, "registers scalars inputs outputs fixed varying"),
        *_fields(ctypes.c_void_p, "values scalar_registers input_registers output_registers"),
        *_fields(ctypes.c_void_p, "fixed_code varying_code stores"),
        *_fields(ctypes.POINTER(ctypes.c_void_p), "input_starts"),
        *_fields(ctypes.POINTER(ctypes.c_int64), "input_strides"),
        *_fields(ctypes.POINTER(ctypes.c_void_p), "output_starts"),
        *_fields(ctypes.POINTER(ctypes.c_int64), "output_strides"),
    )
    kept: object


class _Trajectory(ctypes.Structure):
    """`Trajectory` of array_program.hpp."""

    _fields_ = (
        *_fields(ctypes.c_int64, "lanes n steps count"),
        *_fields(ctypes.c_void_p, "rows columns span rates slopes middle path"),
    )


def _rows(rows: Sequence[Tensor]) -> tuple[object, object]:
    """Pointers to rows (L, K) of contiguous steps, and their strides between lanes."""
    starts = (ctypes.c_void_p * len(rows))(*(r.data_ptr() for r in rows))
    return starts, (ctypes.c_int64 * len(rows))(*(r.stride(0) for r in rows))


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL | None:
    loops = _SKELETON.read_text(encoding="utf-8").replace("//@OPERATIONS@", "\n".join(_cases()))
    source = f"#define BLOCK {BLOCK}\n#define LANES BLOCK\n{primitives('double')}\n{loops}"
    try:
        return load_library(source, "run_on_arrays", "solve_trajectories")
    except BuildError:
        return None


def _cases() -> list[str]:
    """One case of the interpreter's switch for each operation; truth values are kept as 1 and 0."""
    truth = {"and": "abc", "or": "abc", "not": "abc", "where": "a"}
    cases = []
    for name, number in NUMBER.items():
        arguments = [f"DIFFERENT(AT({x}), real(0))" if x in truth.get(name, "") else f"AT({x})" for x in "abc"]
        expression = OPERATIONS[name].c.format(*arguments)
        result = f"WHERE({expression}, real(1), real(0))" if OPERATIONS[name].boolean else expression
        cases.append(f"case {number}: EACH_VECTOR AT(out) = wide({result}); break;")
    return cases
