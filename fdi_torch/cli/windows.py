"""Output of a window-by-window fit: sizes in each window, then the periods in which each fault was present."""

from __future__ import annotations

from fdi_torch.cli.screen import Screen
from fdi_torch.estimate.stretches import Stretch
from fdi_torch.estimate.windows import WindowFault
from fdi_torch.jobs.windowed_fit import WindowedFit
from fdi_torch.parameters import display_unit

LARGEST_RELATIVE_ERROR = 10.0  # a size with a larger standard error is not shown as a number
MARKS = {"absent": "-", "cannot tell": "?"}


def show_windows(found: WindowedFit, screen: Screen) -> None:
    """Print one line per window and per period. Sizes without a unit are relative, flows hold at the mean levels."""
    names = [_name(fault) for fault in found.windows[0].faults] if found.windows else []
    rows = [[f"{w.start:g}", f"{w.stop:g}", *(_cell(fault) for fault in w.faults)] for w in found.windows]
    screen.table(
        "windows (?: not determined, for example in an empty tank)", ["from, s", "to, s", *names], rows, left=0
    )
    screen.say()
    rows = []
    for s in found.stretches:
        flow = "" if s.flow is None else f"{1e6 * s.flow:.3g}"
        rows.append([_name(s), f"{s.start:g}", f"{s.stop:g}", *_size(s, "> "), flow])
    screen.table("present", ("fault", "from, s", "to, s", "size", "std error", "flow, cm^3/s"), rows)
    screen.say(f"step of the simulation: {found.step:g} s")
    screen.say(f"log: {found.log}")
    screen.result(
        {
            "format": "fdi_torch.windows/1",
            "windows": found.windows,
            "stretches": found.stretches,
            "step": found.step,
            "log": str(found.log),
        }
    )


def _size(found: WindowFault | Stretch, beyond: str) -> tuple[str, str]:
    """Size and standard error in a practical unit; `beyond` and the size without an error if that is too large."""
    _, scale = display_unit(found.unit)
    size, std = scale * found.size, scale * found.std
    shown = f"{size:.3f}" if found.unit == "1" else f"{size:.4g}"
    return (shown, f"{std:.2g}") if std < LARGEST_RELATIVE_ERROR * max(abs(size), 1.0) else (f"{beyond}{shown}", "")


def _name(found: WindowFault | Stretch) -> str:
    unit, _ = display_unit(found.unit)
    return f"{found.name}, {unit}" if unit else found.name


def _cell(fault: WindowFault) -> str:
    return " ± ".join(part for part in _size(fault, "> ") if part) if fault.state == "present" else MARKS[fault.state]
