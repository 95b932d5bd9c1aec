"""Section with a drawing of the rig and the diagnosis on it."""

from __future__ import annotations

import math

import numpy as np

from fdi_torch.estimate.misfit import NOT_ESTABLISHED
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.report.diagnosed_effects import combinations_of, diagnosed_effects
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import number, shown_unit
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
            unit, scale = shown_unit(finding.unit)
            size = "" if math.isnan(finding.size) else f" {number(scale * finding.size, 3)} {unit}".rstrip()
            marks.setdefault(finding.location, []).append(f"{finding.effect.replace('_', ' ')}{size}")
    for combination in combinations_of(material, "not_isolated"):
        for fault in map(ParameterName.of_effect, combination.parameters):
            marks.setdefault(fault.place, []).append(f"{fault.effect.replace('_', ' ')}, not isolated")
    return marks


def probabilities_of(material: Material) -> dict[str, float]:
    """Location -> its number between 0 and 1, see `Material.meaning_of_shares`."""
    where = {str(message["location"]): float(message["share"]) for message in material.of("/gap/where")}
    where |= {str(place["location"]): float(place["share"]) for place in material.answer.get("where", [])}
    return {location: min(max(share, 0.0), 1.0) for location, share in where.items() if math.isfinite(share)}
