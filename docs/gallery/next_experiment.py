"""Two explanations that one recording cannot separate, and the experiment that separates them."""

import tempfile

from style import BLUE, GREY, ORANGE, figure, save

import fdi_torch

plant = fdi_torch.load_plant("three_tank")
noise = {"std": {"h1": "2 mm", "h2": "2 mm", "h3": "2 mm"}}
truth = {"Q1.pump_lag": "5 s"}
slow = {"Q1": {"steps": [["0 s", "40 cm^3/s"], ["200 s", "52 cm^3/s"]]}, "Q2": "45 cm^3/s"}
first = fdi_torch.simulate(plant, inputs=slow, duration="500 s", noise=noise, faults=truth)

with tempfile.TemporaryDirectory() as folder:
    before = fdi_torch.gap(plant, first, out=folder)
    print(before.headline)
    planned = before.answer.next_input["input"]  # the best of random step inputs within the limits of pumps and levels
    steps = {
        channel: {"steps": [[f"{t} s", f"{v} m^3/s"] for t, v in zip(*planned[channel].values(), strict=True)]}
        for channel in plant.channels()
    }
    second = fdi_torch.simulate(plant, inputs=steps, duration="800 s", noise=noise, faults=truth, seed=1)
    after = fdi_torch.gap(plant, [first, second], out=folder)
    print(after.headline)

shares = []
for result in (before, after):
    table = result.explanations().columns
    shares.append(dict(zip(table["explanation"], table["probability"], strict=True)))
names = list(shares[0])[:3]

drawn, axes = figure(1, 3, "Lag or delay? One more experiment decides", width_ratios=(2, 3, 2))
for axis, recording, title in zip(axes[0], (first, second), ("first recording", "planned experiment"), strict=False):
    for k, color in ((0, BLUE), (1, GREY)):
        axis.step(recording.time, 1e6 * recording.inputs[:, k], color=color, where="post", label=plant.channels()[k])
    axis.set(xlabel="time, s", ylabel="command, cm$^3$/s", ylim=(0, 95), title=title)
axes[0, 0].legend(frameon=False)
bars = axes[0, 2]
for k, (share, color) in enumerate(zip(shares, (GREY, ORANGE), strict=True)):
    label = ("first recording alone", "both recordings")[k]
    places = [i + 0.4 * k - 0.2 for i in range(len(names))]
    bars.barh(places, [share.get(name, 0.0) for name in names], height=0.38, color=color, label=label)
bars.set_yticks(range(len(names)), [name.replace(" ", "\n", 1) for name in names])
bars.set(xlabel="posterior probability", xlim=(0, 1.02), ylim=(3.2, -0.5))
bars.legend(frameon=False, loc="lower right", fontsize=9)
save(drawn, __file__)
