"""Output of a window-by-window fit: sizes in each window, then the periods in which each fault was present."""

from __future__ import annotations

from fdi_torch.amounts import parameter_words
from fdi_torch.cli.screen import Screen, log_words
from fdi_torch.estimate.windows import Stretch, WindowFault
from fdi_torch.jobs.windowed_fit import WindowedFit
from fdi_torch.quantities import display_unit

LARGEST_RELATIVE_ERROR = 10.0  # a size with a larger standard error is not shown as a number
MARKS = {"absent": "-", "cannot tell": "?"}


def show_windows(fit: WindowedFit, screen: Screen) -> None:
    """Print one line per window and per period. Sizes without a unit are relative, flows hold at the mean levels."""
    names = [_name(fault) for fault in fit.windows[0].faults] if fit.windows else []
    rows = [[f"{w.start:g}", f"{w.stop:g}", *(_cell(fault) for fault in w.faults)] for w in fit.windows]
    title = "windows (?: not determined, for example with levels at rest or an empty tank)"
    screen.table(title, ["from, s", "to, s", *names], rows, left=0)
    screen.say()
    rows, (flow_unit, flow_scale) = [], display_unit("m^3/s")
    for s in fit.stretches:
        flow = "" if s.flow is None else f"{flow_scale * s.flow:.3g}"
        rows.append([_name(s), f"{s.start:g}", f"{s.stop:g}", *_size(s, "> "), flow])
    screen.table("present", ("fault", "from, s", "to, s", "size", "std error", f"flow, {flow_unit}"), rows)
    screen.say(f"step of the simulation: {fit.step:g} s")
    screen.say(log_words(fit.log))
    screen.result(
        {
            "format": "fdi_torch.windows/1",
            "windows": fit.windows,
            "stretches": fit.stretches,
            "step": fit.step,
            "log": str(fit.log),
        }
    )


def _size(fault: WindowFault | Stretch, beyond: str) -> tuple[str, str]:
    """Size and standard error in a practical unit; `beyond` and the size without an error if that is too large."""
    _, scale = display_unit(fault.unit, fault.name)
    size, std = scale * fault.size, scale * fault.std
    shown = f"{size:.3f}" if fault.unit == "1" else f"{size:.4g}"
    return (shown, f"{std:.2g}") if std < LARGEST_RELATIVE_ERROR * max(abs(size), 1.0) else (f"{beyond}{shown}", "")


def _name(fault: WindowFault | Stretch) -> str:
    unit, _ = display_unit(fault.unit, fault.name)
    return f"{parameter_words(fault.name)}, {unit}" if unit else parameter_words(fault.name)


def _cell(fault: WindowFault) -> str:
    return " ± ".join(part for part in _size(fault, "> ") if part) if fault.state == "present" else MARKS[fault.state]
