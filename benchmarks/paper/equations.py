"""Table of the paper's equations and the code that implements them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Equation:
    """numbers: of the paper's equations. says: their meaning. places: 'module:name' below fdi_torch, or of benchmarks;
    empty: not built.
    """

    numbers: tuple[int, ...]
    says: str
    places: tuple[str, ...]

    @property
    def label(self) -> str:
        first, last = self.numbers[0], self.numbers[-1]
        return f"({first})" if first == last else f"({first})–({last})"


EQUATIONS = (
    Equation((1,), "a plant whose rates are linear in unknown parameters", ("plant.network:TankNetwork.forward",)),
    Equation((2,), "each parameter stays within a range about its nominal value", ("parameters:Parameter",)),
    Equation((3,), "the same plant at its nominal parameters", ("parameters:ParameterSpace.nominal",)),
    Equation((4,), "output error: reading less nominal prediction", ("monitor.observer:Observer.run",)),
    Equation((5,), "the model that is fitted has the plant's structure", ("estimate.fitting:Fitting.engines",)),
    Equation((6,), "plant and model start from the same levels", ("estimate.fitting:start_levels",)),
    Equation((7,), "and share them ever after", ("estimate.hybrid:HybridResult",)),
    Equation((8,), "full correlation means readings that are an affine map of the prediction",
             ("monitor.diagnosability:without_gain_and_offset", "estimate.objectives:correlation_loss")),
    Equation((9, 10, 11, 12), "equal rates at equal states give equal parameters; here a rank and standard errors, not "
             "an assumption", ("estimate.information:certainty", "estimate.combinations:undetermined_groups")),
    Equation((13,), "fit by the sum of correlations within a box",
             ("estimate.objectives:Problem.cost", "estimate.hybrid:estimate_parameters")),
    Equation((14,), "Luenberger-like observer with nominal parameters",
             ("monitor.observer:Observer", "monitor.noise_model:learn_noise")),
    Equation((15,), "conventional adaptive observer: parameters integrate the residual",
             ("benchmarks.paper.adaptive_observer:adaptive_observer",
              "benchmarks.paper.adaptive_observer:adaptive_gain")),
    Equation((16,), "adaptive observer: the newest fitted parameters go back into it",
             ("monitor.window_monitor:WindowMonitor", "monitor.window_estimators:evolution",
              "monitor.monitor:Monitor")),
    Equation((17, 18), "Pearson's correlation of reading and prediction, from sums over the window",
             ("estimate.objectives:correlation_loss", "estimate.objectives:correlation_expansion")),
    Equation((19,), "means over the window", ("simulate.engine:Readings.centre",)),
    Equation((20,), "first population, uniform in the box", ("estimate.generation:init",)),
    Equation((21,), "mutant: one member and a scaled difference of two others", ("estimate.generation:ask",)),
    Equation((22,), "binomial crossover with at least one component of the mutant", ("estimate.generation:ask",)),
    Equation((23,), "the better of parent and candidate survives", ("estimate.generation:tell",)),
    Equation((24,), "levels of three tanks: inflow less outflow over area", ("plant.network:TankNetwork.level_rates",)),
    Equation((25,), "states, readings and pump flows",
             ("plant.network:TankNetwork.read", "config.plant_file:load_plant")),
    Equation((26,), "the fault-free plant from known start levels", ("simulate.simulated_recording:clean_readings",)),
    Equation((27,), "a leak: Torricelli's law through a hole", ("effects.leak:Leak.inflow",)),
    Equation((28,), "plugging: a share of a pipe's flow is lost", ("effects.plugging:Plugging.flow",)),
    Equation((29,), "the balance of each tank with all faults", ("plant.network:TankNetwork.net_inflows",)),
    Equation((30,), "a leak's size as a share of a pipe's capacity", ("plant.description:Tank",)),
    Equation((31,), "the five fault parameters",
             ("effects.leak:Leak", "effects.net_outlet:NetOutlet", "effects.openness:Openness")),
    Equation((32, 33), "rates as F(x) θ + B u", ("plant.network:TankNetwork.forward",)),
    Equation((34,), "residual of each reading", ("monitor.observer:Observation",)),
    Equation((35,), "the fit of five parameters in their box",
             ("estimate.hybrid:search_box", "estimate.objectives:Problem.cost")),
)  # fmt: skip

STATEMENTS = (
    ("Definitions 1–3", "which faults can be detected, isolated and sized; from computed signatures and from structure",
     ("monitor.diagnosability:diagnosability", "monitor.structural_analysis:structure_of")),
    ("Theorem 1", "what must hold for that, and what correlation alone never sees",
     ("monitor.diagnosability:diagnosability", "monitor.diagnosability:without_gain_and_offset")),
)  # fmt: skip
"""(what, meaning, places) of statements that the paper makes without an equation number."""

ERRATA = (
    ("(29), (31), section 5", "With the signs of (29) the net outlet's parameter is −1 without a fault and stands "
     "beside a plus sign; section 5 and the tables take +1. With a plus sign and +1, tank 2 fills for ever.",
     "Outflow with a minus sign, nominal +1. A leak of tank 2 makes it larger than 1, beyond the paper's range."),
    ("(31), (33)", "Some fault terms stand without the division by the tank's area, and so does all of F.",
     "Every flow is divided by the area."),
    ("(13), (16), (35)", "The sum of correlations less n is to be minimised; it is at most 0, and 0 is the best fit.",
     "n less the sum is minimised."),
    ("Table 2, third row", "The estimate of θ₃ repeats that of θ₂ to all digits; the fault is 0.5.",
     "Left out of the comparison as a misprint."),
    ("(4), (34) against section 3.2", "The residual is reading less prediction in one place, the opposite in another.",
     "Reading less prediction."),
    ("Theorem 1", "Full correlation gives only an affine relation between outputs; equality is put in as a condition. "
     "A wrong gain or offset of a sensor, or a fit that shows one, is not seen.",
     "A likelihood is offered beside the correlation and used for the refinement; the tables show both."),
    ("Theorem 1, condition 5 and section 3.2", "Condition numbers are cited that do not match the list.",
     "Read as: the states agree."),
    ("Sections 4 and 5", "Inputs, start levels, window, sampling, population, F, CR, generations, the meaning of SNR "
     "and the faults of Figures 6 and 7 are not given.", "The run files under `configs/paper` say what is taken."),
    ("Table 3, SNR 40", "The estimate of θ₂ is off by 0.04, some seventy times what noise of that level explains.",
     "Printed as it is."),
)  # fmt: skip
"""(where, what is wrong in the paper, what is implemented)."""
