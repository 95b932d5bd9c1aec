"""Remarks on calibration constants that the fit moved: beyond their tolerances, or far within generous ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fdi_torch.names import listed
from fdi_torch.quantities import quantity_text

OFF_TOLERANCES = 2.0
"""Tolerances by which a constant must have moved to be off its nominal value."""
NOTICEABLE_SHARE = 0.05
"""Share of its value by which a constant within its tolerance must have moved to be mentioned: as by a small fault."""
CERTAIN_ERRORS = 3.0
"""Standard errors that a move within the tolerance must exceed."""

Constants = Mapping[str, Mapping[str, Any]]
"""By full name: nominal, tolerance, augmented (fitted with the causes, if there are any), std and unit, SI."""


def constant_remarks(constants: Constants, has_causes: bool) -> list[str]:
    """Constants that are off their nominal values come first, because they put the whole answer into doubt."""
    moves = {name: c["augmented"] - c["nominal"] for name, c in constants.items()}
    off = [name for name, c in constants.items() if abs(moves[name]) > OFF_TOLERANCES * c["tolerance"]]
    noticed = {n: max(NOTICEABLE_SHARE * abs(c["nominal"]), CERTAIN_ERRORS * c["std"]) for n, c in constants.items()}
    within = [n for n, c in constants.items() if n not in off and c["nominal"] and abs(moves[n]) > noticed[n]]
    remarks = []
    if off:
        still, one = "even with the causes, " if has_causes else "", len(off) == 1
        each = [f"{name} ({_fitted(constants[name], name)}, not {_nominal(constants[name], name)})" for name in off]
        remarks.append(
            f"{still}{listed(each)} {'is' if one else 'are'} more than {OFF_TOLERANCES:g} tolerances off "
            f"{'its nominal value' if one else 'their nominal values'}: calibrate the plant file with a fault-free "
            "recording (fdi refit --adopt), then repeat the diagnosis with the calibrated file"
        )
    if within:
        each = [
            f"{name} from {_nominal(c, name)} to {_fitted(c, name)} ({100.0 * moves[name] / c['nominal']:+.2g} %)"
            for name in within
            for c in [constants[name]]
        ]
        remarks.append(
            f"the fit moved {listed(each)}, within {'its tolerance' if len(within) == 1 else 'their tolerances'}: a "
            "fault with the same effect would be taken for this; if the recording may contain one, calibrate with a "
            "fault-free recording (fdi refit --adopt --narrow), then repeat the diagnosis with the calibrated file"
        )
    return remarks


def _nominal(constant: Mapping[str, Any], name: str) -> str:
    return quantity_text(constant["nominal"], constant["unit"], name=name)


def _fitted(constant: Mapping[str, Any], name: str) -> str:
    return quantity_text(constant["augmented"], constant["unit"], name=name)
