"""A pipe whose law lies between two laws of the library."""

from __future__ import annotations

import pytest

from fdi_torch.gap.diagnose import Settings, diagnose
from tests.test_gap import nominal_plant, recorded


@pytest.mark.slow
def test_two_laws_at_one_place_are_told_next_to_one_law_that_no_library_has() -> None:
    """Before the recording is seen, one law that no library has is more likely than two of the library."""
    values = {"P13.laminar_flow.transition_head": 0.1, "P13.flow_exponent.excess": -0.3}
    library = ("laminar_flow", "flow_exponent", "pump_gain", "sensor_bias", "leak")
    answer = diagnose(nominal_plant(), recorded(values, 81), settings=Settings(library))
    first, second = answer.posterior[:2]
    assert first.causes == (("unknown", "P13"),)
    assert set(second.causes) == {("laminar_flow", "P13"), ("flow_exponent", "P13")}
