"""`fdi predict`: what it does and prints. Its options: `options/predict.py`.

Path: cli.predict.run → config.loaded_recordings.named_recordings → gap.free_runs.prediction.predict →
estimate.misfit.misfit_of → recordings.check.doubts_about → cli.explained.say_first → report.fit_figure.fit_figure
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from fdi_torch.cli.explained import exit_code, say_doubts, say_first
from fdi_torch.cli.screen import Screen
from fdi_torch.clock import MOMENTS
from fdi_torch.config.channels import expect_columns
from fdi_torch.config.loaded_recordings import load_recordings, named_recordings
from fdi_torch.config.plant_file import chosen_plant, load_plant
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.config.yaml_files import YAML_ENDINGS
from fdi_torch.effects import build_network
from fdi_torch.estimate.misfit import Misfit
from fdi_torch.gap.constant_remarks import OFF_TOLERANCES
from fdi_torch.gap.free_runs.prediction import Prediction, predict
from fdi_torch.jobs.python_results import FreeRun, sensor_unit, shown_errors
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import quantity_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import doubts_about
from fdi_torch.report.fit_figure import fit_figure
from fdi_torch.report.style import save
from fdi_torch.tables import Table


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    torch.set_num_threads(1)
    plant = chosen_plant(arguments.plant)
    other = load_plant(arguments.beside) if arguments.beside else None
    names = [*arguments.recordings, *arguments.recording]
    if not names:
        raise ValueError("expected a recording, got none; name a CSV, MCAP or YAML file")
    recordings = [r for name in names for r in _recordings(name, plant, arguments)]
    with screen.progress("predict") as advance:
        runs = []
        for k, recording in enumerate(recordings):
            advance(k / len(recordings), Path(recording.source).name)
            runs.append(FreeRun(plant, recording, _predict(plant, recording, arguments)))
        advance(1.0, "done")
    misfits = [run.misfit for run in runs]
    worst = max(misfits, key=lambda misfit: misfit.ratio)
    name = Path(recordings[misfits.index(worst)].source).name
    which = [f"of {len(recordings)} free runs, that along {name} is the worst"] if len(recordings) > 1 else []
    calibrate = ["constants with a tolerance have the values of the plant file here; fdi refit --adopt fits them"]
    hints = [*_moments_of_another_recording(plant), *(calibrate if plant.tolerances else [])]
    doubts = doubts_about(recordings, plant)
    say_doubts(doubts, screen)
    say_first(worst, screen, *hints, about=which)
    settle = arguments.settle
    first = f"the first {arguments.start_samples} samples" if settle is None else f"the first {settle:g} s"
    if settle is None and max(map(len, recordings)) <= arguments.start_samples:
        first = "all samples: a longer recording would test the prediction"
    screen.say(f"free run of {plant.name}, initial levels from {first}")
    before = [FreeRun(other, r, _predict(other, r, arguments, vary=())) for r in recordings] if other else []
    own_name, other_name = _names(plant.name, arguments)
    rows = [(own_name, *_row(run, plant)) for run in runs] + [(other_name, *_row(run, plant)) for run in before]
    units = (f"{s.name}, {sensor_unit(s)}" for s in plant.sensors)
    header = ("plant", "recording", "from, s", "to, s", *units, "start at")
    alone = 0 if other else 1  # without the column of plants
    title = "root mean square error" + ("" if settle is None else f" after the first {settle:g} s")
    screen.show(Table(header[alone:], [row[alone:] for row in rows], title, digits=4))
    for run in runs:
        _own_constants(run, screen)
    if arguments.picture:
        drawn = {other_name: before[-1].prediction.readings} if before else {}
        drawn[own_name] = runs[-1].prediction.readings
        title = misfits[-1].headline(f"free run along {Path(recordings[-1].source).name}")
        figure = fit_figure(recordings[-1], drawn, title, plant, plant.outputs())
        screen.note(f"picture: {save(figure, Path(arguments.picture))}")
    results = [_result(run, misfit, arguments) for run, misfit in zip(runs, misfits, strict=True)]
    several = {"format": "fdi_torch.predictions/1", "runs": results}
    screen.result((results[0] if len(results) == 1 else several) | {"doubts": doubts})
    return exit_code(worst)


def _predict(
    plant: PlantDescription, recording: Recording, arguments: argparse.Namespace, vary: Sequence[str] | None = None
) -> Prediction:
    patterns = arguments.vary if vary is None else vary
    return predict(plant, recording, arguments.start_samples, settle=arguments.settle, vary=patterns)


def _recordings(name: str, plant: PlantDescription, arguments: argparse.Namespace) -> list[Recording]:
    if Path(name).suffix in YAML_ENDINGS:
        return named_recordings(name, plant, Path.cwd())
    columns = _constants(arguments, plant)
    constants = "if it was constant, add --constant {inputs}=0 (--from and --to select a part); "
    expect_columns(name, Path.cwd(), plant, columns, constants)
    limits = {key: f"{vars(arguments)[key]} s" for key in ("start", "stop") if vars(arguments)[key] is not None}
    config = RecordingConfig.model_validate({"file": name, "columns": columns, **limits})
    return [part.recording for part in load_recordings([config], plant, Path.cwd())]


def _names(name: str, arguments: argparse.Namespace) -> tuple[str, str]:
    """Names of the plant and of the one beside it: those of their files, with folders if they have one name, since the
    key `name` of copied plant files is often the same. Alone, the name of the plant."""
    if not arguments.beside:
        return name, ""
    stems = Path(arguments.plant).stem, Path(arguments.beside).stem
    return stems if stems[0] != stems[1] else (arguments.plant, arguments.beside)


def _moments_of_another_recording(plant: PlantDescription) -> list[str]:
    """For each effect that begins within a recording, what to do with the plant file if this is another one."""
    return [
        f"{effect.effect} at {effect.location} has its {moment} at {quantity_text(effect.parameters[moment], 's')}, a "
        f"time of the recording that it was found in: if this one was made later, delete the {moment} in the plant file"
        for effect in plant.effects
        for moment in MOMENTS
        if effect.parameters.get(moment)
    ]


def _constants(arguments: argparse.Namespace, plant: PlantDescription) -> dict[str, dict[str, Any]]:
    """Inputs that were not recorded, in the form of `columns` of a run file; a number without a unit is SI."""
    units, columns = plant.channel_units(), {}
    for text in arguments.constant:
        name, _, value = (part.strip() for part in text.partition("="))
        if not (name and value):
            raise ValueError(f"--constant: expected INPUT=VALUE such as q1_cmd=0, got '{text}'")
        unit = units.get(name, "1")
        constant: dict[str, Any] = {"constant": value}
        with suppress(ValueError):  # of a value that has a unit
            number = float(value)
            constant = {"constant": number if unit == "1" else f"{value} {unit}"}
        columns[name] = constant
    return columns


def _own_constants(run: FreeRun, screen: Screen) -> None:
    """Print the constants whose values in this run are far out of their tolerances."""
    constants = build_network(run.plant).constants
    for name, value in run.prediction.own.items():
        constant = constants[name]
        far = abs(value - constant.nominal) / constant.std
        if far > OFF_TOLERANCES:
            screen.say(
                f"- {Path(run.recording.source).name}: in its first samples {name} = "
                f"{quantity_text(value, constant.unit, 3)}, {far:.2g} tolerances off: the plant file does not fit them"
            )


def _row(run: FreeRun, plant: PlantDescription) -> tuple[Any, ...]:
    """Recording, times, errors of the sensors of `plant`, initial levels."""
    columns = {s.tank: s.column for s in reversed(plant.sensors) if s.unit == "m"}  # so that levels have their units
    levels = ", ".join(
        f"{tank} {quantity_text(level, 'm', name=columns.get(tank, ''))}"
        for tank, level in run.prediction.start_levels.items()
    )
    times = (float(run.recording.time[i]) for i in (0, -1))
    return (Path(run.recording.source).name, *times, *shown_errors(plant, run.prediction.rmse), levels)


def _result(run: FreeRun, misfit: Misfit, arguments: argparse.Namespace) -> dict[str, Any]:
    prediction = run.prediction
    return {
        "format": "fdi_torch.prediction/1",
        "plant": run.plant.name,
        "recording": run.recording.source,
        **misfit.to_dict(),
        "rmse": dict(prediction.rmse),
        "start_levels": dict(prediction.start_levels),
        "own": dict(prediction.own),
        "start_samples": arguments.start_samples,
        "settle": arguments.settle,
        "time": run.recording.time.tolist(),
        "readings": {s.name: prediction.readings[:, i].tolist() for i, s in enumerate(run.plant.sensors)},
    }
