"""A valve that follows its opening with a lag."""

from __future__ import annotations

from fdi_torch.effects.pump_lag import PumpLag


class ValveLag(PumpLag):
    """What a lag is to a pump: the passage follows the opening as a first-order response.

    Typical: tau of 2 to 20 s. Nearly the same as a limited rate.
    """

    name = "valve_lag"
    places = ("valve",)
    mistaken_for = ("actuator_slew", "actuator_stuck")
