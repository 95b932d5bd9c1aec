"""How long a plant explains a recording, by a monitor that learns from its first samples."""

from __future__ import annotations

import torch

from fdi_torch.monitor.monitor import ResidualTrace
from fdi_torch.monitor.monitor_setup import fault_free_part, prepare_monitor
from fdi_torch.monitor.samples import samples_of_recording
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording

CHANCE = 0.01
"""Probability of an alarm in a recording that the plant explains throughout; as that of the warning about alarms in a
fault-free part (`fault_free_checks.residual_warnings`)."""
BATCH = 32  # samples processed before the alarms are looked at: a monitor would go on to explain them, which takes long


def explained_until(plant: PlantDescription, recording: Recording, learnt: float) -> float:
    """Time until which a monitor that learns from the recording up to `learnt`, s, raises no alarm, s.

    The time before an alarm is that at which the detector's statistic last was as small as usual, its median before:
    later the deviation that causes the alarm has begun. Raises ValueError if the monitor cannot learn.
    """
    first, last = float(recording.time[0]), float(recording.time[-1])
    prepared = prepare_monitor(
        plant, fault_free_part(recording, first, learnt), time_between_false_alarms=(last - first) / CHANCE
    )
    samples, traces = samples_of_recording(recording, plant), list[ResidualTrace]()
    state = prepared.monitor.start(samples.segment(0, 1), prepared.believed, learning_until=learnt)
    for k in range(1, len(samples), BATCH):
        state, events = prepared.monitor.advance(state, samples.segment(k, min(k + BATCH, len(samples))), traces.append)
        alarm = next((event.time for event in events if event.kind == "alarm"), None)
        if alarm is not None:
            time, statistic = (torch.cat(each) for each in zip(*((t.time, t.statistic) for t in traces), strict=True))
            before = (time > learnt) & (time < alarm)
            usual = time[before & (statistic <= statistic[before].nanmedian())]
            return float(usual[-1]) if len(usual) else learnt
    return last
