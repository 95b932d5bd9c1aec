"""`fdi train`: what it does and prints. Its options: `options/train.py`.

Path: cli.train.run → config.run_file.load_run → jobs.train.train → jobs.run_setup.recordings_of →
jobs.run_setup.fitting_of → estimate.hybrid.estimate_parameters → estimate.evolution.evolve →
estimate.levenberg_marquardt.levenberg_marquardt → estimate.uncertainty.make_estimate → estimate.diagnosis.diagnose →
jobs.train.draw
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from functools import partial

from fdi_torch.amounts import end_words, parameter_words
from fdi_torch.cli import DONE, NOT_CONVERGED
from fdi_torch.cli.explained import exit_code, say_doubts, say_first
from fdi_torch.cli.options import live, overrides
from fdi_torch.cli.screen import Screen, log_words
from fdi_torch.clock import clock_unit, show_clock
from fdi_torch.config.run_file import load_run
from fdi_torch.estimate.fitting import FIRST_READINGS
from fdi_torch.estimate.windows import Stretch, WindowFault
from fdi_torch.jobs.train import TrainResult, train
from fdi_torch.jobs.windowed_fit import WindowedFit, fit_windows
from fdi_torch.parameters import ParameterName
from fdi_torch.quantities import display_unit, quantity_text
from fdi_torch.recording import Recording
from fdi_torch.report.numbers import HEADER, estimate_cells


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    if arguments.config is None:
        screen.note(
            "built-in example: a recording of the plant three_tank with four faults is simulated, then diagnosed; "
            "--config FILE diagnoses yours (fdi new run writes one)"
        )
    job = load_run(arguments.config, overrides(arguments))
    if job.config.estimate.windows is not None:
        with screen.progress(job.name) as advance:
            windowed_fit = fit_windows(job, advance)
        show_windows(windowed_fit, screen)
        return DONE
    with live(arguments, job.name, screen) as listener, screen.progress(job.name) as advance:
        done = train(job, advance, arguments.resume, listener)
    show(done, screen)
    screen.result(as_json(done))
    if done.result.estimate.status != "converged":
        return NOT_CONVERGED
    return exit_code(done.result.diagnosis.misfit)


def show(done: TrainResult, screen: Screen) -> None:
    """Print the estimate as a table with units, the diagnosis, and the paths of log and pictures.

    Doubts about the recordings come first, then a model that does not explain them.
    """
    say_doubts(done.doubts, screen)
    final, diagnosis = done.result.estimate, done.result.diagnosis
    show_clock(r.clock_zero for r in done.fitting.recordings)
    network, space = done.fitting.networks[0], done.fitting.space
    onsets = [f"{place.prefix}.onset" for place in network.placements]
    onsets = [name for name in onsets if name in network.constants and name not in space][:1]
    hints = [f"a fault that begins within the recording: also estimate its onset, such as {name}" for name in onsets]
    say_first(diagnosis.misfit, screen, *hints)
    if final.warning:
        screen.say(f"{final.warning}.")
        screen.say("- next: estimate fewer parameters, take a longer recording, or raise estimate.refine.iterations")
        screen.say()
    rows = []
    for p, value, std in zip(space, final.value.tolist(), final.std.tolist(), strict=True):
        unit, *cells = estimate_cells(p.name, p.unit, value, std, final.at_bounds.get(p.name, ""))
        exact = [p.nominal, *([done.truth.get(p.name, math.nan)] if done.truth else [])]
        cells += [_plain(p.name, p.unit, number) for number in exact]
        rows.append([p.name, clock_unit(unit, ParameterName.parse(p.name).field, value), *cells])
    header = ("parameter", *HEADER, "nominal", *(["simulated"] if done.truth else []))
    screen.table("", header, rows, left=2)
    if any(ParameterName.parse(name).field == "start_level" for name in space.names):
        screen.say(f"nominal of a start level: the median of the first {FIRST_READINGS} readings")
    if final.combinations:
        combined = [(c.formula, (c.parameters[0], c.unit), c) for c in final.combinations]
        rows = [[name, *estimate_cells(*of, c.value, c.std), _plain(*of, c.nominal)] for name, of, c in combined]
        screen.say()
        screen.table("determined combinations", ("combination", *HEADER, "nominal"), rows, left=2)
    screen.say()
    for line in in_words(done):
        screen.say(line)
    show_uncertainty(done, screen)
    sensors = [done.fitting.plant.channel_words(c) for c in done.fitting.recordings[0].output_names]
    rho = ", ".join(f"{n} {float(r):.6f}" for n, r in zip(sensors, done.result.correlation, strict=True))
    search, refinement = done.result.steps
    screen.say(f"correlation of readings and model: {rho}")
    screen.say(f"integration step: {search:g} s in the search, {refinement:g} s in the refinement")
    screen.say(f"simulated by the {done.result.engine}")
    screen.say(f"confidence of the whole statement: {100 * diagnosis.confidence:g} %")
    screen.say(log_words(done.log))
    for picture in done.pictures:
        screen.say(f"picture: {picture}")


def _plain(name: str, si_unit: str, value: float) -> str:
    """An exact SI value in its unit for display; empty if there is none."""
    return "" if math.isnan(value) else f"{display_unit(si_unit, name)[1] * value:.5g}"


def show_uncertainty(done: TrainResult, screen: Screen) -> None:
    """Print the intervals of the profiles and of the draws, with what makes them unreliable."""
    for profile in done.profiles:
        screen.say(f"- profile likelihood of {profile.headline}")
    if (draws := done.result.estimate.draws) is not None:
        screen.show(draws.table(), 2, "draws from the posterior")
        screen.say(draws.headline)
        screen.say()


def in_words(done: TrainResult) -> list[str]:
    """The diagnosis, one sentence per line."""
    diagnosis, final = done.result.diagnosis, done.result.estimate
    lines = not_counted(done.fitting.recordings)
    if diagnosis.faults:
        lines.append(diagnosis.statement)
    changes = "changes" if diagnosis.misfit.explained else "would change"
    for fault in diagnosis.present:
        shown = partial(quantity_text, si_unit=fault.unit, name=fault.name)
        parts = [f"{shown(fault.value)} instead of {shown(fault.nominal)} ({done.fitting.space[fault.name].meaning})"]
        if fault.flow is not None:
            parts.append(f"{changes} the flow by {quantity_text(fault.flow, 'm^3/s', 3)} at the mean levels")
        if fault.hole is not None:
            parts.append(f"equivalent to a sharp-edged hole of {1e3 * fault.hole:.3g} mm")
        lines.append(f"- {parameter_words(fault.name)}: " + ", ".join(parts))
    lines += [f"- {end_words(*each)}" for each in final.at_bounds.items()]
    lines += [f"- {sentence}" for sentence in final.undetermined]
    return lines


def not_counted(recordings: Sequence[Recording]) -> list[str]:
    """Notes on the rows of each file: missing or masked readings, unknown inputs."""
    lines = []
    for source in dict.fromkeys(r.source for r in recordings):
        masks = [r.mask for r in recordings if r.source == source]
        missing, total = sum(int((~mask).sum()) for mask in masks), sum(mask.numel() for mask in masks)
        if missing:
            lines.append(f"{source}: {missing} of {total} readings are missing or masked and do not count")
        if len(masks) > 1:
            lines.append(f"{source}: an input is sometimes unknown; fitted as {len(masks)} segments with known inputs")
    return lines


def as_json(done: TrainResult) -> dict[str, object]:
    result = done.result
    return {
        "format": "fdi_torch.train/1",
        "estimate": result.estimate.to_dict(),
        "doubts": list(done.doubts),
        "truth": done.truth,
        "diagnosis": {
            "kind": result.diagnosis.kind,
            "confidence": result.diagnosis.confidence,
            **result.diagnosis.misfit.to_dict(),
            "faults": result.diagnosis.faults,
            "not_isolated": result.diagnosis.not_isolated,
        },
        "correlation": result.correlation.tolist(),
        "search": {"reason": result.search.reasons()[0], "generations": int(result.search.generations[0])},
        "steps_s": list(result.steps),
        "engine": result.engine,
        "log": str(done.log),
        "pictures": [str(p) for p in done.pictures],
        **({"profiles": [profile.to_dict() for profile in done.profiles]} if done.profiles else {}),
        **({"draws": result.estimate.draws.to_dict()} if result.estimate.draws else {}),
    }


LARGEST_RELATIVE_ERROR = 10.0  # a size with a larger standard error is not shown as a number
MARKS = {"absent": "-", "cannot tell": "?"}


def show_windows(fit: WindowedFit, screen: Screen) -> None:
    """Print one line per window and per period. Sizes without a unit are relative, flows hold at the mean levels."""
    say_doubts(fit.doubts, screen)
    names = [_name(fault) for fault in fit.windows[0].faults] if fit.windows else []
    rows = [[f"{w.start:g}", f"{w.stop:g}", *(_cell(fault) for fault in w.faults)] for w in fit.windows]
    title = "windows (?: not determined, for example with levels at rest or an empty tank)"
    screen.table(title, ["from, s", "to, s", *names], rows, left=0)
    screen.say()
    rows, (flow_unit, flow_scale) = [], display_unit("m^3/s")
    for s in fit.stretches:
        flow = "" if s.flow is None else f"{flow_scale * s.flow:.3g}"
        rows.append([_name(s), f"{s.start:g}", f"{s.stop:g}", *_size(s, "> "), flow])
    screen.table("present", ("fault", "from, s", "to, s", "size", "std error", f"flow, {flow_unit}"), rows)
    screen.say(f"step of the simulation: {fit.step:g} s")
    screen.say(log_words(fit.log))
    screen.result(
        {
            "format": "fdi_torch.windows/1",
            "doubts": fit.doubts,
            "windows": fit.windows,
            "stretches": fit.stretches,
            "step": fit.step,
            "log": str(fit.log),
        }
    )


def _size(fault: WindowFault | Stretch, beyond: str) -> tuple[str, str]:
    """Size and standard error in a practical unit; `beyond` and the size without an error if that is too large."""
    _, scale = display_unit(fault.unit, fault.name)
    size, std = scale * fault.size, scale * fault.std
    shown = f"{size:.3f}" if fault.unit == "1" else f"{size:.4g}"
    return (shown, f"{std:.2g}") if std < LARGEST_RELATIVE_ERROR * max(abs(size), 1.0) else (f"{beyond}{shown}", "")


def _name(fault: WindowFault | Stretch) -> str:
    unit, _ = display_unit(fault.unit, fault.name)
    return f"{parameter_words(fault.name)}, {unit}" if unit else parameter_words(fault.name)


def _cell(fault: WindowFault) -> str:
    return " ± ".join(part for part in _size(fault, "> ") if part) if fault.state == "present" else MARKS[fault.state]
