"""A plant as an FMU for co-simulation (FMI 2.0, Modelica Association, 2014): the compiled engine's C++ with the
functions of the standard, and its modelDescription.xml (section 2.2).

The FMU is self-contained: it needs neither Python nor this package where it runs. Its steps are those of
`clean_readings`: L-stable, with a tolerance of 1e-10 of the plant's length scale.
"""

from __future__ import annotations

import hashlib
import re
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

from fdi_torch.disk import replacing
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale, time_scale
from fdi_torch.simulate.build import compile_library
from fdi_torch.simulate.cpp_source import emit
from fdi_torch.simulate.program import Program, build_program
from fdi_torch.simulate.simulated_recording import LONGEST_STEP, RESOLUTION, TOLERANCE
from fdi_torch.simulate.step_control import StepControl

_FUNCTIONS = Path(__file__).with_name("fmu.hpp")
# Runs on any machine of the same kind, and needs no C++ library there.
_FLAGS = ("-O2", "-fno-strict-aliasing", "-fvisibility=hidden")
_STATIC = ("-static-libstdc++", "-static-libgcc") if sys.platform == "linux" else ()


def write_fmu(network: TankNetwork, path: Path) -> list[Variable]:
    """Write the FMU of a plant with its placed effects for this kind of machine, and return its variables.

    The zip file holds modelDescription.xml, the compiled library and, under sources/, the C++ it was compiled from.
    Raises ValueError for another ending or an effect with a dead time, BuildError without a compiler, DiskError.
    """
    if path.suffix.lower() != ".fmu":
        raise ValueError(f"expected a file that ends in .fmu, got {path}; rename it")
    source = fmu_source(network)
    variables = variables_of(network)
    name = network.description.name or "plant"
    identifier = re.sub(r"\W|^(?=\d)", "_", name, flags=re.ASCII)
    guid = hashlib.sha256(f"{name}\0{variables}\0{source}".encode()).hexdigest()[:32]
    step = LONGEST_STEP * time_scale(network.description)
    tool = f"fdi_torch {version('fdi_torch')}"
    description = model_description(name, identifier, guid, tool, step, variables)
    source = f'static const char GUID[] = "{guid}";\n{source}'
    folder, ending = ("darwin64", "dylib") if sys.platform == "darwin" else ("linux64", "so")
    with tempfile.TemporaryDirectory() as place, replacing(path) as temporary:
        built = Path(place) / f"{identifier}.{ending}"
        compile_library(source, built, [*_FLAGS, *_STATIC])
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", description)
            archive.write(built, f"binaries/{folder}/{built.name}")
            archive.writestr(f"sources/{identifier}.cpp", source)
    return variables


def fmu_source(network: TankNetwork) -> str:
    """The C++ source, in which all constants of the network are parameters; the GUID is not defined yet."""
    program = build_program(network, network.constants.names, False, adaptive=True)
    _expect_no_dead_time(network, program)
    plant = network.description
    resolution = RESOLUTION * time_scale(plant)
    control = StepControl.for_tolerance(TOLERANCE * length_scale(plant), plant, resolution)
    kernel = emit(program, False, "double", "VECTOR")
    numbers = {
        "RESOLUTION": resolution,
        "TOLERANCE": control.tolerance,
        "SHORTEST_STEP": control.shortest,
        "LONGEST_STEP": LONGEST_STEP * time_scale(plant),
    }
    constants = [f"static const double {name} = {value!r};" for name, value in numbers.items()]
    arrays = [_array("START", network.nominal.tolist()), _array("LIFTED", program.graph.lifted)]
    return "\n".join([kernel, *constants, *arrays, _FUNCTIONS.read_text(encoding="utf-8")])


def _array(name: str, values: list[float]) -> str:
    return f"static const real {name}[] = {{{', '.join(_literal(v) for v in values or [0.0])}}};"


def _literal(value: float) -> str:
    number = repr(float(value))
    return number.replace("inf", "INFINITY").replace("nan", "NAN")


def _expect_no_dead_time(network: TankNetwork, program: Program) -> None:
    late = [network.actuators()[i][0] for i in program.late_actuators]
    late += [network.description.sensors[i].name for i in program.late_sensors]
    if late:
        raise ValueError(
            f"{network.description.name}: expected effects without a dead time, got a delay at {', '.join(late)}; "
            "remove it from the plant file, and delay the signal outside the FMU"
        )


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
    """The modelDescription.xml. step: proposed communication step, s. Raises ValueError for a repeated name."""
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
