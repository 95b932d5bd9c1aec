"""An unknown law: the cause is in no library, so the answer is its place and its shape."""

import tempfile

import torch
from style import BLUE, GREY, ORANGE, figure, save
from torchdiffeq import odeint

import fdi_torch

plant = fdi_torch.load_plant("three_tank")
time = torch.arange(1501, dtype=torch.float64)
edges = torch.tensor([0, 250, 500, 750, 1000, 1250])
flows = 1e-6 * torch.tensor([[50, 40], [80, 30], [35, 60], [70, 45], [40, 30], [60, 60]], dtype=torch.float64)
inputs = flows[torch.bucketize(time, edges.double(), right=True) - 1]


def lost(level: torch.Tensor) -> torch.Tensor:
    """The unknown law, m^3/s: tank T3 loses water in waves of its level."""
    return 8e-6 * (1.0 - torch.cos(2.0 * torch.pi * level / 0.12))


known = [plant.ode(row) for row in flows]


def rates(t: torch.Tensor, h: torch.Tensor) -> torch.Tensor:
    piece = min(int(t) // 250, 5)
    return known[piece](t, h) - torch.stack([0 * h[0], 0 * h[1], lost(h[2]) / plant.tanks[2].area])


start = torch.tensor([0.55, 0.38, 0.46], dtype=torch.float64)
levels = odeint(rates, start, time, method="rk4", options={"step_size": 1.0})
noisy = levels + 1e-3 * torch.randn(levels.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
names, units = (("Q1", "Q2"), ("h1", "h2", "h3")), (("m^3/s",) * 2, ("m",) * 3)
recording = fdi_torch.Recording(time, inputs, noisy, *names, *units)

with tempfile.TemporaryDirectory() as folder:
    found = fdi_torch.gap(plant, recording, out=folder)
print(found)

tables = found.answer.shape["tables"]  # free functions at T3, as shares of a scale in m^3/s
by_level, by_time = tables["free_inflow.level"], tables["free_inflow.time"]
constant = sum(by_time["share"]) / len(by_time["share"])
flow = [-1e6 * by_level["scale"] * (share + constant) for share in by_level["share"]]
free = fdi_torch.predict(plant, recording).prediction.readings

drawn, axes = figure(1, 2, found.headline.partition(";")[0])
residual, law = axes[0]
for k, color in ((0, GREY), (1, BLUE), (2, ORANGE)):
    residual.plot(time, 100 * (noisy - free)[:, k], color=color, linewidth=0.9, label=names[1][k])
residual.set(xlabel="time, s", ylabel="recorded − nominal model, cm")
residual.legend(frameon=False)
heights = torch.linspace(0.34, 0.47, 100)
law.plot(100 * heights, 1e6 * lost(heights), color=ORANGE, label="simulated law")
law.plot([100 * h for h in by_level["at"]], flow, "o-", color=BLUE, label="free function found at T3")
law.set(xlabel="level of T3, cm", ylabel="unknown outflow, cm$^3$/s")
law.legend(frameon=False)
save(drawn, __file__)
