"""Commented minimal runs, monitors, rehearsals and studies of any plant."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

from fdi_torch.config.channels import mapped
from fdi_torch.config.yaml_files import find_data
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import quantity_text
from fdi_torch.recordings.csv_writing import header_of
from fdi_torch.recordings.database import is_query


def template(kind: str, plant: PlantDescription, plant_file: str, name: str, recording: str | None = None) -> str:
    """The text of a new run, monitor, rehearsal or study.

    plant: the plant of the file; plant_file: its entry under the key `plant`; name: of the run. recording: the file
    that it reads; None for one of the name of the run, whose header is then told.
    """
    header = header_of(plant.channel_units(), plant.output_units())
    file = f"{name}.csv             # with the header {header}" if recording is None else f'"{recording}"'
    indent = "    " if kind == "run" else "  "
    to_complete = [] if recording is None or is_query(recording) else mapped(find_data(recording, Path.cwd()), plant)
    columns = to_complete or [
        "# columns:                # for headers of other names",
        f"#   {plant.sensors[0].column}: {{column: LT-101, unit: mm}}",
    ]
    pipe = plant.pipes[0].name if plant.pipes else plant.tanks[0].name
    plugging = f"{pipe}.plugging" if plant.pipes else f"{pipe}.evaporation"
    constant = f"{pipe}.discharge_coefficient" if plant.pipes else f"{pipe}.area"
    return Template(
        files("fdi_torch.config").joinpath("templates", f"{kind}.yaml").read_text(encoding="utf-8")
    ).substitute(
        plant=plant_file,
        name=name,
        file=file,
        columns="\n".join(indent + line for line in columns),
        leak=f"{plant.tanks[0].name}.leak",
        plugging=plugging,
        constant=constant,
        inputs=_inputs(plant),
        simulated="\n".join(f"# {line}" for line in _inputs(plant).splitlines()),
        noise=", ".join(f"{s.column}: {quantity_text(1e-3 * abs(s.gain), s.unit, 3, s.column)}" for s in plant.sensors),
        channels=", ".join(plant.channels()),
        commands=", ".join(_shares(plant, channel, (0.4,))[0] for channel in plant.channels()),
    )


def _inputs(plant: PlantDescription) -> str:
    """For each pump and transfer a step up and a step down about half of its range; valves are open."""
    lines = []
    for channel in plant.channels():
        steps = zip((0, 200, 400), _shares(plant, channel, (0.4, 0.5, 0.3)), strict=False)
        listed = [f"[{t} s, {level}]" for t, level in steps]
        lines.append(f"    {channel}: " + ("1" if len(listed) == 1 else f"{{steps: [{', '.join(listed)}]}}"))
    return "\n".join(lines)


def _shares(plant: PlantDescription, channel: str, shares: Sequence[float]) -> list[str]:
    """Commands that are these shares of a pump's or transfer's range; of a valve, fully open."""
    full = {c.channel: (c.full_command, c.command_unit) for c in plant.metered_flows()}
    return (
        [quantity_text(share * full[channel][0], full[channel][1], 3) for share in shares] if channel in full else ["1"]
    )
