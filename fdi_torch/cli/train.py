"""`fdi train`: what it does and prints. Its options: `options/train.py`.

Path: cli.train.run → config.run_file.load_run → jobs.train.train → jobs.run_setup.recordings_of →
jobs.run_setup.fitting_of → estimate.hybrid.estimate_parameters → estimate.evolution.evolve →
estimate.levenberg_marquardt.levenberg_marquardt → estimate.uncertainty.make_estimate → estimate.diagnosis.diagnose →
jobs.train.draw
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from fdi_torch.amounts import end_words, parameter_words
from fdi_torch.cli import DONE, NOT_CONVERGED
from fdi_torch.cli.explained import exit_code, say_doubts, say_first
from fdi_torch.cli.options import live, overrides
from fdi_torch.cli.screen import Screen, log_words
from fdi_torch.clock import show_clock
from fdi_torch.config.run_file import load_run
from fdi_torch.estimate.fitting import FIRST_READINGS
from fdi_torch.estimate.misfit import flow_words
from fdi_torch.jobs.train import TrainResult, train
from fdi_torch.jobs.windowed_fit import WindowedFit, fit_windows
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.exact_constants import exact_constants_sentence
from fdi_torch.quantities import quantity_text
from fdi_torch.recording import Recording
from fdi_torch.report.sections.windows import period_table, size_text
from fdi_torch.tables import Table


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
    recordings = done.fitting.recordings
    show_clock((r.clock_zero for r in recordings), (float(r.time[0]) for r in recordings))
    network, space = done.fitting.networks[0], done.fitting.space
    onsets = [f"{place.prefix}.onset" for place in network.placements]
    onsets = [name for name in onsets if name in network.constants and name not in space][:1]
    hints = [f"a fault that begins within the recording: also estimate its onset, such as {name}" for name in onsets]
    say_first(diagnosis.misfit, screen, *hints)
    if final.warning:
        screen.say(f"{final.warning}.")
        screen.say("- next: estimate fewer parameters, take a longer recording, or raise estimate.refine.iterations")
        screen.say()
    screen.show(done.brief())
    if any(ParameterName.parse(name).field == "start_level" for name in space.names):
        screen.say(f"nominal of a start level: the median of the first {FIRST_READINGS} readings")
    if done.truth and (remark := exact_constants_sentence(done.fitting.plant, space.names, network.constants.names)):
        screen.say(remark)
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


def show_uncertainty(done: TrainResult, screen: Screen) -> None:
    """Print the intervals of the profiles and of the draws, with what makes them unreliable."""
    for profile in done.profiles:
        screen.say(f"- profile likelihood of {profile.headline}")
    if (draws := done.result.estimate.draws) is not None:
        screen.show(replace(draws.table(), title="draws from the posterior"))
        screen.say(draws.headline)
        screen.say()


def in_words(done: TrainResult) -> list[str]:
    """The diagnosis, one sentence per line."""
    diagnosis, final = done.result.diagnosis, done.result.estimate
    lines = not_counted(done.fitting.recordings)
    if diagnosis.faults:
        lines.append(diagnosis.statement)
    for fault in diagnosis.present:
        shown = partial(quantity_text, si_unit=fault.unit, name=fault.name)
        parts = [f"{shown(fault.value)} instead of {shown(fault.nominal)} ({done.fitting.space[fault.name].meaning})"]
        if fault.flow is not None:
            parts.append(flow_words(fault.flow, fault.hole, diagnosis.misfit.explained))
        lines.append(f"- {parameter_words(fault.name)}: " + ", ".join(parts))
    if diagnosis.rivals and diagnosis.misfit.explained:
        lines += [f"- {sentence}" for sentence in diagnosis.rivals.sentences]
    if diagnosis.claims and (remark := done.exact_constants):
        lines.append(f"- {remark}")
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
            "rivals": result.diagnosis.rivals,
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


MARKS = {"absent": "-", "cannot tell": "?"}


def show_windows(fit: WindowedFit, screen: Screen) -> None:
    """Print one line per window and per period. Sizes without a unit are relative, flows hold at the mean levels."""
    say_doubts(fit.doubts, screen)
    names = [parameter_words(fault.name) for fault in fit.windows[0].faults] if fit.windows else []
    rows = [
        (w.start, w.stop, *(size_text(vars(f)) if f.state == "present" else MARKS[f.state] for f in w.faults))
        for w in fit.windows
    ]
    title = "windows (?: not determined, for example with levels at rest or an empty tank)"
    screen.show(Table(("from, s", "to, s", *names), rows, title, words=0))
    screen.say()
    screen.show(period_table([vars(stretch) for stretch in fit.stretches]))
    screen.say(f"step of the simulation: {fit.step:g} s")
    screen.say(log_words(fit.log))
    numbers = {"doubts": fit.doubts, "windows": fit.windows, "stretches": fit.stretches, "step": fit.step}
    screen.result({"format": "fdi_torch.windows/1", **numbers, "log": str(fit.log)})
