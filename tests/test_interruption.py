"""Ctrl-C and SIGTERM: work ends soon, writes are not interrupted, and the printed state of the log is correct."""

from __future__ import annotations

import signal
import threading
import time

import pytest
import torch

from fdi_torch.config.plant_file import load_plant
from fdi_torch.effects import build_network
from fdi_torch.interruption import UNDISTURBED, SteadyLock, Terminated, catch_signals
from fdi_torch.simulate.engine_choice import make_engine
from fdi_torch.simulate.experiment import lay_out


@pytest.fixture(autouse=True)
def own_handlers() -> object:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    catch_signals()
    yield
    signal.signal(signal.SIGINT, before[0])
    signal.signal(signal.SIGTERM, before[1])


@pytest.mark.parametrize(("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_a_signal_waits_until_a_step_is_done(number: signal.Signals, error: type[BaseException]) -> None:
    done = []
    with pytest.raises(error), UNDISTURBED:
        with SteadyLock():
            signal.raise_signal(number)
            done.append("inner")
        done.append("outer")
    assert done == ["inner", "outer"]
    with pytest.raises(error):
        signal.raise_signal(number)


def test_another_thread_postpones_nothing() -> None:
    lock, held, enough = SteadyLock(), threading.Event(), threading.Event()

    def hold() -> None:
        with lock:
            held.set()
            enough.wait(20)

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait(20)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    enough.set()
    thread.join()


def test_an_ignored_interrupt_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    catch_signals()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_a_long_compiled_loop_ends_at_a_signal(
    number: signal.Signals, error: type[BaseException], threads: int
) -> None:
    """The whole loop would take minutes: 960 lanes of ten million steps."""
    plant = load_plant("three_tank")
    time_ = torch.tensor([0.0, 1e6], dtype=torch.float64)
    inputs = torch.full((2, 2), 5e-5, dtype=torch.float64)
    blank = torch.full((2, 3), 0.3, dtype=torch.float64)
    network, recording = build_network(plant), plant.recording(time_, inputs, blank)
    engine = make_engine(network, network.constants, lay_out(recording, plant.channels(), 0.1), "compiled")
    theta = network.constants.nominal().expand(960, -1)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    timer = threading.Timer(0.5, signal.pthread_kill, (threading.main_thread().ident, number))
    timer.start()
    started = time.monotonic()
    try:
        with pytest.raises(error):
            engine.levels(theta)
    finally:
        torch.set_num_threads(before)
        timer.join()
    assert time.monotonic() - started < 20.0, "a guard against a hang"
    short = make_engine(network, network.constants, lay_out(recording, plant.channels(), 1e5), "compiled")
    assert bool(torch.isfinite(short.levels(theta)).all())
