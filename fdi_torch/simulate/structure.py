"""Keys of caches for what was traced from a plant: plants with equal equations share it."""

from __future__ import annotations

from collections.abc import Sequence

from fdi_torch.plant.network import TankNetwork


class Structure:
    """A network as the key of a cache: two are equal if all that their equations depend on is equal."""

    def __init__(self, key: tuple[object, ...], network: TankNetwork) -> None:
        self.key, self.network, self._hash = key, network, hash(key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Structure) and self.key == other.key


def structure_of_rates(network: TankNetwork, names: Sequence[str]) -> Structure:
    """For dh/dt as a function of the state, the actuators' outputs and the parameters `names`."""
    plant = network.description
    parts = type(network), network.may_overflow, plant.gravity, plant.tanks, *plant.flow_components()
    effects = tuple((p.location, p.effect) for p in network.placements)
    return Structure((parts, effects, network.constants.names, tuple(names)), network)


def structure_of(network: TankNetwork, names: Sequence[str]) -> Structure:
    """For all equations from the input channels to the readings."""
    of_rates = structure_of_rates(network, names)
    return Structure((*of_rates.key, network.description.sensors), network)
