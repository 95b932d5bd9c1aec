"""One C++ source for a plant: its program's sections as functions over a block of lanes, in the loops of kernel.hpp.

What varies with nothing is computed once, what varies between lanes once a trajectory, what varies in time only once
a step for all lanes; the rest stands in loops over lanes that a compiler turns into vector instructions.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from fdi_torch.simulate.expression import Varies
from fdi_torch.simulate.operations import OPERATIONS
from fdi_torch.simulate.program import Program
from fdi_torch.simulate.section import Output, Place, Row, Section

_SKELETON = Path(__file__).with_name("kernel.hpp")
_MATHS = ("FABS", "SQRT", "EXP", "LOG", "POW", "SIN", "COS", "TANH", "FLOOR", "CEIL", "TRUNC")
# glibc has vector forms of these, which a compiler may use once they are declared; the same lane always takes the same.
_VECTORS = """#if defined(__GLIBC__) && defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
extern "C" {
#define VECTOR __attribute__((simd("notinbranch")))
VECTOR double exp(double); VECTOR double log(double); VECTOR double pow(double, double);
VECTOR double sin(double); VECTOR double cos(double);
VECTOR float expf(float); VECTOR float logf(float); VECTOR float powf(float, float);
VECTOR float sinf(float); VECTOR float cosf(float);
}
#endif
"""


def emit(program: Program, inner_samples: bool, real: str, lanes: int) -> str:
    """The source. real: 'double' or 'float'. inner_samples: whether samples lie within steps. lanes: in a block."""
    writer = _Writer(program)
    sections = writer.sections(inner_samples)
    columns = program.columns
    defines = {
        "LANES": lanes,
        "TANGENT": int(program.tangent),
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
    }
    head = ["#include <cmath>", _VECTORS, f"typedef {real} real;"]
    suffix = "f" if real == "float" else ""
    head += [f"#define {m} {m.lower()}{suffix}" for m in _MATHS]
    head += [f"#define ROUND {'rint' + suffix}"]
    head += [f"#define {name} {value}" for name, value in defines.items()]
    head += [
        _table("LATE_CHANNEL", [program.channels[i] for i in program.late_actuators]),
        _table("LATE_SENSOR", program.late_sensors),
        _table("SENSOR_TANK", program.sensor_tanks),
    ]
    skeleton = _SKELETON.read_text(encoding="utf-8").replace("//@SECTIONS@", sections)
    return "\n".join(head) + "\n" + skeleton


def _table(name: str, values: Sequence[int]) -> str:
    return f"static const int {name}[] = {{{', '.join(map(str, values or [0]))}}};"


class _Writer:
    """Text of the sections; collects what is computed before the loop over time as it goes."""

    def __init__(self, program: Program) -> None:
        self.program, self.graph = program, program.graph
        self.lane_constants: dict[int, int] = {}
        self.uniform_constants: dict[int, int] = {}
        self.rows: dict[Place, tuple[int, Row]] = {}

    def sections(self, inner_samples: bool) -> str:
        p = self.program
        texts = [
            self._section("settle_commands", p.settle_commands),
            self._section("step", p.step),
            self._section("settle_readings", p.settle_readings),
            self._section("read", p.read),
        ]
        if inner_samples:
            texts.append(self._section("end", p.end))
        texts.insert(0, self._prepare())
        return "\n".join(texts)

    def _section(self, name: str, section: Section) -> str:
        """A function: numbers common to all lanes, the loop over lanes, and the loop over directions."""
        body = _Body(self)
        kept = body.values(section)
        lines = [f"static inline void {name}(Block &b, const real *clock, const real *channel) {{"]
        lines += [f"    Lane kept[{max(len(kept), 1)}];", *body.common, "    EACH_LANE {", *body.lane, "    }"]
        lines += self._directions(section, body)
        return "\n".join([*lines, "    (void)kept; (void)clock; (void)channel;", "}"])

    def _directions(self, section: Section, body: _Body) -> list[str]:
        """The loop over directions: what each output changes by; stored last, when no old value is needed any more."""
        moving = [o for o in section if o.row]
        if not moving:
            return []
        here = {o.place for o in moving}
        lines = [f"        const real {d_name(o.place)} = {self._change(o, body, here)};" for o in moving]
        lines += [f"        {d_store(o.place)} = {d_name(o.place)};" for o in moving if d_store(o.place)]
        return ["    for (int p = 0; p < COLUMNS; ++p) EACH_LANE {", *lines, "    }"]

    def _change(self, output: Output, body: _Body, here: Collection[Place]) -> str:
        """The row as a C expression. here: what is computed in the same loop; the rest is stored."""
        terms = [
            product(body.text(slope), d_name(place) if place in here else d_store(place))
            for slope, place in output.row.terms
        ]
        if output.row.theta:
            terms.append(f"b.row[{self.rows[output.place][0]}][p][l]")
        return " + ".join(terms)

    def constant(self, i: int) -> str:
        """Where a node that does not vary in time is stored by `prepare`."""
        node = self.graph.nodes[i]
        if node.varies & Varies.LANE:
            text = f"b.lane[{self.lane_constants.setdefault(i, len(self.lane_constants))}][l]"
        else:
            text = f"b.uniform[{self.uniform_constants.setdefault(i, len(self.uniform_constants))}]"
        return f"({text} != 0)" if node.boolean else text

    def row_index(self, output: Output) -> int:
        return self.rows.setdefault(output.place, (len(self.rows), output.row))[0]

    def _prepare(self) -> str:
        """All constants, then the start levels and delays; written last, when what the others need is known."""
        section = self.program.prepare
        for output in section:
            if output.row.theta:
                self.row_index(output)
        body = _Body(self, before_time=True)
        constant = [
            (row, q, slope)
            for row, content in self.rows.values()
            for q, slope in content.theta.items()
            if not self.graph.nodes[slope].varies & Varies.STEP
        ]
        wanted = [*self.uniform_constants, *self.lane_constants, *(c[2] for c in constant), *(o.node for o in section)]
        body.compute(wanted)
        body.common += [f"    b.uniform[{i}] = {body.text(n)};" for n, i in self.uniform_constants.items()]
        body.lane += [f"        b.lane[{i}][l] = {body.text(n)};" for n, i in self.lane_constants.items()]
        body.lane += [f"        b.row[{row}][{q}][l] = {body.text(slope)};" for row, q, slope in constant]
        body.lane += [f"        {store(o.place)} = {body.text(o.node)};" for o in section]
        lines = ["static inline void prepare(Block &b, const real *clock, const real *channel) {", *body.common]
        lines += ["    EACH_LANE {", *body.lane, "    }", *self._directions(section, body)]
        return "\n".join([*lines, "    (void)clock; (void)channel;", "}"])


class _Body:
    """The statements of one section: `common` to all lanes, and those within the loop over lanes."""

    def __init__(self, writer: _Writer, before_time: bool = False) -> None:
        self.writer, self.graph, self.before_time = writer, writer.graph, before_time
        self.common: list[str] = []
        self.lane: list[str] = []
        self.kept: dict[int, int] = {}
        self._inside = True

    def values(self, section: Section) -> dict[int, int]:
        """Writes what computes and stores the outputs and the slopes that directions need; returns the kept ones."""
        slopes = [slope for o in section for slope, _ in o.row.terms]
        by_theta = [(o, q, slope) for o in section for q, slope in o.row.theta.items()]
        self.compute([*(o.node for o in section), *slopes, *(slope for _, _, slope in by_theta)])
        for o, q, slope in by_theta:
            row = self.writer.row_index(o)
            if self.graph.nodes[slope].varies & Varies.STEP:
                self.lane.append(f"        b.row[{row}][{q}][l] = {self.text(slope)};")
        for slope in slopes:
            if self.graph.nodes[slope].varies == Varies.BOTH and slope not in self.kept:
                self.lane.append(f"        kept[{len(self.kept)}][l] = {self.text(slope)};")
                self.kept[slope] = len(self.kept)
        self.lane += [f"        {store(o.place)} = {self.text(o.node)};" for o in section if store(o.place)]
        self._inside = False
        return self.kept

    def compute(self, wanted: Iterable[int]) -> None:
        """Writes a statement for each node that the wanted ones need and that is not known yet."""
        nodes = self.graph.nodes
        for i in self.graph.reach(wanted, [] if self.before_time else self._before(wanted)):
            if nodes[i].operation == "literal":
                continue
            kind = "bool" if nodes[i].boolean else "real"
            lines, indent = (self.lane, 8) if nodes[i].varies & Varies.LANE else (self.common, 4)
            lines.append(f"{' ' * indent}const {kind} v{i} = {self._formula(i)};")

    def _before(self, wanted: Iterable[int]) -> list[int]:
        return [i for i in self.graph.reach(wanted) if not self.graph.nodes[i].varies & Varies.STEP]

    def _formula(self, i: int) -> str:
        node = self.graph.nodes[i]
        if node.operation == "input":
            return input_text(node.kind, node.index, node.varies)
        if self.before_time or node.varies & Varies.STEP:
            return OPERATIONS[node.operation].c.format(*(self.text(a) for a in node.arguments))
        return self.writer.constant(i)

    def text(self, i: int) -> str:
        """The C expression of a node that has been computed; in the loop over directions, of one that was kept."""
        node = self.graph.nodes[i]
        if node.operation == "literal":
            return literal(node.value)
        if self._inside or not node.varies & Varies.LANE:
            return f"v{i}"
        if i in self.kept:
            return f"kept[{self.kept[i]}][l]"
        return input_text(node.kind, node.index, node.varies) if node.operation == "input" else self.writer.constant(i)


def literal(value: float | None) -> str:
    assert value is not None
    return f"real({value!r})" if math.isfinite(value) else f"real({'-' if value < 0 else ''}INFINITY)"


def input_text(kind: str, index: int, varies: Varies) -> str:
    if kind == "resolution":
        return "b.resolution"
    if kind in ("clock", "channel"):
        return f"{kind}[{index}]"
    return f"b.{kind}[{index}][l]" if varies & Varies.LANE else f"b.{kind}[{index}]"


def product(slope: str, change: str) -> str:
    if slope == "real(1.0)":
        return change
    return f"-{change}" if slope == "real(-1.0)" else f"{slope} * {change}"


def store(place: Place) -> str:
    """Where an output is stored; nowhere for what lives within a step only."""
    kind, i = place
    if kind.startswith("stage") or kind in ("slope2", "slope3", "slope4"):
        return ""
    return f"b.{_STORED.get(kind, kind)}[{i}][l]"


_STORED = {
    "next_level": "level",
    "slope1": "slope_left",
    "next_command_memory": "command_memory",
    "next_reading_memory": "reading_memory",
}


def d_store(place: Place) -> str:
    kind, i = place
    return f"b.d_{_STORED.get(kind, kind)}[p][{i}][l]" if store(place) else ""


def d_name(place: Place) -> str:
    return f"d_{place[0]}_{place[1]}"
