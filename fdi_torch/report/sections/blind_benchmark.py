"""A blind benchmark: how often the diagnosis was right, what it named for what, how sure it was, how long it took."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from fdi_torch.blind.rows import Scores, group_of, tables
from fdi_torch.blind.score import Row
from fdi_torch.blind.table import OWN, Sheet, misses, sheets
from fdi_torch.report.blind_benchmark_figures import calibration_panel, confusion_panel, shares_panel
from fdi_torch.report.html import Markup, folded, join, table, tag
from fdi_torch.report.material import Material, Payload
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.sections.study import TRIAL, group_panel

# Where an effect sits is its first word, or said here.
PLACES = {
    "pumps": ("pump_",),
    "pipes and outlets": ("laminar_flow", "flow_exponent", "outlet_drop", "coefficient_drift", "plugging"),
    "tanks": ("cross_flow", "leak", "unmetered_flow", "area_taper", "internal_body", "overflow"),
    "sensors": ("sensor_",),
}
LONE = ("single", "weak", "coloured", "twins", "poor")
NAMELESS = ("unknown, there", "unknown, elsewhere", "named", "several", "no gap")


def benchmark_rows(material: Material) -> list[Row]:
    """The judged answers; none where the log is of another kind."""
    return [_row(message) for message in material.of(TRIAL)] if material.kind == "challenge" else []


def scores_section(material: Material) -> Section | None:
    """Every score with its interval, kind by kind, beside the baselines."""
    rows = benchmark_rows(material)
    if not rows:
        return None
    words = (
        "Rigs of other equations than the library's; their causes stayed sealed until every answer was in. Lines and "
        "brackets are 95 % intervals. Of how sure it was, orange is the mean probability that the best explanation was "
        "given, blue how often it was the true one. Of the times, a point is a case, blue the median."
    )
    blocks: list[Markup | str | list[Picture]] = [words]
    for k, (group, by) in enumerate(tables(rows).items()):
        own = [row for row in rows if row["by"] == OWN and group_of(row) == group]
        names, *more = sheets(by)
        blocks += [tag("h4", f"{group}, {len(own)} cases"), _pictures(by, own, f"challenge_{k + 1}")]
        blocks += [_shown(names), folded("Further scores, baselines, and effect by effect", *map(_titled, more))]
    return Section("Right answers", blocks)


def _pictures(by: Mapping[str, Scores], own: Sequence[Row], name: str) -> list[Picture]:
    """How often it was right beside the baselines, how sure it was, how long it took."""
    strata, bins = by[OWN]["strata"], by[OWN]["calibration"]
    kinds = list(strata)
    others = {n: [s["strata"].get(kind, {}).get("right", {}) for kind in kinds] for n, s in by.items() if n != OWN}
    found = [
        Picture(f"{name}_right", shares_panel("How often right", kinds, [s["right"] for s in strata.values()], others))
    ]
    found += [Picture(f"{name}_sure", calibration_panel("How sure, and how often right", bins))] if bins else []
    told = [kind for kind in kinds if kind != "all"]
    seconds = [np.array([float(r["sec"]) for r in own if r["kind"] == kind]) for kind in told]
    return [*found, Picture(f"{name}_seconds", group_panel("How long", "time of a diagnosis, s", told, seconds))]


def confusion_section(material: Material) -> Section | None:
    """Cases with one cause: what was there, and what was answered."""
    rows = [row for row in benchmark_rows(material) if row["by"] == OWN]
    pictures = []
    for k, (place, names) in enumerate(PLACES.items()):
        own = [r for r in rows if r["kind"] in LONE and r["effect"].startswith(names)]
        if own:
            prefix = names[0] if names[0].endswith("_") else ""
            pairs = [(r["effect"].removeprefix(prefix), _answered(r).removeprefix(prefix)) for r in own]
            pictures.append(_confusion(f"challenge_confusion_{k + 1}", place, pairs))
    for title, kind in (
        ("laws without a name", "unknown"),
        ("effects denied", "left_out"),
        ("laws without a name, on networks", "law"),
    ):
        pairs = [(r["effect"], _nameless(r)) for r in rows if r["kind"] == kind]
        if pairs:
            pictures.append(_confusion(f"challenge_{kind}", title, pairs, NAMELESS))
    words = "A row is what was there, a column the best explanation; numbers are cases. Blue is right, orange is not."
    return Section("What was named for what", [words, pictures]) if pictures else None


def misses_section(material: Material) -> Section | None:
    """Every case that was not right, by name."""
    sheet = misses(benchmark_rows(material))
    return Section(sheet.title, [_shown(sheet)]) if sheet.rows else None


def _row(message: Payload) -> Row:
    causes = {key: [tuple(str(c).split("@", 1)) for c in message[key]] for key in ("truth", "causes")}
    return {**message, **causes, "kind": message["group"], "verdict": message["status"]}


def _answered(row: Row) -> str:
    """The effect of the best explanation; what there is instead where that is not one effect."""
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
    rest = ("several", "unknown", "no gap", "crash")
    answered = {said for _, said in pairs}
    across = [*columns] or [
        *rows,
        *sorted(said for said in answered if said not in rows and said not in rest),
        *(said for said in rest if said in answered),
    ]
    matrix = np.array([[counts[true, said] for said in across] for true in rows])
    return Picture(name, confusion_panel(title, _words(rows), _words(across), matrix))


def _words(names: Iterable[str]) -> list[str]:
    return [name.replace("_", " ") for name in names]


def _titled(sheet: Sheet) -> Markup:
    return join([tag("h4", sheet.title), _shown(sheet)])


def _shown(sheet: Sheet) -> Markup:
    return table(sheet.header, sheet.rows, left=sheet.left)
