"""Whether a model explains a recording: its residuals beside the sample-to-sample noise of the readings.

    ratio_c = rms(y_c - model_c) / sigma_c  <=  UNEXPLAINED_RATIO exp(AT_95 NOISE_ERROR / sqrt(N_c))

The model is rejected if a channel c with N_c readings exceeds this: the exponential is what chance adds, because
sigma_c is estimated from the same readings. train, refit and predict all judge and word it here. train also rejects a
model that leaves correlated residuals beside faults that explain too little, see `estimate.lack_of_fit`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float

from fdi_torch.names import listed
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import quantity_text, small_length_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.repeated_readings import resolution
from fdi_torch.sample_noise import sample_noise

UNEXPLAINED_RATIO = 1.2
"""The model is rejected if the standard deviation of its residuals exceeds this multiple of the noise of a sensor."""
NOISE_ERROR = 1.23
"""Standard error of ln(rms / sample noise) of N white readings, times sqrt(N): 1.20 to 1.26 for N of 50 to 3000, by
simulation. The noise of 50 readings is known to 17 %, that of 1000 to 4 %."""
AT_95 = 1.96
EXACT = 1e-5
"""Relative error of a simulated reading: `gap.free_runs.prediction` stops at this defect. A recording without noise
that is mostly at rest has smaller second differences, and would count as unexplained by the plant that made it."""
LEAST_SHARE = 0.9
"""The model is rejected if its residuals are correlated, and its faults explain less than this share of the misfit of
the model without faults: the fault then stands for something that the model lacks. Without a fault, wrong areas of
tanks made leaks of 0.04 to 0.11, which explained 70 to 82 %. True leaks beside an area wrong by 7 % explained at least
95 %, but for one of 0.05 that was estimated as 0.016 and explained 41 % (22 simulated recordings of two tanks by
another integrator, seeds 101 to 122)."""
UNRELIABLE = "Unreliable: the model does not explain the recording"
NOT_ESTABLISHED, NONE_EXPLAINS = "not established", "none of the suspected faults explains the recording"
"""Words for the faults of such a model, whose tests assume that it explains the recording."""


def unreliable(ratio: float, share: float = 1.0) -> str:
    """Warning about a model that does not explain its recording.

    ratio: of the residuals to the noise of the sensors. share: of the misfit, that the faults explain.
    """
    if share < LEAST_SHARE:
        return (
            f"{UNRELIABLE} (residuals are correlated in time, the faults explain {100.0 * share:.0f} % of the misfit)"
        )
    size = f" (residuals {float(f'{ratio:.2g}'):g} times the sensors' noise)" if math.isfinite(ratio) else ""
    return f"{UNRELIABLE}{size}"


def kind_of(present: int, not_isolated: int, explained: bool) -> str:
    """The kind of a diagnosis with so many faults; see `Diagnosis.kind`."""
    if not explained:
        return NOT_ESTABLISHED
    if not_isolated and not present:
        return "fault not isolated"
    return ("no fault", "single fault", "multiple faults")[min(present + not_isolated, 2)]


def fault_statement(present: Sequence[str], not_isolated: Sequence[str], explained: bool) -> str:
    """The kind of a diagnosis, and its faults in words; the same on terminal, page and in a notebook."""
    nothing = "no suspected fault differs significantly from nominal" if explained else NONE_EXPLAINS
    return f"{kind_of(len(present), len(not_isolated), explained)}: {', '.join([*present, *not_isolated]) or nothing}"


def flow_words(flow: float, hole: float | None, explained: bool) -> str:
    """'changes the flow by 30 cm^3/s at the mean levels, as a sharp-edged hole of 4.8 mm would', from SI values."""
    change = "changes" if explained else "would change"
    words = f"{change} the flow by {quantity_text(flow, 'm^3/s', 3)} at the mean levels"
    return (
        f"{words}, as a sharp-edged hole of {small_length_text(hole)} would" if hole and math.isfinite(hole) else words
    )


@dataclass(frozen=True)
class Misfit:
    """ratio: standard deviation of the residuals over the noise of the readings, of the channel that exceeds its limit
    most. limit: the largest ratio of a model that explains the readings of that channel. correlated: sensors whose
    residuals are correlated in time (`estimate.whiteness`); None if that was not tested. share: the part of the misfit
    of the model without faults that the faults explain, see `explained_share`; 1 where there is no doubt about it.
    """

    ratio: float
    limit: float = UNEXPLAINED_RATIO
    correlated: tuple[str, ...] | None = None
    share: float = 1.0

    @property
    def explained(self) -> bool:
        return self.ratio <= self.limit and self.share >= LEAST_SHARE

    @property
    def warning(self) -> str:
        """A warning if the model does not explain the recording, so that no estimate can be trusted; else empty."""
        return "" if self.explained else unreliable(self.ratio, self.share)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the correlation of the residuals means for a model that explains the recording."""
        if not (self.correlated and self.explained):
            return ()
        return (
            f"the residuals of {listed(self.correlated)} are correlated in time (Ljung-Box test): the model lacks "
            "something small, or the noise is slow; the standard errors allow for this correlation, but not for what "
            "the model lacks",
        )

    def headline(self, text: str) -> str:
        """The text, preceded by the warning if there is one."""
        return f"{self.warning}; {text}" if self.warning else text

    def to_dict(self) -> dict[str, bool | float | list[str] | None]:
        ratio = self.ratio if math.isfinite(self.ratio) else None
        plain: dict[str, bool | float | list[str] | None] = {"explained": self.explained, "unexplained_ratio": ratio}
        if self.correlated is not None:
            plain |= {"correlated": list(self.correlated), "explained_share": self.share}
        return plain


def misfit_of(rms: Mapping[str, float], recordings: Sequence[Recording], plant: PlantDescription) -> Misfit:
    """The misfit of a model whose residuals along these recordings have the root mean square rms, SI by sensor."""
    columns = recordings[0].output_columns(plant.outputs())
    values = torch.cat([r.outputs[:, columns] for r in recordings]).nan_to_num()
    weight = torch.cat([r.mask[:, columns] for r in recordings])
    return channel_misfit(values.new_tensor([rms[sensor.name] for sensor in plant.sensors]), values, weight)


def channel_misfit(
    rms: Float[torch.Tensor, " C"], values: Float[torch.Tensor, "S C"], weight: Float[torch.Tensor, "S C"]
) -> Misfit:
    """The misfit of residuals of root mean square rms. values: the readings; weight 0 masks one."""
    noise, counts = torch.maximum(sample_noise(values, weight), least_noise(values, weight)), (weight > 0).sum(dim=0)
    ratio = torch.where(counts > 0, rms / noise, 0.0).nan_to_num(nan=math.inf, posinf=math.inf).tolist()
    limit = (UNEXPLAINED_RATIO * (AT_95 * NOISE_ERROR / counts.clamp(min=1).sqrt()).exp()).tolist()
    return worst(map(Misfit, ratio, limit))


def worst(misfits: Iterable[Misfit]) -> Misfit:
    """The one that exceeds its limit most."""
    return max(misfits, key=lambda each: each.ratio / each.limit)


def least_noise(values: Float[torch.Tensor, "S C"], weight: Float[torch.Tensor, "S C"]) -> Float[torch.Tensor, " C"]:
    """Smallest standard deviation (C,) that noise of such readings can have: that of rounding, or of the simulation.

    Rounding in steps of q adds q^2 / 12 to the variance of the readings, which second differences of a slow level do
    not show.
    """
    valid = [values[weight[:, c] > 0, c] for c in range(values.shape[1])]
    least = [
        max(resolution(x) / math.sqrt(12.0), EXACT * float(x.abs().max()), 1e-12) if len(x) else 1.0 for x in valid
    ]
    return values.new_tensor(least)
