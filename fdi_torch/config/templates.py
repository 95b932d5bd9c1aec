"""Commented minimal files: a plant, and runs, monitors and studies of any plant."""

from __future__ import annotations

from fdi_torch.names import unknown
from fdi_torch.parameters import quantity_text
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recordings.csv_files import header_of

PLANT = """# A plant: what the rig is made of. `fdi check --plant FILE` checks it, `fdi check --keys` lists every key.
name: rig

tanks:
  A:
    area: 200 cm^2            # cross-section
    height: 60 cm             # from the floor to the rim
  B: {area: 200 cm^2, height: 60 cm}

pipes:
  link:
    source: A
    target: B
    area: 0.6 cm^2            # of the orifice
    discharge_coefficient: 0.6
    # elevation: 2 cm         # of the orifice above both floors
    # valve: v1               # the input channel with its measured opening, 0 to 1
  drain: {source: B, target: outside, area: 0.5 cm^2, discharge_coefficient: 0.6}

pumps:
  Q: {target: A, max_flow: 6 l/min}
  # Q: {target: A, max_flow: 6 l/min, gain: 0.5 l/min/V}    # where the command is a voltage; l/min alone: of a duty

# weirs:                      # overflow over a crest below the rim
#   over: {source: A, target: B, crest: 50 cm, width: 4 cm}

# transfers:                  # commanded or measured flows out of a tank; the recording has a column of that name
#   back: {source: B, target: A, max_flow: 3 l/min}

sensors:
  hA: {tank: A}
  hB: {tank: B}
  # pB: {tank: B, gain: 98.1 mbar/m, offset: 0 mbar}        # where it reads a pressure

tolerances:                   # one standard deviation: these constants are estimated beside the faults
  "*.discharge_coefficient": 3 %
  # hA.offset: 2 mm

# effects:                    # what the plant is known to have; `fdi effects` lists all there are
#   - {effect: pump_lag, location: Q, parameters: {time_constant: 5 s}}
"""

RUN = """# A run: which faults are in a recording. `fdi train --config FILE`; `fdi train --keys` lists every key.
plant: @PLANT@

recordings:
  - file: @NAME@.csv           # with the header @HEADER@
    # start: 60 s             # the first time that is used; stop: the last
    # mask: [[120 s, 130 s]]  # readings in between do not count
    # columns:                # for headers of other names
    #   @OUTPUT@: {column: LT-101, unit: mm}

estimate:
  parameters:                 # what is suspected; `fdi effects --plant @PLANT@` lists what there is
    - @LEAK@
    - @PLUGGING@

output: {folder: logs, name: @NAME@}
"""

MONITOR = """# A monitor: alarms and faults along a recording. `fdi monitor --config FILE`; `fdi monitor --keys` lists
# every key.
plant: @PLANT@

recording:
  file: @NAME@.csv             # with the header @HEADER@

fault_free: [0 s, 300 s]      # the part that noise is learnt from
# calibrate: [@CONSTANT@]     # constants fitted to that part first
# faults: [@LEAK@, @PLUGGING@]    # by default the usual ones of every component
false_alarms_every: 20000 s   # mean time between false alarms

output: {folder: logs, name: @NAME@}
"""

STUDY = """# A study: how well faults can be estimated, over many simulated trials. `fdi study --config FILE`;
# `fdi study --keys` lists every key. Without the block `study` at the end it is a single run: `fdi simulate --config
# FILE` writes its recording, `fdi train --config FILE` estimates it.
plant: @PLANT@

simulate:
  inputs:
@INPUTS@
  duration: 600 s
  sample_time: 1 s
  faults: {@LEAK@: 0.2}
  noise: {snr_db: 30}

estimate:
  parameters: [@LEAK@]

output: {folder: logs, name: @NAME@}

study:
  faults: simulated           # those above, with other noise in each trial
  snr_db: [40, 30, 20]
  trials: 200
"""

TEMPLATES = {"plant": PLANT, "run": RUN, "monitor": MONITOR, "study": STUDY}


def template(kind: str, plant: PlantDescription, plant_file: str, name: str) -> str:
    """The text of a new file of that kind.

    plant: the plant of the file; plant_file: its entry under the key `plant`; name: of the run and of the recording
    that it reads. Raises ValueError for an unknown kind.
    """
    if kind not in TEMPLATES:
        raise ValueError(unknown("a kind of file", kind, TEMPLATES))
    pipe = plant.pipes[0].name if plant.pipes else plant.tanks[0].name
    plugging = f"{pipe}.plugging" if plant.pipes else f"{pipe}.evaporation"
    constant = f"{pipe}.discharge_coefficient" if plant.pipes else f"{pipe}.area"
    words = {
        "PLANT": plant_file,
        "NAME": name,
        "HEADER": header_of(plant.channel_units(), {s.column: s.unit for s in plant.sensors}),
        "OUTPUT": plant.sensors[0].column,
        "LEAK": f"{plant.tanks[0].name}.leak",
        "PLUGGING": plugging,
        "CONSTANT": constant,
        "INPUTS": _inputs(plant),
    }
    text = TEMPLATES[kind]
    for word, value in words.items():
        text = text.replace(f"@{word}@", value)
    return text


def _inputs(plant: PlantDescription) -> str:
    """For each pump and transfer a step up and a step down about half of its range; valves are open."""
    full_commands = {c.channel: (c.full_command, c.command_unit) for c in plant.metered_flows()}
    lines = []
    for channel in plant.channels():
        if channel not in full_commands:
            lines.append(f"    {channel}: 1")
            continue
        high, unit = full_commands[channel]
        levels = [quantity_text(share * high, unit, 3) for share in (0.4, 0.5, 0.3)]
        steps = ", ".join(f"[{t} s, {level}]" for t, level in zip((0, 200, 400), levels, strict=True))
        lines.append(f"    {channel}: {{steps: [{steps}]}}")
    return "\n".join(lines)
