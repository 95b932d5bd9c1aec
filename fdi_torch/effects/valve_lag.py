"""A valve that follows its command with a first-order lag."""

from __future__ import annotations

from fdi_torch.effects.pump_lag import PumpLag


class ValveLag(PumpLag):
    """tau dv/dt = u - v, as for a pump (`pump_lag`), with the opening v.

    Typical: tau of 2 to 20 s. Nearly the same as a limited slew rate.
    """

    name = "valve_lag"
    places = ("valve",)
    mistaken_for = ("actuator_slew", "actuator_stuck")
