"""Sections about a blind benchmark: scores, confusion of causes, wrong answers, computing time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from fdi_torch.blind.kinds import KINDS
from fdi_torch.blind.places import EFFECTS, OUTLET, PAIR, PIPE, PUMP, SENSOR, TANK
from fdi_torch.blind.score import Row
from fdi_torch.blind.scored_rows import OWN, Scores, group_of, misses, sheets, tables
from fdi_torch.report.html import Markup, folded, short, shown, table, tag
from fdi_torch.report.material import Material, Payload
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.sections.study import TRIAL, group_panel
from fdi_torch.report.style import INK, MARK, MODEL, OTHER, PAPER, SOFT, WIDTH, label_lines, panel

PLACES = {"pumps": (PUMP,), "pipes and outlets": (PIPE, OUTLET), "tanks": (TANK, PAIR), "sensors": (SENSOR,)}
Share = Mapping[str, Any]
"""share, of, ci95."""
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
    present = {row["kind"] for row in rows}
    kinds = [[kind.name.replace("_", " "), kind.meaning] for kind in KINDS.values() if kind.name in present]
    blocks: list[Markup | str | list[Picture]] = [words, table(["kind of case", "what it is"], kinds, left=2)]
    for k, (group, by) in enumerate(tables(rows).items()):
        own = [row for row in rows if row["by"] == OWN and group_of(row) == group]
        first, *more = sheets(by)
        blocks += [tag("h4", f"{group}, {len(own)} cases"), _pictures(by, own, f"challenge_{k + 1}")]
        first = replace(first, title="")  # that of the section
        blocks += [shown(first), folded("Further scores, baselines, and effect by effect", *map(shown, more))]
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
    for k, (place, kinds) in enumerate(PLACES.items()):
        names = [effect for effect, at in EFFECTS.items() if set(at) & set(kinds)]
        own = [r for r in rows if r["kind"] in LONE and r["effect"] in names]
        if own:
            prefix = f"{kinds[0]}_"
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
    sheet = misses(benchmark_rows(material))
    return Section(sheet.title, [shown(replace(sheet, title=""))]) if sheet.rows else None


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


def shares_panel(
    title: str, kinds: Sequence[str], own: Sequence[Share], others: Mapping[str, Sequence[Share]]
) -> Figure:
    """Share of right answers of each kind with its interval, and small marks for the baselines."""
    figure, axes = panel(short(title), "right answers, %", "", height=1.4 + 0.3 * len(kinds))
    rows = np.arange(len(kinds))
    for (name, shares), colour, mark in zip(others.items(), (OTHER, SOFT, INK, MARK), "dx+^", strict=False):
        x = [100 * s["share"] if s else np.nan for s in shares]
        axes.plot(x, rows, mark, color=colour, ms=5, label=short(name, 20).replace("_", " "))
    low, middle, high = _intervals(own)
    axes.hlines(rows, low, high, color=MODEL, lw=2.0, alpha=0.5)
    axes.plot(middle, rows, "o", color=MODEL, ms=6, label="fdi")
    axes.set_xlim(-3, 103)
    axes.set_yticks(rows, [f"{short(k, 16)} ({s['of']})" for k, s in zip(kinds, own, strict=True)])
    axes.set_ylim(len(kinds) - 0.5, -0.5)
    label_lines(axes)
    return figure


def confusion_panel(title: str, rows: Sequence[str], columns: Sequence[str], counts: np.ndarray) -> Figure:
    """Counts (rows, columns) of the true cause against the answer; right answers are blue."""
    width = max(WIDTH, 1.4 + 0.17 * len(columns))  # of slanted letters of 9 points beside each other
    figure, axes = panel(short(title), "", "", width=width, height=1.35 + 0.27 * len(rows))
    for i, j in np.argwhere(counts > 0):
        right = rows[i] == columns[j] or columns[j] == "unknown, there"
        axes.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, facecolor=MODEL if right else MARK, edgecolor=PAPER))
        axes.text(j, i, str(int(counts[i, j])), ha="center", va="center", fontsize=9.0, color=PAPER)
    axes.set_xlim(-0.5, len(columns) - 0.5)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_yticks(range(len(rows)), [short(name, 22) for name in rows])
    axes.set_xticks(range(len(columns)), [short(name, 22) for name in columns], rotation=45, ha="right")
    axes.tick_params(length=0)
    return figure


def calibration_panel(title: str, bins: Sequence[Mapping[str, Any]]) -> Figure:
    """Frequency with which the best explanation was true, against its stated probability (orange mark)."""
    figure, axes = panel(short(title), "stated probability of the best explanation", "it was true, %")
    at = np.arange(len(bins))
    low, middle, high = _intervals(bins)
    axes.vlines(at, low, high, color=MODEL, lw=2.0, alpha=0.5)
    axes.plot(at, middle, "o", color=MODEL, ms=6)
    axes.plot(at, [100 * b["stated"] for b in bins], "_", color=MARK, ms=22, mew=2.0)
    axes.set_xticks(at, [f"{b['low']:g}–{b['high']:g}\n({b['of']})" for b in bins])
    axes.set_xlim(-0.6, len(bins) - 0.4)
    axes.set_ylim(-8, 108)
    return figure


def _intervals(scores: Sequence[Share]) -> np.ndarray:
    """The minimum of each, the share, and the largest value (3, scores), %."""
    return 100 * np.array([(s["ci95"][0], s["share"], s["ci95"][1]) for s in scores]).T
