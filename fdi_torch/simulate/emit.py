"""One C++ source for a plant: its program's sections as functions over a block of lanes, in the loops of kernel.hpp.

What varies with nothing is computed once, what varies between lanes once a trajectory, what varies in time only once
a step for all lanes; the rest stands in loops over the vectors of a block, in the functions of vector.hpp.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import accumulate
from pathlib import Path

from fdi_torch.simulate.expression import Varies
from fdi_torch.simulate.implicit import DIAGONAL, ERROR, NEWTON_ROUNDING, NEWTON_ROUNDS, NEWTON_SHARE, STAGES
from fdi_torch.simulate.own_steps import LONGER, SHORTER
from fdi_torch.simulate.program import Program
from fdi_torch.simulate.section import Output, Place, Row, Section
from fdi_torch.simulate.statements import Statements, stored
from fdi_torch.simulate.steady import steady_nodes

_SKELETON, _PRIMITIVES = (Path(__file__).with_name(name) for name in ("kernel.hpp", "vector.hpp"))
# glibc has vector forms of these, which a compiler may use once they are declared; the same lane always takes the same.
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
    """The source. real: 'double' or 'float'. inner_samples: whether samples lie within steps. lanes: in a block."""
    writer = _Writer(program, inner_samples)
    sections = writer.sections()
    columns = program.columns
    defines = {
        "LANES": lanes,
        "TANGENT": int(program.tangent),
        "WITHIN": int(program.within),
        "UNROLLED": int(program.unrolled),
        "INNER_SAMPLES": int(inner_samples),
        "COLUMNS": columns,
        "WIDTH": columns + 3,
        "PAIRS": (columns + 3) * (columns + 4) // 2,
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
        "STEADY": len(writer.steady),
        "SPANS": len(writer.spans),
    }
    head = [f"#define {name} {value}" for name, value in defines.items()]
    head += [
        _table("LATE_CHANNEL", [program.channels[i] for i in program.late_actuators]),
        _table("LATE_SENSOR", program.late_sensors),
        _table("SENSOR_TANK", program.sensor_tanks),
        *([] if program.unrolled else _law_tables(program)),
        *(_implicit_tables(program) if program.within else []),
        primitives(real),
    ]
    skeleton = _SKELETON.read_text(encoding="utf-8").replace("//@SECTIONS@", sections)
    return "\n".join(head) + "\n" + skeleton


def primitives(real: str) -> str:
    """The elementary functions, of 'double' or 'float'."""
    bits, suffix = (32, "##f") if real == "float" else (64, "")
    head = ["#include <cmath>", _VECTORS, f"typedef {real} real;"]
    head += [f"#define REAL_BITS {bits}", f"#define LIBRARY(name) name{suffix}"]
    return "\n".join([*head, _PRIMITIVES.read_text(encoding="utf-8")])


def _law_tables(program: Program) -> list[str]:
    """Which tank's rate has a slope by which level."""
    return [
        f"#define SLOPES_BY_LEVEL {len(program.pattern)}",
        _table("SLOPE_ROW", [row for row, _ in program.pattern]),
        _table("SLOPE_COLUMN", [column for _, column in program.pattern]),
    ]


def _implicit_tables(program: Program) -> list[str]:
    """The method of `implicit.py` and the work of its elimination."""
    work = program.elimination
    ends = list(accumulate(len(updates) for updates in work.updates))
    beyond = list(accumulate(len(row) for row in work.above))
    weights = [(*row, DIAGONAL) for row in STAGES]
    counts = {"STAGES": len(STAGES), "ENTRIES": len(work.entries), "ELIMINATIONS": len(work.rows)}
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
        _table("GIVEN", work.given),
        _table("ENTRY_ROW", [row for row, _ in work.entries]),
        _table("ENTRY_COLUMN", [column for _, column in work.entries]),
        _table("PIVOT", work.order),
        _table("MULTIPLIER", [entry for entry, _ in work.rows]),
        _table("MULTIPLIED", [pivot for _, pivot in work.rows]),
        _table("CHANGES_UNTIL", ends),
        _table("CHANGED", [changed for updates in work.updates for changed, _ in updates]),
        _table("CHANGED_BY", [beyond for updates in work.updates for _, beyond in updates]),
        _table("BEYOND_UNTIL", beyond),
        _table("BEYOND", [entry for row in work.above for entry, _ in row]),
    ]


def _braced(values: Sequence[float]) -> str:
    return f"{{{', '.join(map(repr, values))}}}"


def _table(name: str, values: Sequence[int]) -> str:
    return f"static const int {name}[] = {{{', '.join(map(str, values or [0]))}}};"


class _Writer:
    """Text of the sections; collects what is computed before the loop over time as it goes."""

    def __init__(self, program: Program, inner_samples: bool) -> None:
        self.program, self.graph, self.inner_samples = program, program.graph, inner_samples
        self.lane_constants: dict[int, int] = {}
        self.uniform_constants: dict[int, int] = {}
        self.rows: dict[Place, tuple[int, Row]] = {}
        self.steady_nodes = steady_nodes(program.graph)
        self.steady: dict[tuple[str, int], int] = {}
        self.spans: list[str] = []

    def sections(self) -> str:
        p = self.program
        texts = [self._section("settle_commands", [p.settle_commands])]
        if not p.unrolled:
            texts += [self._section("act", [p.act]), self._section("rates", [p.law])]
        else:
            texts.append(self._section("step", [p.act + p.stages[0], *p.stages[1:-1], p.stages[-1] + p.advance]))
        texts += [
            self._section("settle_readings", [p.settle_readings]),
            self._section("read", [p.read]),
        ]
        if self.inner_samples and p.unrolled:
            texts.append(self._section("end", [p.end]))
        texts.insert(0, self._prepare())
        return "\n".join(texts)

    def _section(self, name: str, parts: Sequence[Section]) -> str:
        """A function: numbers common to all lanes, a loop over vectors for each part, and the loop over directions."""
        outputs = [o for part in parts for o in part]
        body = Statements(self.graph, lambda i: self.constant(i, name), self.steady_nodes)
        ends = self._ends(parts)
        wanted = [self._wanted(part, end) for part, end in zip(parts, ends, strict=True)]
        body.keep(wanted, [slope for o in outputs for slope, _ in o.row.terms])
        lines = []
        for part, end, nodes in zip(parts, ends, wanted, strict=True):
            loop = self._loop(body, part, end, nodes)
            lines += ["    EACH_VECTOR {", *loop, "    }"] if loop else []
        head = [f"static inline void {name}(Block &b, const real *clock, const real *channel) {{"]
        head += [f"    alignas(64) Lane kept[{max(len(body.kept), 1)}];", *body.common]
        tail = ["    (void)kept; (void)clock; (void)channel;", "}"]
        lines += self._directions(outputs, body)
        return "\n".join([*head, *self._refresh(name), *lines, *tail])

    def _refresh(self, name: str) -> list[str]:
        """Computes what the section keeps from step to step, where the step has another length than the one before."""
        nodes = {i: k for (section, i), k in self.steady.items() if section == name}
        if not nodes:
            return []
        body = Statements(self.graph, self.constant)
        lanes = body.compute(list(nodes))
        lanes += [stored(f"b.steady[{k}]", body.number(i)) for i, k in nodes.items()]
        self.spans.append(name)
        span = f"b.span[{len(self.spans) - 1}]"
        head = [f"    if (clock[1] != {span}) {{", f"    {span} = clock[1];", *body.common]
        return [*head, "    EACH_VECTOR {", *lanes, "    }", "    }"]

    def _ends(self, parts: Sequence[Section]) -> list[list[Output]]:
        """What each part stores. What a step ends with waits for the last, when no other needs what it began with."""
        late = [o for part in parts for o in part if o.place[0].startswith("next_")]
        ends = [[o for o in part if o not in late and self._place(o.place)] for part in parts]
        ends[-1] += late
        return ends

    def _wanted(self, part: Section, ends: Sequence[Output]) -> list[int]:
        slopes = [s for o in part for s in (*(slope for slope, _ in o.row.terms), *o.row.theta.values())]
        return [*(o.node for o in (*part, *ends)), *slopes]

    def _loop(self, body: Statements, part: Section, ends: Sequence[Output], wanted: list[int]) -> list[str]:
        lines = body.compute(wanted)
        for o in part:
            for q, slope in o.row.theta.items():
                row = self.row_index(o)
                if self.graph.nodes[slope].varies & Varies.STEP:
                    lines.append(stored(f"b.row[{row}][{q}]", body.text(slope)))
        lines += [stored(place_text(o.place), body.text(o.node)) for o in ends]
        body.leave()
        return lines

    def _directions(self, section: Sequence[Output], body: Statements) -> list[str]:
        """The loop over directions: what each output changes by; stored last, when no old value is needed any more."""
        moving = [o for o in section if o.row]
        if not moving:
            return []
        here = {o.place for o in moving}
        lines = [f"        const Vec {d_name(o.place)} = {self._change(o, body, here)};" for o in moving]
        lines += [stored(d_place_text(o.place), d_name(o.place)) for o in moving if self._place(o.place)]
        return ["    for (int p = 0; p < COLUMNS; ++p) EACH_VECTOR {", *lines, "    }"]

    def _change(self, output: Output, body: Statements, here: Collection[Place]) -> str:
        """The row as a C expression. here: what is computed in the same loop; the rest is stored."""
        terms = [
            product(body.text(slope), d_name(place) if place in here else f"AT({d_place_text(place)})")
            for slope, place in output.row.terms
        ]
        if output.row.theta:
            terms.append(f"AT(b.row[{self.rows[output.place][0]}][p])")
        return " + ".join(terms)

    def _place(self, place: Place) -> str:
        """Where an output is stored; slopes are for samples within a step."""
        return "" if place[0] == "slope1" and not self.inner_samples else place_text(place)

    def constant(self, i: int, section: str = "") -> str:
        """Where `prepare` stores what does not vary in time, and a section what varies with its clock only."""
        node = self.graph.nodes[i]
        if section and i in self.steady_nodes:
            text = f"AT(b.steady[{self.steady.setdefault((section, i), len(self.steady))}])"
        elif node.varies & Varies.LANE:
            text = f"AT(b.lane[{self.lane_constants.setdefault(i, len(self.lane_constants))}])"
        else:
            text = f"b.uniform[{self.uniform_constants.setdefault(i, len(self.uniform_constants))}]"
        return f"DIFFERENT({text}, real(0))" if node.boolean else text

    def row_index(self, output: Output) -> int:
        return self.rows.setdefault(output.place, (len(self.rows), output.row))[0]

    def _prepare(self) -> str:
        """All constants, then the start levels and delays; written last, when what the others need is known."""
        section = self.program.prepare
        for output in section:
            if output.row.theta:
                self.row_index(output)
        body = Statements(self.graph)
        constant = [
            (row, q, slope)
            for row, content in self.rows.values()
            for q, slope in content.theta.items()
            if not self.graph.nodes[slope].varies & Varies.STEP
        ]
        wanted = [*self.uniform_constants, *self.lane_constants, *(c[2] for c in constant), *(o.node for o in section)]
        lanes = body.compute(wanted)
        common = [*body.common, *(f"    b.uniform[{i}] = {body.text(n)};" for n, i in self.uniform_constants.items())]
        lanes += [stored(f"b.lane[{i}]", body.number(n)) for n, i in self.lane_constants.items()]
        lanes += [stored(f"b.row[{row}][{q}]", body.text(slope)) for row, q, slope in constant]
        lanes += [stored(place_text(o.place), body.text(o.node)) for o in section]
        body.leave()
        lines = ["static inline void prepare(Block &b, const real *clock, const real *channel) {", *common]
        lines += ["    EACH_VECTOR {", *lanes, "    }", *self._directions(section, body)]
        return "\n".join([*lines, "    (void)clock; (void)channel;", "}"])


def product(slope: str, change: str) -> str:
    if slope == "real(1.0)":
        return change
    return f"-{change}" if slope == "real(-1.0)" else f"{slope} * {change}"


def place_text(place: Place) -> str:
    """Where an output is stored; nowhere for what lives within a step only."""
    kind, i = place
    if kind.startswith("stage") or kind in ("slope2", "slope3", "slope4"):
        return ""
    return f"b.{_STORED.get(kind, kind)}[{i}]"


_STORED = {
    "next_level": "level",
    "slope1": "slope_left",
    "next_command_memory": "command_memory",
    "next_reading_memory": "reading_memory",
}


def d_place_text(place: Place) -> str:
    kind, i = place
    return f"b.d_{_STORED.get(kind, kind)}[p][{i}]" if place_text(place) else ""


def d_name(place: Place) -> str:
    return f"d_{place[0]}_{place[1]}"
