"""A rig built in Python: a cascade of four tanks with an overflow, as a plant, a file and a simulation."""

from style import BLUE, GREEN, GREY, ORANGE, figure, save

import fdi_torch
from fdi_torch import Pipe, Plant, Pump, Sensor, Tank

names = ("A", "B", "C", "D")
rig = Plant(
    tanks=[
        Tank("A", area="150 cm^2", height="70 cm"),
        Tank("B", area="150 cm^2", height="50 cm", overflow_to="C"),  # what runs over the rim of B falls into C
        Tank("C", area="250 cm^2", height="50 cm"),
        Tank("D", area="150 cm^2", height="50 cm"),
    ],
    pipes=[
        Pipe("AB", "A", "B", area="0.6 cm^2", discharge_coefficient=0.6),
        Pipe("BC", "B", "C", area="0.25 cm^2", discharge_coefficient=0.6, free_fall=True),
        Pipe("CD", "C", "D", area="0.6 cm^2", discharge_coefficient=0.6, elevation="3 cm"),
        Pipe("out", "D", "outside", area="0.5 cm^2", discharge_coefficient=0.62),
    ],
    pumps=[Pump("Q", "A", max_flow="6 l/min", gain="1 l/min/V")],  # its command is a voltage
    sensors=[Sensor(f"h{name}", name) for name in names],
    tolerances={"*.discharge_coefficient": "3 %"},
    name="cascade",
)
text = fdi_torch.dump_plant(rig)
print(text)

inputs = {"Q": {"steps": [["0 s", "2.5 V"], ["300 s", "4 V"], ["900 s", "0 V"]]}}
empty = dict.fromkeys(names, "2 cm")
noise = {"std": {f"h{name}": "1 mm" for name in names}}
recording = fdi_torch.simulate(rig, inputs=inputs, duration="1800 s", start_levels=empty, noise=noise)
print(recording)

drawn, axes = figure(1, 1, "Four tanks in Python: B runs over into C while the pump delivers 4 l/min")
for k, color in enumerate((BLUE, ORANGE, GREEN, GREY)):
    axes[0, 0].plot(recording.time / 60, 100 * recording.outputs[:, k], color=color, label=f"tank {names[k]}")
axes[0, 0].axhline(50, color=ORANGE, linestyle=":", linewidth=1)
axes[0, 0].text(25, 50.6, "rim of B", color=ORANGE, fontsize=9)
axes[0, 0].set(xlabel="time, min", ylabel="level, cm")
axes[0, 0].legend(frameon=False)
save(drawn, __file__)
