"""The sections of a program as C++ functions over a block of lanes."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from fdi_torch.simulate.cpp_statements import Statements, stored
from fdi_torch.simulate.expression import Output, Place, Row, Section, Varies
from fdi_torch.simulate.program import Program


class SectionWriter:
    """Writes the functions of all sections, and collects what has to be computed before the loop over time."""

    def __init__(self, program: Program, inner_samples: bool) -> None:
        self.program, self.graph, self.inner_samples = program, program.graph, inner_samples
        self.lane_constants: dict[int, int] = {}
        self.uniform_constants: dict[int, int] = {}
        self.rows: dict[Place, tuple[int, Row]] = {}

    def sections(self) -> str:
        p = self.program
        texts = [self._section("settle_commands", [p.settle_commands])]
        if not p.unrolled:
            texts += [self._section("act", [p.act]), self._section("rates", [p.law])]
        else:
            texts.append(self._section("step", [p.act + p.stages[0], *p.stages[1:-1], p.stages[-1] + p.advance]))
        texts += [self._section("settle_readings", [p.settle_readings]), self._section("read", [p.read])]
        if self.inner_samples and p.unrolled:
            texts.append(self._section("end", [p.end]))
        texts.insert(0, self._prepare())
        return "\n".join(texts)

    def _section(self, name: str, parts: Sequence[Section]) -> str:
        """One function: numbers common to all lanes, a loop over vectors for each part, and the loop over
        directions.
        """
        outputs = [o for part in parts for o in part]
        body = Statements(self.graph, self.constant)
        ends = self._ends(parts)
        needed = [self._wanted(part, end) for part, end in zip(parts, ends, strict=True)]
        body.keep(needed, [slope for o in outputs for slope, _ in o.row.terms])
        lines = []
        for part, end, nodes in zip(parts, ends, needed, strict=True):
            loop = self._loop(body, part, end, nodes)
            lines += ["    EACH_VECTOR {", *loop, "    }"] if loop else []
        head = [f"static inline void {name}(Block &b, const real *clock, const real *channel) {{"]
        head += [f"    alignas(64) Lane kept[{max(len(body.kept), 1)}];", *body.common]
        tail = ["    (void)kept; (void)clock; (void)channel;", "}"]
        lines += self._directions(outputs, body)
        return "\n".join([*head, *lines, *tail])

    def _ends(self, parts: Sequence[Section]) -> list[list[Output]]:
        """The outputs that each part stores; new states are stored by the last part, when their old values are no
        longer needed.
        """
        new_states = [o for part in parts for o in part if o.place[0].startswith("next_")]
        ends = [[o for o in part if o not in new_states and self._place(o.place)] for part in parts]
        ends[-1] += new_states
        return ends

    def _wanted(self, part: Section, ends: Sequence[Output]) -> list[int]:
        slopes = [s for o in part for s in (*(slope for slope, _ in o.row.terms), *o.row.theta.values())]
        return [*(o.node for o in (*part, *ends)), *slopes]

    def _loop(self, body: Statements, part: Section, ends: Sequence[Output], needed: list[int]) -> list[str]:
        lines = body.compute(needed)
        for o in part:
            for q, slope in o.row.theta.items():
                row = self.row_index(o)
                if self.graph.nodes[slope].varies & Varies.STEP:
                    lines.append(stored(f"b.row[{row}][{q}]", body.text(slope)))
        lines += [stored(place_text(o.place), body.text(o.node)) for o in ends]
        body.leave()
        return lines

    def _directions(self, section: Sequence[Output], body: Statements) -> list[str]:
        """The loop over directions: the change of each output, stored last, when no old value is needed any more."""
        changing = [o for o in section if o.row]
        if not changing:
            return []
        computed = {o.place for o in changing}
        lines = [f"        const Vec {d_name(o.place)} = {self._change(o, body, computed)};" for o in changing]
        lines += [stored(d_place_text(o.place), d_name(o.place)) for o in changing if self._place(o.place)]
        return ["    for (int p = 0; p < COLUMNS; ++p) EACH_VECTOR {", *lines, "    }"]

    def _change(self, output: Output, body: Statements, computed: Collection[Place]) -> str:
        """The row as a C++ expression; here: places computed in the same loop, all others are read from storage."""
        terms = [
            product(body.text(slope), d_name(place) if place in computed else f"AT({d_place_text(place)})")
            for slope, place in output.row.terms
        ]
        if output.row.theta:
            terms.append(f"AT(b.row[{self.rows[output.place][0]}][p])")
        return " + ".join(terms)

    def _place(self, place: Place) -> str:
        """The storage location of an output; end slopes are stored only if samples lie within steps."""
        return "" if place[0] == "slope1" and not self.inner_samples else place_text(place)

    def constant(self, i: int) -> str:
        """The storage location of a node that `prepare` computes."""
        node = self.graph.nodes[i]
        if node.varies & Varies.LANE:
            text = f"AT(b.lane[{self.lane_constants.setdefault(i, len(self.lane_constants))}])"
        else:
            text = f"b.uniform[{self.uniform_constants.setdefault(i, len(self.uniform_constants))}]"
        return f"DIFFERENT({text}, real(0))" if node.boolean else text

    def row_index(self, output: Output) -> int:
        return self.rows.setdefault(output.place, (len(self.rows), output.row))[0]

    def _prepare(self) -> str:
        """The function of all constants, start levels and delays; written last: the others determine its outputs."""
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
        needed = [*self.uniform_constants, *self.lane_constants, *(c[2] for c in constant), *(o.node for o in section)]
        lanes = body.compute(needed)
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
    """The storage location of an output; empty for one that exists only within a step."""
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
