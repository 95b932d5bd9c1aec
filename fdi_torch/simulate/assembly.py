"""Assembly of an expression graph into instructions on registers, for the interpreter of array_program.hpp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from fdi_torch.simulate.expression import Graph, Varies
from fdi_torch.simulate.operations import OPERATIONS

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
