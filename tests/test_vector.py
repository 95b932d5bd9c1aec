"""The compiled engine's elementary functions against torch's, on each kind of processor."""

from __future__ import annotations

import ctypes

import pytest
import torch
from torch import Tensor

from fdi_torch.simulate.build import load_library
from fdi_torch.simulate.cpp_source import primitives
from fdi_torch.simulate.operations import OPERATIONS

PROCESSORS = {
    "this one": "",
    "without AVX-512": "#undef __AVX512F__\n",
    "without AVX": "#undef __AVX512F__\n#undef __AVX__\n",
}
LANES = 1024
ARGUMENTS = {"where": ("MORE(x, real(0))", "y", "z"), "not": ("MORE(x, real(0))",)}
ARGUMENTS |= {name: ("MORE(x, real(0))", "MORE(y, real(0))") for name in ("and", "or")}
BOUND = 0.5  # of a clamp at one side: always a number of the equations
# torch: the sign of NaN is 0; ours is NaN. Vector forms of sine and cosine do not reduce huge arguments.
TAME = {"sign", "sin", "cos"}


def source(before: str) -> str:
    functions = [
        f'extern "C" void {name}_of(real *a, real *b, real *c, real *out) {{ EACH_VECTOR {{\n'
        f"    const Vec x = AT(a), y = AT(b), z = AT(c); (void)y; (void)z;\n"
        f"    AT(out) = {'WHERE' if operation.boolean else ''}({operation.c.format(*ARGUMENTS.get(name, 'xyz'))}"
        f"{', real(1), real(0)' if operation.boolean else ''});\n}}}}"
        for name, operation in OPERATIONS.items()
    ]
    return "\n".join([before, f"#define LANES {LANES}", primitives("double"), *functions])


def numbers(seed: int, tame: bool) -> Tensor:
    """Of all magnitudes and both signs, equal ones, and what lies at the ends of the range."""
    generator = torch.Generator().manual_seed(seed)
    size = 3.0 if tame else 250.0
    x = 10.0 ** (size * (2.0 * torch.rand(LANES, generator=generator, dtype=torch.float64) - 1.0))
    x[::3] *= -1.0
    x[5::64] = 1.5
    x[6::64] = 0.0
    x[7::64] = -0.0
    if not tame:
        x[8::64] = torch.nan
        x[9::64] = torch.inf
        x[10::64] = -torch.inf
        x[11::64] = 1e-310
        x[12::64] = 1e308
    return x[torch.randperm(LANES, generator=generator)]


@pytest.mark.parametrize("processor", PROCESSORS)
def test_operations_are_those_of_torch(processor: str) -> None:
    library = load_library(source(PROCESSORS[processor]))
    for name, operation in OPERATIONS.items():
        x, y, z = (numbers(seed, name in TAME) for seed in range(3))
        if name == "inverse_fourth_root":
            x = torch.where((x > 1e-300) & (x < torch.inf), x, 1.0)
        if name in ("at_least", "at_most"):
            y = torch.full_like(y, BOUND)
        found = torch.empty(LANES, dtype=torch.float64)
        getattr(library, f"{name}_of")(*(ctypes.c_void_p(t.data_ptr()) for t in (x, y, z, found)))
        texts = ARGUMENTS.get(name, "xyz"[: operation.c.count("{")])
        wanted = operation.torch(*(t > 0 if "MORE" in text else t for t, text in zip((x, y, z), texts, strict=False)))
        wanted = wanted.double()
        same = (found == wanted) | (found.isnan() & wanted.isnan())
        close = (found - wanted).abs() <= 2e-15 * wanted.abs()
        wrong = ~(same | close)
        assert not bool(wrong.any()), (name, x[wrong][:4], found[wrong][:4], wanted[wrong][:4])


@pytest.mark.parametrize("processor", PROCESSORS)
def test_the_inverse_fourth_root_is_right_to_two_units_in_the_last_place(processor: str) -> None:
    library = load_library(source(PROCESSORS[processor]))
    x = numbers(7, False).abs()
    x = torch.where((x > 1e-300) & (x < torch.inf), x, 2.0)
    found = torch.empty_like(x)
    library.inverse_fourth_root_of(*(ctypes.c_void_p(t.data_ptr()) for t in (x, x, x, found)))
    # y s^(1/4) = 1 up to rounding: what is left over is small against the four factors' own rounding
    off = (found.square() * torch.sqrt(x) - 1.0).abs()
    assert float(off.max()) < 4 * 2.2e-16 + 2.2e-16


class Eager:
    """A graph whose nodes are numbers."""

    def __init__(self) -> None:
        self.numbers: list[Tensor] = []

    def literal(self, value: float) -> int:
        return self.add(torch.tensor(value, dtype=torch.float64))

    def add(self, number: Tensor) -> int:
        self.numbers.append(number)
        return len(self.numbers) - 1

    def apply(self, operation: str, *arguments: int) -> int:
        return self.add(OPERATIONS[operation].torch(*(self.numbers[a] for a in arguments)))

    def value(self, node: int) -> float | None:
        return None


@pytest.mark.parametrize("name", [n for n, operation in OPERATIONS.items() if operation.partials is not None])
@pytest.mark.parametrize("first", [1.3, 0.4])
def test_partial_derivatives_of_operations_are_those_of_torch(name: str, first: float) -> None:
    graph, count = Eager(), OPERATIONS[name].c.count("{")
    given = [torch.tensor(x, dtype=torch.float64) for x in (first, 0.7, 2.1)[:count]]
    if name == "where":
        given[0] = given[0] > 1.0
    nodes = tuple(graph.add(x) for x in given)
    partials = OPERATIONS[name].partials(graph, graph.apply(name, *nodes), nodes)  # type: ignore[misc]
    for k, partial in enumerate(partials):
        if partial is not None:
            function = lambda x, k=k: OPERATIONS[name].torch(*given[:k], x, *given[k + 1 :])  # noqa: E731
            slope = torch.autograd.functional.jacobian(function, given[k])
            assert float(graph.numbers[partial]) == pytest.approx(float(slope), rel=1e-12, abs=1e-15)
