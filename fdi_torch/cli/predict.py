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
from fdi_torch.cli.gap_text import MOVED
from fdi_torch.cli.screen import Screen
from fdi_torch.clock import MOMENTS
from fdi_torch.config.channels import expect_columns
from fdi_torch.config.loaded_recordings import load_recordings, named_recordings
from fdi_torch.config.plant_file import chosen_plant, load_plant
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.config.yaml_files import YAML_ENDINGS, find_data
from fdi_torch.effects import build_network
from fdi_torch.estimate.misfit import Misfit, misfit_of
from fdi_torch.gap.free_runs.prediction import Prediction, predict
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import display_unit, quantity_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import doubts_about
from fdi_torch.report.fit_figure import fit_figure
from fdi_torch.report.style import save


def run(arguments: argparse.Namespace, screen: Screen) -> int:
    torch.set_num_threads(1)
    plant = chosen_plant(arguments.plant)
    other = load_plant(arguments.beside) if arguments.beside else None
    names = [*arguments.recordings, *arguments.recording]
    if not names:
        raise ValueError("expected a recording, got none; name a CSV, MCAP or YAML file")
    recordings = [r for name in names for r in _recordings(name, plant, arguments)]
    with screen.progress("predict") as advance:
        predictions = []
        for k, recording in enumerate(recordings):
            advance(k / len(recordings), Path(recording.source).name)
            predictions.append((recording, _predict(plant, recording, arguments)))
        advance(1.0, "done")
    misfits = [misfit_of(prediction.rmse, [recording], plant) for recording, prediction in predictions]
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
    before = [_predict(other, recording, arguments, vary=()) for recording in recordings] if other else []
    own_name, other_name = _names(plant.name, arguments)
    rows = [[own_name, *_row(plant, recording, prediction)] for recording, prediction in predictions]
    rows += [[other_name, *_row(plant, *each)] for each in zip(recordings, before, strict=bool(other))]
    units = (f"{s.name}, {display_unit(s.unit, s.column)[0] or 'share'}" for s in plant.sensors)
    header = ("plant", "recording", "from, s", "to, s", *units, "start at")
    alone = 0 if other else 1  # without the column of plants
    title = "root mean square error" + ("" if settle is None else f" after the first {settle:g} s")
    screen.table(title, header[alone:], [row[alone:] for row in rows], left=2 - alone)
    for recording, prediction in predictions:
        _own_constants(plant, recording, prediction, screen)
    if arguments.picture:
        recording, prediction = predictions[-1]
        runs = {other_name: before[-1].readings} if before else {}
        runs[own_name] = prediction.readings
        title = misfits[-1].headline(f"free run along {Path(recording.source).name}")
        figure = fit_figure(recording, runs, title, plant, plant.outputs())
        screen.note(f"picture: {save(figure, Path(arguments.picture))}")
    results = [_result(plant, *run, misfit, arguments) for run, misfit in zip(predictions, misfits, strict=True)]
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
    expect_columns(find_data(name, Path.cwd()), plant, columns, constants)
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


def _own_constants(plant: PlantDescription, recording: Recording, prediction: Prediction, screen: Screen) -> None:
    """Print the constants whose values in this run are far out of their tolerances."""
    constants = build_network(plant).constants
    for name, value in prediction.own.items():
        constant = constants[name]
        far = abs(value - constant.nominal) / constant.std
        if far > MOVED:
            screen.say(
                f"- {Path(recording.source).name}: in its first samples {name} = "
                f"{quantity_text(value, constant.unit, 3)}, {far:.2g} tolerances off: the plant file does not fit them"
            )


def _row(plant: PlantDescription, recording: Recording, prediction: Prediction) -> list[str]:
    errors = [
        f"{display_unit(s.unit, s.column)[1] * prediction.rmse[s.name]:.4g}" if s.name in prediction.rmse else ""
        for s in plant.sensors
    ]
    levels = ", ".join(f"{tank} {quantity_text(level, 'm')}" for tank, level in prediction.start_levels.items())
    times = (f"{float(recording.time[i]):g}" for i in (0, -1))
    return [Path(recording.source).name, *times, *errors, levels]


def _result(
    plant: PlantDescription,
    recording: Recording,
    prediction: Prediction,
    misfit: Misfit,
    arguments: argparse.Namespace,
) -> dict[str, Any]:
    return {
        "format": "fdi_torch.prediction/1",
        "plant": plant.name,
        "recording": recording.source,
        **misfit.to_dict(),
        "rmse": dict(prediction.rmse),
        "start_levels": dict(prediction.start_levels),
        "own": dict(prediction.own),
        "start_samples": arguments.start_samples,
        "settle": arguments.settle,
        "time": recording.time.tolist(),
        "readings": {s.name: prediction.readings[:, i].tolist() for i, s in enumerate(plant.sensors)},
    }
