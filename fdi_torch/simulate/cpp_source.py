"""The C++ source of a plant's simulation: the program's sections as functions over a block of lanes, in the loops of
kernel.hpp.

Numbers that do not vary are computed once, those that vary between lanes once per trajectory, those that vary in time
only once per step for all lanes; the rest is computed in loops over the vectors of a block, with the functions of
vector.hpp.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path

from fdi_torch.simulate.build import REGISTER
from fdi_torch.simulate.cpp_sections import SectionWriter
from fdi_torch.simulate.program import Program
from fdi_torch.simulate.step_control import (
    DIAGONAL,
    ERROR,
    LONGER,
    NEWTON_ROUNDING,
    NEWTON_ROUNDS,
    NEWTON_SHARE,
    SHORTER,
    STAGES,
)

_SKELETON, _PRIMITIVES = (Path(__file__).with_name(name) for name in ("kernel.hpp", "vector.hpp"))
# glibc has vector versions of these functions, which a compiler may use once they are declared.
_VECTORS = """#if defined(__GLIBC__) && defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
extern "C" {
#define VECTOR __attribute__((simd("notinbranch")))
VECTOR double exp(double); VECTOR double log(double); VECTOR double pow(double, double);
VECTOR double sin(double); VECTOR double cos(double);
VECTOR float expf(float); VECTOR float logf(float); VECTOR float powf(float, float);
VECTOR float sinf(float); VECTOR float cosf(float);
#undef VECTOR
}
#endif
"""


def emit(program: Program, inner_samples: bool, real: str, lanes: int | str) -> str:
    """The C++ source. real: 'double' or 'float'. inner_samples: whether samples lie within steps. lanes: per block."""
    writer = SectionWriter(program, inner_samples)
    sections = writer.sections()
    columns = program.columns
    defines = {
        "LANES": lanes,
        "TANGENT": int(program.tangent),
        "WITHIN": int(program.adaptive),
        "UNROLLED": int(program.unrolled),
        "INNER_SAMPLES": int(inner_samples),
        "COLUMNS": columns,
        "WIDTH": columns + 3,
        "PAIRS": (columns + 3) * (columns + 4) // 2,
        "ORDER": program.order,
        "TANKS": program.tanks,
        "SENSORS": program.sensors,
        "ACTUATORS": program.actuators,
        "CHANNELS": max(program.channels, default=-1) + 1,
        "COMMAND_MEMORY": program.command_memory,
        "READING_MEMORY": program.reading_memory,
        "LATE_ACTUATORS": len(program.late_actuators),
        "LATE_SENSORS": len(program.late_sensors),
        "LANE_CONSTANTS": len(writer.lane_constants),
        "UNIFORM_CONSTANTS": len(writer.uniform_constants),
        "ROWS": len(writer.rows),
    }
    head = [f"#define {name} {value}" for name, value in defines.items()]
    head += [
        _table("LATE_CHANNEL", [program.channels[i] for i in program.late_actuators]),
        _table("LATE_SENSOR", program.late_sensors),
        _table("SENSOR_TANK", program.sensor_tanks),
        *([] if program.unrolled else _law_tables(program)),
        *(_implicit_tables(program) if program.adaptive else []),
        primitives(real),
    ]
    skeleton = _SKELETON.read_text(encoding="utf-8").replace("//@SECTIONS@", sections)
    return "\n".join(head) + "\n" + skeleton


def primitives(real: str) -> str:
    """The elementary functions for 'double' or 'float'."""
    bits, suffix = (32, "##f") if real == "float" else (64, "")
    head = ["#include <cmath>", _VECTORS, f"typedef {real} real;"]
    head += [f"#define REAL_BITS {bits}", f"#define LIBRARY(name) name{suffix}"]
    return "\n".join([*head, *(header.read_text(encoding="utf-8") for header in (REGISTER, _PRIMITIVES))])


def _law_tables(program: Program) -> list[str]:
    """The pattern of the rates' slopes by the levels."""
    return [
        f"#define SLOPES_BY_LEVEL {len(program.pattern)}",
        _table("SLOPE_ROW", [row for row, _ in program.pattern]),
        _table("SLOPE_COLUMN", [column for _, column in program.pattern]),
    ]


def _implicit_tables(program: Program) -> list[str]:
    """The coefficients of `step_control.py` and the operations of its elimination."""
    elimination = program.elimination
    ends = list(accumulate(len(updates) for updates in elimination.updates))
    beyond_ends = list(accumulate(len(row) for row in elimination.above))
    weights = [(*row, DIAGONAL) for row in STAGES]
    counts = {"STAGES": len(STAGES), "ENTRIES": len(elimination.entries), "ELIMINATIONS": len(elimination.rows)}
    counts |= {"NEWTON_ROUNDS": NEWTON_ROUNDS}
    return [
        *(f"#define {name} {value}" for name, value in counts.items()),
        f"#define DIAGONAL {DIAGONAL!r}",
        f"#define NEWTON_SHARE {NEWTON_SHARE!r}",
        f"#define NEWTON_ROUNDING {NEWTON_ROUNDING!r}",
        f"#define LONGER {LONGER!r}",
        f"#define SHORTER {SHORTER!r}",
        f"static const double STAGE[STAGES][STAGES + 1] = {{{', '.join(_braced(row) for row in weights)}}};",
        f"static const double STEP_ERROR[STAGES + 1] = {_braced(ERROR)};",
        _table("GIVEN", elimination.given),
        _table("ENTRY_ROW", [row for row, _ in elimination.entries]),
        _table("ENTRY_COLUMN", [column for _, column in elimination.entries]),
        _table("PIVOT", elimination.order),
        _table("MULTIPLIER", [entry for entry, _ in elimination.rows]),
        _table("MULTIPLIED", [pivot for _, pivot in elimination.rows]),
        _table("CHANGES_UNTIL", ends),
        _table("CHANGED", [changed for updates in elimination.updates for changed, _ in updates]),
        _table("CHANGED_BY", [beyond_ends for updates in elimination.updates for _, beyond_ends in updates]),
        _table("BEYOND_UNTIL", beyond_ends),
        _table("BEYOND", [entry for row in elimination.above for entry, _ in row]),
    ]


def _braced(values: Sequence[float]) -> str:
    return f"{{{', '.join(map(repr, values))}}}"


def _table(name: str, values: Sequence[int]) -> str:
    return f"static const int {name}[] = {{{', '.join(map(str, values or [0]))}}};"
