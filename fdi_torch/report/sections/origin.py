"""Sections about the origin of a log: a drawing of the rig with the diagnosis on it, configuration, provenance,
integrity.
"""

from __future__ import annotations

import math

import numpy as np

from fdi_torch.amounts import kind_words
from fdi_torch.estimate.misfit import NOT_ESTABLISHED
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import quantity_text
from fdi_torch.report.diagnosed_effects import combinations_of, diagnosed_effects, rivals_of
from fdi_torch.report.html import bullets, escape, folded, pairs, shown, tag, typeset
from fdi_torch.report.material import Material
from fdi_torch.report.schematic import Overlay, schematic
from fdi_torch.report.section import Picture, Section

RIG = "rig"  # name of the picture


def rig_section(material: Material) -> Section | None:
    """The schematic with the last levels, the diagnosed effects, and the probability of a discrepancy by location."""
    return _section(material, with_result=True)


def plain_rig_section(material: Material) -> Section | None:
    """The schematic of a run without levels and diagnosis, such as a study; it stands below the results."""
    return _section(material, with_result=False)


def _section(material: Material, with_result: bool) -> Section | None:
    plant = material.plant
    if plant is None:
        return None
    overlay = Overlay(last_levels(material, plant), marks_of(material), probabilities_of(material))
    if with_result != bool(overlay.levels or overlay.marks or overlay.probabilities):
        return None
    parts = ["Levels are the last readings."] if overlay.levels else []
    kind = f"fitted effects, {NOT_ESTABLISHED}" if material.unexplained else "diagnosed effects"
    parts += [f"Orange: {kind}."] if overlay.marks else []
    parts += [f"Strength of colour: {material.meaning_of_shares}."] if overlay.probabilities else []
    caption = " ".join([f"{plant.name}, not to scale.", *parts])
    picture = Picture(RIG, schematic(plant, overlay), caption, wide=True)
    return Section("The rig", [[picture]], lead=with_result)


def last_levels(material: Material, plant: PlantDescription) -> dict[str, float]:
    """Tank -> level in m, from the last valid reading."""
    levels: dict[str, float] = {}
    if not material.groups:
        return levels
    recording = material.recordings[0]
    for sensor in plant.sensors:
        if sensor.column not in recording.output_names:
            continue
        i = recording.output_names.index(sensor.column)
        counted = np.flatnonzero(recording.mask[:, i])
        if len(counted):
            levels[sensor.tank] = (float(recording.outputs[counted[-1], i]) - sensor.offset) / sensor.gain
    return levels


def marks_of(material: Material) -> dict[str, list[str]]:
    """Location -> short texts of the diagnosed effects."""
    marks: dict[str, list[str]] = {}
    for finding in diagnosed_effects(material):
        if finding.present:
            size = "" if math.isnan(finding.size) else f" {quantity_text(finding.size, finding.unit, 3)}"
            marks.setdefault(finding.location, []).append(
                typeset(f"{kind_words(finding.effect, finding.location)}{size}")
            )
    groups = [c.parameters for c in combinations_of(material, "not_isolated")]
    for names in [*groups, *(rivals.names for rivals in rivals_of(material))]:
        for fault in map(ParameterName.of_effect, names):
            marks.setdefault(fault.place, []).append(f"{kind_words(fault.effect, fault.place)}, not isolated")
    return marks


def probabilities_of(material: Material) -> dict[str, float]:
    """Location -> its number between 0 and 1, see `Material.meaning_of_shares`."""
    shares = {location: float(place["share"]) for location, place in material.where.items()}
    return {location: min(max(share, 0.0), 1.0) for location, share in shares.items() if math.isfinite(share)}


MOST_TEXT = 40_000
RECORDS = {"run": "Run", "data": "Data", "seeds": "Seeds", "env": "Versions", "git": "Code", "result": "Result"}
_LEVELS = {3: "warning", 4: "error", 5: "fatal"}


def configuration_section(material: Material) -> Section | None:
    raw = material.run.attachment("config.yaml") if "config.yaml" in material.run.attachments else b""
    text = raw.decode(errors="replace")
    if not text:
        return None
    cut = [tag("p", "The remainder is in the log.", class_="note")] if len(text) > MOST_TEXT else []
    return Section("Configuration", [folded("original file (YAML)", tag("pre", escape(text[:MOST_TEXT])), *cut)])


def provenance_section(material: Material) -> Section | None:
    """Versions, seeds, hashes of the data, and the log's name; lists and tables have sections of their own."""
    blocks = [pairs([("log", material.run.path.name), ("written by", material.run.library)])]
    for record, title in RECORDS.items():
        values = material.about(record)
        if values:
            known = [(name, value) for name, value in values.items() if value not in ("", "null")]
            plain = [(name, value) for name, value in known if not value.startswith(("[", "{"))]
            blocks += [folded(f"{title} ({len(plain)})", pairs(plain))] if plain else []
    return Section("Provenance", blocks)


def health_section(material: Material) -> Section | None:
    """CRCs, indices, completeness, log messages, and the number of messages per topic."""
    inspection = material.inspection
    problems = [*inspection.health.problems, *material.problems]
    state = tag("span", "damaged", class_="bad") if problems else tag("span", "intact", class_="good")
    messages = [
        tag("li", f"{_LEVELS[level]}: " if (level := m.get("level")) in _LEVELS else "", m.get("message", ""))
        for m in material.of("/log")
    ]
    return Section(
        "Integrity of the log",
        [
            tag("p", "The file is ", state, f": {inspection.content}."),
            *bullets(problems),
            *([inspection.advice] if inspection.advice else []),
            *([folded(f"Log messages ({len(messages)})", tag("ul", *messages))] if messages else []),
            folded("Topics", shown(inspection.table())),
        ],
    )
