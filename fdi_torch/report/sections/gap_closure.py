"""Sections about the closure of a gap on data not used for fitting, and about the calibration constants."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from fdi_torch.gap.verdict_words import closed_sentence
from fdi_torch.report.html import table
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float, axis, number, percent, shown_unit, with_error
from fdi_torch.report.panels import bar_panel
from fdi_torch.report.reference_models import has_causes, reference_models
from fdi_torch.report.section import Picture, Section

FROZEN = {"recalibrated": "constants recalibrated without them", "nominal": "nominal constants"}


def closure_section(material: Material) -> Section | None:
    """Errors on data that no fit has seen, if there are causes that could close a gap."""
    closure = material.answer.get("closure") or {}
    stages = _stages(material)
    if not stages or not has_causes(material.answer):
        return None
    unit = str(closure.get("unit", ""))
    names = list(stages.values())
    values = [float(closure[name]) for name in stages]
    texts = [f"{number(v, 3)} {unit}".rstrip() for v in values]
    label = axis("free-run error on hold-outs (rms)", unit)
    figure = bar_panel("", label, names, values, texts, [name == "augmented" for name in stages])
    return Section("How far it closes", [closed_sentence(closure), [Picture("gap_closure", figure)]], lead=True)


def errors_section(material: Material) -> Section | None:
    """The errors behind the closure: by model and sensor, and by hold-out."""
    closure = material.answer.get("closure") or {}
    stages = _stages(material)
    if not stages:
        return None
    unit = str(closure.get("unit", ""))
    named = stages.get("augmented")
    frozen = (closure.get("frozen") or {}) if named else {}
    extra = [(f"{named}, {other}", as_float(frozen.get(key))) for key, other in FROZEN.items() if key in frozen]
    header = [f"plant{', error in ' + unit if unit else ''}", "all", *_headed(closure)]
    rows = [[name, number(float(closure[m]), 3), *_by_sensor(closure, m)] for m, name in stages.items()]
    rows += [[name, number(value, 3), *[""] * (len(header) - 2)] for name, value in extra]
    blocks: list[Any] = [table(header, rows)]
    blocks += _each_holdout(closure, unit, stages)
    if extra and "ceiling" in closure:
        blocks.append(
            "Free functions of the component's own variables, added to the causes, show the best that better "
            "equations could reach. If the errors with other constants are far larger, recalibration without the "
            "causes had absorbed part of the gap; using both would count that part twice."
        )
    return Section("Errors on data not used for fitting", blocks)


def _stages(material: Material) -> dict[str, str]:
    """Names of the models that have an error, by their key in the closure."""
    closure = material.answer.get("closure") or {}
    models = reference_models(material.answer).items()
    return {key: name for key, name in models if isinstance(closure.get(key), int | float)}


def constants_section(material: Material) -> Section | None:
    """Nominal value of each calibration constant, and its values without and with the causes, if there are any."""
    constants = material.answer.get("constants") or {}
    causes = has_causes(material.answer)
    rows = []
    for name, c in constants.items():
        unit, scale = shown_unit(str(c.get("unit", "1")), str(name))
        values = {key: scale * as_float(c.get(key)) for key in ("nominal", "tolerance", "recalibrated", "augmented")}
        off = [(values[m] - values["nominal"]) / values["tolerance"] for m in ("recalibrated", "augmented")]
        fitted = with_error(values["augmented"], scale * as_float(c.get("std")))
        nominal = with_error(values["nominal"], values["tolerance"])
        without = [number(values["recalibrated"]), number(off[0], 2)] if causes else ["", ""]
        rows.append([str(name), nominal, *without, fitted, number(off[1], 2), unit])
    if not rows:
        return None
    last = "with the causes" if causes else "fitted"
    header = ["constant", "nominal", "recalibrated", "tolerances off", last, "tolerances off", "unit"]
    words = "Constants with a tolerance are always refitted; a value far outside it compensates for a model error."
    return Section("Calibration constants", [words, table(header, rows)])


def _headed(closure: Mapping[str, Any]) -> list[str]:
    """The sensors, with their units if these differ."""
    units = closure.get("units") or {}
    return [f"{s}, {units[s]}" if len(set(units.values())) > 1 and s in units else s for s in _sensors(closure)]


def _sensors(closure: Mapping[str, Any]) -> list[str]:
    return [str(sensor) for sensor in closure.get("per_sensor") or {}]


def _by_sensor(closure: Mapping[str, Any], stage: str) -> list[str]:
    return [number(as_float(errors.get(stage)), 3) for errors in (closure.get("per_sensor") or {}).values()]


def _each_holdout(closure: Mapping[str, Any], unit: str, stages: Mapping[str, str]) -> list[Any]:
    """One row per file, if there are several; the share that closes if there are causes."""
    shown = {key: name for key, name in stages.items() if key in ("recalibrated", "augmented", "noise_floor")}
    rows = []
    for one in closure.get("per_holdout") or []:
        share = one.get("closed")
        closed = percent(share) if isinstance(share, int | float) else "undefined"
        name = PurePath(str(one.get("source", ""))).name
        errors = [number(as_float(one.get(key)), 3) for key in shown]
        rows.append([name, *errors, closed if "augmented" in shown else ""])
    header = (f"hold-out, error in {unit}", *shown.values(), "closed")
    return [table(header, rows)] if rows else []
