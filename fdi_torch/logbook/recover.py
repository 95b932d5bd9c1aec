"""What is left of a broken log, as a whole one: everything before, between and after the damage.

A chunk is taken where its CRC agrees, as a whole or not at all, so no damaged message is ever passed on. Metadata has
no CRC in this format: in a damaged file it is copied where its inner lengths agree, and may hold a flipped letter.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fdi_torch.logbook.copying import copy_log
from fdi_torch.logbook.errors import LogError
from fdi_torch.logbook.reader import Run
from fdi_torch.logbook.scan import Damage

RECORD = "fdi_torch.recovery"


@dataclass(frozen=True)
class Recovery:
    """target: the repaired file. messages: how many it holds. lost: the gaps. ended: had the run come to its end?"""

    source: Path
    target: Path
    messages: int
    lost: tuple[Damage, ...]
    ended: bool

    @property
    def whole(self) -> bool:
        """Was nothing lost, as far as the file can tell?"""
        return self.ended and not self.lost

    @property
    def sentence(self) -> str:
        """What was saved and what was not, in words."""
        if self.whole:
            return f"{self.source}: the file is whole, all {self.messages} messages are in {self.target}"
        size = sum(damage.end - damage.start for damage in self.lost)
        gaps = "" if not self.lost else f"1 damaged stretch of {size} bytes is lost"
        if len(self.lost) > 1:
            gaps = f"{len(self.lost)} damaged stretches, {size} bytes in all, are lost"
        end = "" if self.ended else "the run did not come to its end: up to its last second is missing"
        trouble = "; ".join(part for part in (gaps, end) if part)
        return f"{self.source}: {self.messages} messages saved in {self.target}; {trouble}"


def recover(source: str | Path, target: str | Path | None = None) -> Recovery:
    """Write what can be read of `source` to `target`, a new file; by default NAME.recovered.mcap beside it.

    Raises LogError where the source cannot be opened or holds nothing of the format, or the target cannot be written.
    """
    source = Path(source)
    target = _beside(source) if target is None else Path(target)
    found: list[Recovery] = []

    def report(run: Run, messages: int) -> dict[str, dict[str, str]]:
        lost = tuple(sorted(run.damages, key=lambda damage: damage.start))
        found.append(Recovery(source, target, messages, lost, run.ended))
        return {RECORD: _record(found[-1])}

    try:
        copy_log(source, target, salvage=True, extra=report)
    except LogError:
        if found:
            target.unlink(missing_ok=True)
        raise
    return found[0]


def _beside(source: Path) -> Path:
    name = source.name.removesuffix(".partial").removesuffix(".mcap")
    return source.with_name(f"{name}.recovered.mcap")


def _record(recovery: Recovery) -> dict[str, str]:
    gaps = {f"lost.{i}": f"{gap.start} to {gap.end}: {gap.reason}" for i, gap in enumerate(recovery.lost)}
    about = {"source": recovery.source.name, "messages": str(recovery.messages), "ended": str(recovery.ended).lower()}
    return {**about, "lost": str(len(recovery.lost)), **gaps}
