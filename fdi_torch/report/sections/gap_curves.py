"""Section about the discrepancy as a function of the component's own variables: free function and named cause."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from fdi_torch.report.chart import Chart, Line
from fdi_torch.report.html import short
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import as_float, as_vector, axis, shown_unit
from fdi_torch.report.section import Picture, Section, signals
from fdi_torch.report.style import MARK, MODEL, SOFT, label_lines, panel

MOST_CURVES = 12
QUANTITIES = {"flow": "flow added", "area": "cross-section added", "reading": "added to the reading"}
# SI units of the variables that a free-form discrepancy may depend on.
_VARIABLE_UNITS = {"level": "m", "head": "m", "difference": "m", "time": "s", "period": "s"}


def curves_section(material: Material) -> Section | None:
    """One panel for each variable of each component with a discrepancy."""
    curves = [c for c in material.answer.get("curves") or [] if isinstance(c, dict)][:MOST_CURVES]
    if not curves:
        return None
    pictures = [Picture(f"gap_curve_{k + 1}", curve_panel(curve)) for k, curve in enumerate(curves)]
    words = "Discrepancy between the component and the plant file, averaged at equal values of its variable. "
    if any("effect" in curve for curve in curves):
        words += (
            "Blue: a free function with two standard errors, estimated without the library; orange: the named cause. "
            "Where both agree, the cause's equation is right. A free function has no memory and hardly shows lags or "
            "delays."
        )
    else:
        words += "The free function, with two standard errors, shows what an unnamed cause would have to do."
    return Section("The discrepancy", [words, pictures])


def curve_panel(curve: Mapping[str, Any]) -> Figure:
    """Free function with its band, and the effect."""
    unit, scale = shown_unit(str(curve.get("unit", "")))
    quantity = str(curve.get("quantity", ""))
    y_unit, y_scale = ("%", 100.0) if quantity == "area" else shown_unit(str(curve.get("quantity_unit", "")))
    x, free, std = scale * as_vector(curve["at"]), y_scale * as_vector(curve["free"]), as_vector(curve["free_std"])
    name = short(curve.get("variable", ""), 30)
    label = axis(QUANTITIES.get(quantity, "added"), y_unit)
    figure, axes = panel(f"{short(curve.get('location', ''), 20)}: by {name}", axis(name, unit), label)
    axes.axhline(0.0, color=SOFT, lw=0.8)
    axes.fill_between(x, free - 2.0 * y_scale * std, free + 2.0 * y_scale * std, color=MODEL, alpha=0.2, lw=0.0)
    axes.plot(x, free, color=MODEL, lw=1.4, label="free function")
    if "effect" in curve:
        axes.plot(x, y_scale * as_vector(curve["effect"]), color=MARK, lw=1.4, ls="--", label="cause")
        label_lines(axes)
    return figure


def shape_section(material: Material) -> Section | None:
    """The free-form discrepancy as tables, for logs without curves."""
    shape = material.answer.get("shape")
    if material.answer.get("curves") or not isinstance(shape, dict) or not shape.get("tables"):
        return None
    pictures = []
    for k, (name, curve) in enumerate(shape["tables"].items()):
        variable = str(name).rpartition(".")[2]
        unit, scale = shown_unit(_VARIABLE_UNITS.get(variable, "SI"))
        x, y = scale * as_vector(curve["at"]), as_float(curve.get("scale", 1.0)) * as_vector(curve["share"])
        title = f"{shape.get('location', '')}: by {variable}"
        line = Line("discrepancy", x, y, MARK)
        chart = Chart(title, axis(variable, unit), "discrepancy, SI", [line], level=0.0)
        pictures.append(signals(f"gap_shape_{k + 1}", chart))
    words = "What must be added at this location to explain the readings, whatever its cause."
    return Section("The discrepancy", [words, pictures])
