"""Sections about a blind benchmark: scores, confusion of causes, wrong answers, computing time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from fdi_torch.blind.score import Row
from fdi_torch.blind.score_tables import OWN, Sheet, misses, sheets
from fdi_torch.blind.scored_rows import Scores, group_of, tables
from fdi_torch.report.blind_benchmark_figures import calibration_panel, confusion_panel, shares_panel
from fdi_torch.report.html import Markup, folded, join, table, tag
from fdi_torch.report.material import Material, Payload
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.sections.study import TRIAL, group_panel

# Effects by component: first words of their names.
PLACES = {
    "pumps": ("pump_",),
    "pipes and outlets": ("laminar_flow", "flow_exponent", "outlet_drop", "coefficient_drift", "plugging"),
    "tanks": ("cross_flow", "leak", "unmetered_flow", "area_taper", "internal_body", "overflow"),
    "sensors": ("sensor_",),
}
LONE = ("single", "weak", "coloured", "twins", "poor")
NAMELESS = ("unknown, there", "unknown, elsewhere", "named", "several", "no gap")


def benchmark_rows(material: Material) -> list[Row]:
    """The scored answers; empty for a log of another kind."""
    return [_row(message) for message in material.of(TRIAL)] if material.kind == "challenge" else []


def scores_section(material: Material) -> Section | None:
    """Every score with its interval, by kind of case, with the baselines."""
    rows = benchmark_rows(material)
    if not rows:
        return None
    words = (
        "The rigs use other equations than the library, and their causes stayed sealed until every answer was "
        "in. Lines and brackets are 95 % intervals. Calibration: orange is the mean stated probability of the best "
        "explanation, blue the share in which it was true. Times: a point is a case, blue the median."
    )
    blocks: list[Markup | str | list[Picture]] = [words]
    for k, (group, by) in enumerate(tables(rows).items()):
        own = [row for row in rows if row["by"] == OWN and group_of(row) == group]
        names, *more = sheets(by)
        blocks += [tag("h4", f"{group}, {len(own)} cases"), _pictures(by, own, f"challenge_{k + 1}")]
        blocks += [_shown(names), folded("Further scores, baselines, and effect by effect", *map(_titled, more))]
    return Section("Right answers", blocks)


def _pictures(by: Mapping[str, Scores], own: Sequence[Row], name: str) -> list[Picture]:
    """Right answers with the baselines, calibration, and computing times."""
    strata, bins = by[OWN]["strata"], by[OWN]["calibration"]
    kinds = list(strata)
    others = {n: [s["strata"].get(kind, {}).get("right", {}) for kind in kinds] for n, s in by.items() if n != OWN}
    pictures = [
        Picture(f"{name}_right", shares_panel("Right answers", kinds, [s["right"] for s in strata.values()], others))
    ]
    pictures += [Picture(f"{name}_sure", calibration_panel("Calibration", bins))] if bins else []
    timed = [kind for kind in kinds if kind != "all"]
    seconds = [np.array([float(r["sec"]) for r in own if r["kind"] == kind]) for kind in timed]
    return [
        *pictures,
        Picture(f"{name}_seconds", group_panel("Computing time", "time of a diagnosis, s", timed, seconds)),
    ]


def confusion_section(material: Material) -> Section | None:
    """True cause against answer, for cases with one cause."""
    rows = [row for row in benchmark_rows(material) if row["by"] == OWN]
    pictures = []
    for k, (place, names) in enumerate(PLACES.items()):
        own = [r for r in rows if r["kind"] in LONE and r["effect"].startswith(names)]
        if own:
            prefix = names[0] if names[0].endswith("_") else ""
            pairs = [(r["effect"].removeprefix(prefix), _answered(r).removeprefix(prefix)) for r in own]
            pictures.append(_confusion(f"challenge_confusion_{k + 1}", place, pairs))
    for title, kind in (
        ("laws outside the library", "unknown"),
        ("effects left out of the library", "left_out"),
        ("laws outside the library, on networks", "law"),
    ):
        pairs = [(r["effect"], _nameless(r)) for r in rows if r["kind"] == kind]
        if pairs:
            pictures.append(_confusion(f"challenge_{kind}", title, pairs, NAMELESS))
    words = "Row: true cause; column: best explanation; numbers: cases. Blue is right, orange is wrong."
    return Section("Confusion of causes", [words, pictures]) if pictures else None


def misses_section(material: Material) -> Section | None:
    """Every wrong answer."""
    sheet = misses(benchmark_rows(material))
    return Section(sheet.title, [_shown(sheet)]) if sheet.rows else None


def _row(message: Payload) -> Row:
    causes = {key: [tuple(str(c).split("@", 1)) for c in message[key]] for key in ("truth", "causes")}
    return {**message, **causes, "kind": message["group"], "verdict": message["status"]}


def _answered(row: Row) -> str:
    """The effect of the best explanation, or the verdict if it is not one effect."""
    if row["verdict"] in ("no_gap", "unknown", "crash"):
        return str(row["verdict"]).replace("_", " ")
    return row["causes"][0][0] if len(row["causes"]) == 1 else "several"


def _nameless(row: Row) -> str:
    if row["verdict"] == "unknown":
        return "unknown, there" if row["right"] else "unknown, elsewhere"
    return "no gap" if row["verdict"] == "no_gap" else "named" if len(row["causes"]) == 1 else "several"


def _confusion(name: str, title: str, pairs: Sequence[tuple[str, str]], columns: Iterable[str] = ()) -> Picture:
    counts = Counter(pairs)
    rows = sorted({true for true, _ in pairs})
    verdicts = ("several", "unknown", "no gap", "crash")
    answers = {answer for _, answer in pairs}
    across = [*columns] or [
        *rows,
        *sorted(answer for answer in answers if answer not in rows and answer not in verdicts),
        *(verdict for verdict in verdicts if verdict in answers),
    ]
    matrix = np.array([[counts[true, answer] for answer in across] for true in rows])
    return Picture(name, confusion_panel(title, _words(rows), _words(across), matrix))


def _words(names: Iterable[str]) -> list[str]:
    return [name.replace("_", " ") for name in names]


def _titled(sheet: Sheet) -> Markup:
    return join([tag("h4", sheet.title), _shown(sheet)])


def _shown(sheet: Sheet) -> Markup:
    return table(sheet.header, sheet.rows, left=sheet.left)
