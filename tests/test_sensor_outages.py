"""A sensor that delivers no readings any more: what the monitor tells, and what it still sees."""

from __future__ import annotations

import pytest
import torch
from test_monitor import SPACE, followed, monitor, recorded

from fdi_torch.monitor.events import Event
from fdi_torch.monitor.samples import ABSENT, Samples
from fdi_torch.monitor.sensor_outages import SensorOutages


def told(events: list[Event]) -> list[tuple[float, str]]:
    return [(e.time, e.text) for e in events if e.kind == "notice"]


@pytest.mark.parametrize("chunk", [7, 500])
def test_an_outage_is_told_once_with_what_is_not_watched_and_so_is_its_end(chunk: int) -> None:
    run = recorded(lambda t: SPACE.nominal(), 500, seed=3)
    run.readings[150:400, 0] = torch.nan
    run.readings[250:, 1:] = torch.nan
    _, events = followed(monitor(), run, chunk)
    none = "no sensor is read, and until one is, the monitor notices no fault"
    assert told(events) == [
        (
            149.0 + ABSENT + 1,
            "no reading of h1 since 149 s: until it is read again, the monitor watches the plant by h2, h3 alone and "
            "does not notice a fault that only h1 shows",
        ),
        (249.0 + ABSENT + 1, f"no reading of h2 since 249 s: {none}"),
        (249.0 + ABSENT + 1, f"no reading of h3 since 249 s: {none}"),
        (400.0, "h1 is read again after 251 s without a reading: the monitor tests its readings again"),
    ]


def test_an_outage_goes_on_over_a_gap_of_all_readings() -> None:
    run = recorded(lambda t: SPACE.nominal(), 500, seed=3)
    run.readings[150:400, 0] = torch.nan
    kept = torch.cat([torch.arange(300), torch.arange(330, 500)])
    _, events = followed(monitor(), Samples(run.time[kept], run.inputs[kept], run.readings[kept]))
    assert [(time, text.split(":")[0]) for time, text in told(events)] == [
        (250.0, "no reading of h1 since 149 s"),
        (330.0, "no samples for 31 s; the observer restarts"),
        (400.0, "h1 is read again after 251 s without a reading"),
    ]


def test_a_sensor_that_was_read_more_rarely_while_the_noise_was_learnt_has_no_outage() -> None:
    count, rarely = 2000, 3 * ABSENT
    readings = torch.zeros(count, 2, dtype=torch.float64)
    readings[torch.arange(count) % rarely != 0, 1] = torch.nan
    readings[1300:, 1] = torch.nan
    samples = Samples(torch.arange(count, dtype=torch.float64), readings[:, :0], readings)
    start = SensorOutages.at_start(("a", "b"))
    # 299 samples in a row without a reading: silent from the 599th on
    assert [k for k, _ in start.along(samples, learning_until=700.0)[1]] == [1200 + 2 * (rarely - 1) + 1]
    assert len(start.along(samples, learning_until=-1.0)[1]) > 5
