"""The estimation block: parameters by name, constants to calibrate, objectives, search and refinement."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from fdi_torch.config.problems import ConfigError, naming, shown
from fdi_torch.config.strict import Amount, Seconds, Share, Strict, quantity, quantity_at, with_known_keys
from fdi_torch.effects import all_placements, build_network, full_name, placements_for, unknown_parameter
from fdi_torch.estimate.evolution_settings import STRATEGIES, EvolutionSettings
from fdi_torch.estimate.objectives import Objective
from fdi_torch.names import matching, shortened
from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.effect import Placement
from fdi_torch.quantities import display_unit


class ParameterConfig(Strict):
    name: str = Field(description="COMPONENT.CONSTANT, COMPONENT.EFFECT (its size) or COMPONENT.EFFECT.PARAMETER")
    nominal: Amount | None = Field(None, description="nominal value, the mean of the prior")
    low: Amount | None = Field(None, description="lower bound")
    high: Amount | None = Field(None, description="upper bound")
    std: Amount | None = Field(None, description="standard deviation of the prior")

    @model_validator(mode="before")
    @classmethod
    def _a_name_alone(cls, data: Any) -> Any:
        return {"name": data} if isinstance(data, str) else data


def _auto_or_names(value: Any) -> Any:
    if value == "auto" or (isinstance(value, list) and all(isinstance(name, str) for name in value)):
        return value
    raise ValueError(f"expected auto or a list of names, got {shown(value)}")


def _auto_or_seconds(value: Any) -> Any:
    if value == "auto":
        return value
    seconds = quantity(value, "s")
    if not seconds > 0.0:
        raise ValueError(f"expected auto or a positive time, got {value}")
    return seconds


_SEARCH_KEYS = tuple(field.name for field in fields(EvolutionSettings))


class ObjectiveConfig(Strict):
    search: Objective = Field("correlation", description="what the search maximises")
    refine: Objective = Field("likelihood", description="what the refinement maximises")


class RefineConfig(Strict):
    method: Literal["lm", "none"] = Field(
        "lm", description="Levenberg-Marquardt, or none: the best candidate of the search is the result"
    )
    iterations: int = Field(50, ge=1, description="at most")


class StepConfig(Strict):
    search: Annotated[Any, BeforeValidator(_auto_or_seconds)] = Field("auto", description="integration step, s")
    refine: Annotated[Any, BeforeValidator(_auto_or_seconds)] = Field("auto", description="integration step, s")


class EstimationConfig(Strict):
    parameters: list[ParameterConfig] = Field(
        default_factory=list,
        description="names, patterns such as '*.leak', or mappings with name, low, high, nominal, std",
    )
    calibrate: Annotated[Any, BeforeValidator(_auto_or_names)] = Field(
        "auto", description="constants estimated too, with their tolerance as prior; auto: all for real data"
    )
    objective: ObjectiveConfig = Field(default_factory=ObjectiveConfig)
    search: Annotated[EvolutionSettings, BeforeValidator(lambda value: with_known_keys(value, _SEARCH_KEYS))] = Field(
        default_factory=EvolutionSettings, description=f"search of the basin; strategy: {', '.join(STRATEGIES)}"
    )
    refine: RefineConfig = Field(default_factory=RefineConfig)
    step: StepConfig = Field(default_factory=StepConfig)
    confidence: Share = Field(0.95, gt=0, lt=1, description="confidence level of intervals and of the diagnosis")
    profile: list[str] = Field(
        default_factory=list,
        description="parameters whose likelihood is profiled, for intervals that are right at bounds and on ridges",
    )
    draws: int = Field(
        0, ge=0, le=1_000_000, description="draws from the posterior by an ensemble sampler (extra draws)"
    )
    windows: Seconds | None = Field(
        None, gt=0, description="length of windows that are fitted separately, s, for faults that come and go"
    )


def matching_names(pattern: str, plant: PlantDescription) -> list[str]:
    """The full names of a name, or of all that a pattern such as '*.leak' matches, in the order of the plant.

    Raises ValueError for a pattern without a match, and for an impossible place.
    """
    if "*" not in pattern:
        return [full_name(pattern, plant)]
    known = [*(p.prefix for p in all_placements(plant)), *build_network(plant).constants.names]
    matched = [full_name(name, plant) for name in known if fnmatchcase(name, pattern)]
    if not matched:
        raise ValueError(
            f"expected a pattern such as *.leak or P1.*, got '{shortened(pattern)}', which matches nothing"
        )
    return matched


def names_in_full(names: Iterable[str], plant: PlantDescription, field: str) -> list[str]:
    """The full names. Raises ConfigError, naming the field, for a name that the plant does not have."""
    short = list(names)
    with naming(field):
        full = [full_name(name, plant) for name in short]
        constants = build_network(plant, placements_for(full)).constants
    for name, name_in_full in zip(short, full, strict=True):
        if name_in_full not in constants:
            raise ConfigError([unknown_parameter(name, constants, plant)], field)
    return full


def placements_of(names: Iterable[str], plant: PlantDescription) -> tuple[Placement, ...]:
    """The distinct effects to which the names belong. Raises ConfigError with a sentence for each unknown name, if the
    place or the effect of one is.
    """
    full: list[str] = []
    problems = []
    for name in names:
        try:
            full += matching_names(name, plant)
        except ValueError as error:
            sentences = [sentence.removeprefix(f"{name}: ") for sentence in getattr(error, "problems", (str(error),))]
            problems += [f"{name}: {sentence}" for sentence in sentences]
    placements = placements_for(full)
    if problems:
        constants = build_network(plant, placements).constants
        raise ConfigError(
            [*(unknown_parameter(name, constants, plant) for name in full if name not in constants), *problems]
        )
    return placements


def estimated_space(
    config: EstimationConfig, constants: ParameterSpace, plant: PlantDescription, real_data: bool
) -> ParameterSpace:
    """The parameters to estimate and the constants to calibrate, with the configured changes of the network's
    constants.

    Raises ConfigError for unknown or repeated names, wrong units, and bounds that exclude the nominal value.
    """
    estimated = [
        _chosen(p, f"estimate.parameters.{i}", name, constants, plant)
        for i, p in enumerate(config.parameters)
        for name in matching_names(p.name, plant)
    ]
    names = {p.name for p in estimated}
    calibrated = [constants[name] for name in _calibrated(config, constants, plant, real_data) if name not in names]
    with naming("estimate.parameters"):
        return ParameterSpace([*estimated, *calibrated])


def _chosen(
    config: ParameterConfig, place: str, name: str, constants: ParameterSpace, plant: PlantDescription
) -> Parameter:
    if name not in constants:
        raise ConfigError([unknown_parameter(name, constants, plant)], place)
    unit = constants[name].unit
    with naming(place), naming(config.name):
        given = {field: getattr(config, field) for field in ("nominal", "low", "high", "std")}
        changes = {field: quantity(value, unit) for field, value in given.items() if value is not None}
        return constants.with_changes(name, **changes)[name]


def _calibrated(
    config: EstimationConfig, constants: ParameterSpace, plant: PlantDescription, real_data: bool
) -> list[str]:
    if config.calibrate == "auto":
        return list(plant.tolerances) if real_data else []
    with naming("estimate.calibrate"):
        return matching("a constant", config.calibrate, constants.names)


def parameter_values(values: dict[str, Amount], constants: ParameterSpace, plant: PlantDescription) -> dict[str, float]:
    """{'T1.leak': 0.3} -> {'T1.leak.size': 0.3} in SI. Raises ConfigError for unknown names and wrong units."""
    si: dict[str, float] = {}
    for given, value in values.items():
        name, place = full_name(given, plant), f"simulate.faults.{given}"
        if name not in constants:
            raise ConfigError([unknown_parameter(name, constants, plant)], place)
        si[name] = quantity_at(place, value, constants[name].unit)
        low, high = constants[name].low, constants[name].high
        if not low <= si[name] <= high:
            unit, scale = display_unit(constants[name].unit, name)
            expected = f"expected a size from {scale * low:g} to {scale * high:g} {unit}".rstrip()
            raise ConfigError([f"{expected}, got {scale * si[name]:g}"], place)
    return si
