"""The modelDescription.xml of a plant as an FMU (FMI 2.0, Modelica Association, 2014, section 2.2)."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

from fdi_torch.parameters import ParameterName
from fdi_torch.plant.network import TankNetwork

_BASE_UNITS: dict[str, dict[str, int]] = {
    "m": {"m": 1},
    "s": {"s": 1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "A": {"A": 1},
    "1/s": {"s": -1},
    "m^2": {"m": 2},
    "m^3": {"m": 3},
    "m^3/s": {"m": 3, "s": -1},
    "m/s": {"m": 1, "s": -1},
}


@dataclass(frozen=True)
class Variable:
    """A scalar variable of the FMU in SI; `start` is None for outputs."""

    name: str
    causality: str
    variability: str
    unit: str
    start: float | None
    description: str


def variables_of(network: TankNetwork) -> list[Variable]:
    """Inputs (0 until they are set), levels, readings and parameters, in the order of their value references.

    Parameters may change between two communication steps, except the start levels.
    """
    plant = network.description
    inputs = [
        Variable(name, "input", "continuous", unit, 0.0, "recorded input of the plant")
        for name, unit in plant.channel_units().items()
    ]
    levels = [Variable(f"{t.name}.level", "output", "continuous", "m", None, "level of the tank") for t in plant.tanks]
    readings = [
        Variable(s.column, "output", "continuous", s.unit, None, f"reading of {s.name}, without noise")
        for s in plant.sensors
    ]
    parameters = [
        Variable(p.name, "parameter", _variability(p.name), p.unit, p.nominal, p.meaning) for p in network.constants
    ]
    return [*inputs, *levels, *readings, *parameters]


def _variability(parameter: str) -> str:
    return "fixed" if ParameterName.parse(parameter).field == "start_level" else "tunable"


def model_description(
    name: str, identifier: str, guid: str, tool: str, step: float, variables: list[Variable]
) -> bytes:
    """The XML; step: communication step that is proposed, s. Raises ValueError if two variables have the same name."""
    names = [variable.name for variable in variables]
    doubled = next((n for n in names if names.count(n) > 1), None)
    if doubled:
        raise ValueError(f"expected each channel under its own name, got '{doubled}' twice; rename a sensor's channel")
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=name,
        guid=guid,
        generationTool=tool,
        variableNamingConvention="flat",
        numberOfEventIndicators="0",
    )
    ElementTree.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identifier,
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    definitions = ElementTree.SubElement(root, "UnitDefinitions")
    for symbol in sorted({variable.unit for variable in variables} & _BASE_UNITS.keys()):
        powers = {base: str(power) for base, power in _BASE_UNITS[symbol].items()}
        ElementTree.SubElement(ElementTree.SubElement(definitions, "Unit", name=symbol), "BaseUnit", powers)
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(step))
    listed = ElementTree.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        attributes = {"name": variable.name, "valueReference": str(reference), "causality": variable.causality}
        attributes |= {"variability": variable.variability}
        attributes |= {"description": variable.description} if variable.description else {}
        start = {} if variable.start is None else {"start": repr(variable.start)}
        unit = {"unit": variable.unit} if variable.unit in _BASE_UNITS else {}
        scalar = ElementTree.SubElement(listed, "ScalarVariable", attributes)
        ElementTree.SubElement(scalar, "Real", {**unit, **start})
    structure = ElementTree.SubElement(root, "ModelStructure")
    for kind in ("Outputs", "InitialUnknowns"):
        unknowns = ElementTree.SubElement(structure, kind)
        for index, variable in enumerate(variables, start=1):
            if variable.causality == "output":
                ElementTree.SubElement(unknowns, "Unknown", index=str(index))
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True))
