"""The sections of a plant file for tanks and flow components, made from the fields that each kind declares."""

from __future__ import annotations

from dataclasses import MISSING, Field, fields
from typing import Annotated, Any, get_type_hints

import pydantic

from fdi_torch.config.strict import Amount, Strict, quantity_of
from fdi_torch.plant.components import Component, Tank
from fdi_torch.plant.description import FLOW_KINDS


def component_sections(base: type[Strict]) -> type[Strict]:
    """The model `base` with one mapping of components by name for each kind: `tanks`, `pipes` and others."""
    sections: dict[str, Any] = {"tanks": (_components(Tank), ...)}
    sections |= {kind.part(): (_components(kind), pydantic.Field(default_factory=dict)) for kind in FLOW_KINDS}
    return pydantic.create_model(f"{base.__name__}WithComponents", __base__=base, **sections)


def _components(kind: type[Component]) -> Any:
    """Mapping of names to components of a kind, with a key for each field that has a meaning in plant files."""
    hints = get_type_hints(kind)
    keys: dict[str, Any] = {f.name: _key(f, hints[f.name]) for f in written_fields(kind)}
    return dict[str, pydantic.create_model(f"{kind.__name__}Config", __base__=Strict, **keys)]  # type: ignore[misc]


def written_fields(kind: type[Component]) -> list[Field[Any]]:
    """The fields of a kind that plant files have."""
    return [f for f in fields(kind) if "meaning" in f.metadata]  # type: ignore[arg-type]


def written_default(field: Field[Any]) -> Any:
    """The value of a field that a plant file leaves out; MISSING if it is required."""
    return field.metadata.get("written_default", field.default)


def _key(field: Field[Any], hint: Any) -> tuple[Any, Any]:
    meta, default = field.metadata, written_default(field)
    annotation = hint
    if "unit_field" in meta:
        annotation = Amount
    elif "unit" in meta:
        annotation = Annotated[float, *quantity_of(meta["unit"])]
        if default is None:
            none = pydantic.BeforeValidator(lambda value: None if value == meta["none"] else value)
            annotation = Annotated[annotation | None, none]
    return annotation, pydantic.Field(
        ... if default is MISSING else default,
        description=meta["meaning"],
        ge=meta.get("least"),
        le=meta.get("most"),
    )
