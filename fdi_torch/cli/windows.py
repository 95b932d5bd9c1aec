"""How faults of windows are shown: each window with every suspect's size, then the stretches in which one is there."""

from __future__ import annotations

from fdi_torch.cli.screen import Screen
from fdi_torch.jobs.windows import WindowFault, WindowsResult

MARKS = {"present": "present", "absent": "-", "cannot tell": "?"}


def show_windows(found: WindowsResult, screen: Screen) -> None:
    """A line a window and a line a stretch; sizes are shares of the reference, flows cm^3/s at the mean level."""
    names = [fault.name for fault in found.windows[0].faults] if found.windows else []
    header = ["from, s", "to, s"]
    for name in names:
        header += [name, "std error", ""]
    rows = [
        [f"{w.start:g}", f"{w.stop:g}", *(cell for fault in w.faults for cell in _cells(fault))] for w in found.windows
    ]
    screen.table("windows (?: cannot tell, as where a tank is empty)", header, rows, left=0)
    screen.say()
    rows = []
    for s in found.stretches:
        flow = "" if s.flow is None else f"{1e6 * s.flow:.3g}"
        rows.append([s.name, f"{s.start:g}", f"{s.stop:g}", *_size(s.size, s.std), flow])
    screen.table("present", ("fault", "from, s", "to, s", "size", "std error", "flow, cm^3/s"), rows)
    screen.say(f"log: {found.log}")
    screen.result(
        {
            "format": "fdi_torch.windows/1",
            "windows": found.windows,
            "stretches": found.stretches,
            "log": str(found.log),
        }
    )


def _size(size: float, std: float) -> tuple[str, str]:
    return (f"{size:.3f}", f"{std:.2g}") if std < 10.0 else (f"> {size:.3g}", "")


def _cells(fault: WindowFault) -> tuple[str, str, str]:
    return f"{fault.size:.3f}", f"{fault.std:.2g}" if fault.std < 10.0 else "", MARKS[fault.state]
