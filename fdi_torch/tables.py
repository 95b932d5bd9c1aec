"""Tables and results as people see them: a table is built once, and shown on the terminal, on a page and in a notebook.

Numbers are shown in the units of the plant file and of the recording from which the result was computed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from html import escape
from importlib import import_module
from typing import Any, Self, TypeVar, cast

from fdi_torch.amounts import probability_words, rounded
from fdi_torch.quantities import display_unit, displayed_in, displayed_units, significant

MOST_ROWS = 60
"""Number of displayed rows; a data frame has all of them."""
ERRORS = ("std error", "std")
_FITTED = ("fitted", "with the causes", "with a freely fitted curve", "with the causes and a freely fitted curve")
WITH_ERROR = ("value", "estimate", "median", *_FITTED, *ERRORS, "95 % low", "95 % high")
"""Columns whose displayed digits follow from the standard error in the same row."""
SIDES = ' style="text-align: left"', ' style="text-align: right"'
_NUMBER = re.compile(r"[(<>]? ?[-−]?\d")
Method = TypeVar("Method", bound=Callable[..., Any])


@dataclass(frozen=True, repr=False)
class Table:
    """Rows of numbers and texts under a header.

    title: what the rows are. words: number of leading columns that hold words, if others than those without a number.
    digits: of a number without a standard error. summary: the table in a sentence.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]
    title: str = ""
    words: int | None = None
    digits: int = 6
    summary: str = ""

    def __repr__(self) -> str:
        return self.text()

    def _repr_html_(self) -> str:
        return self.html()

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def columns(self) -> dict[str, list[Any]]:
        """The columns by name."""
        return {name: [row[k] for row in self.rows] for k, name in enumerate(self.header)}

    @property
    def records(self) -> list[dict[str, Any]]:
        """The rows, each by the names of the columns."""
        return [dict(zip(self.header, row, strict=True)) for row in self.rows]

    @property
    def left(self) -> int:
        """Number of leading columns that are left-aligned: those of words."""
        if self.words is not None:
            return self.words
        further = enumerate(self.header[1:], 1)
        numbers = (any(_is_number(row[k]) for row in self.rows) and name != "unit" for k, name in further)
        return 1 + next((k for k, holds_numbers in enumerate(numbers) if holds_numbers), len(self.header) - 1)

    def cells(self, most: int | None = None) -> list[list[str]]:
        """The first rows as text."""
        error = next((k for k, name in enumerate(self.header) if name in ERRORS), None)
        return [
            [
                self._cell(name, value, row[error] if error is not None and name in WITH_ERROR else None)
                for name, value in zip(self.header, row, strict=True)
            ]
            for row in self.rows[:most]
        ]

    def _cell(self, name: str, value: Any, std: float | None) -> str:
        if value is None or value != value:
            return ""
        if isinstance(value, list | tuple):
            return ", ".join(self._cell(name, each, None) for each in value)
        if not isinstance(value, float):
            return value if isinstance(value, str) else str(value)
        if name.startswith("probability"):
            return probability_words(value)
        if not math.isfinite(value):
            return "–"
        return significant(value, self.digits) if std is None or std != std else rounded(value, std)

    def text(self) -> str:
        lines = [list(self.header), *self.cells(MOST_ROWS)] if len(self) else []
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        shown = ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines]
        return "\n".join([*shown, *self._rest()])

    def html(self) -> str:
        sides = [SIDES[k >= self.left] for k in range(len(self.header))]
        lines = [
            "".join(f"<{tag}{side}>{escape(cell)}</{tag}>" for side, cell in zip(sides, row, strict=True))
            for tag, rows in (("th", [self.header]), ("td", self.cells(MOST_ROWS)))
            for row in rows
        ]
        body = "".join(f"<tr>{line}</tr>" for line in lines[1:])
        remark = "".join(f"<p>{line}</p>" for line in self._rest())
        table = f"<table><thead><tr>{lines[0]}</tr></thead><tbody>{body}</tbody></table>"
        return f'<div style="overflow-x: auto">{table}</div>{remark}' if len(self) else ""

    def to_pandas(self) -> Any:
        """A pandas.DataFrame. Raises ImportError, with the command to install pandas, if it is missing."""
        return needed("pandas").DataFrame(self.columns)

    def _rest(self) -> list[str]:
        return [f"... and {len(self) - MOST_ROWS} more rows"] if len(self) > MOST_ROWS else []


def _is_number(value: Any) -> bool:
    """Whether a cell is a number, or a text that begins with one, such as '0.30 ± 0.01'."""
    if isinstance(value, str):
        return bool(_NUMBER.match(value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def in_its_units(method: Method) -> Method:
    """A method of a `Shown` within the result's units for display."""

    @wraps(method)
    def within(self: Shown, *args: Any, **more: Any) -> Any:
        with displayed_in(self.shown_units):
            return method(self, *args, **more)

    return cast(Method, within)


def in_display_unit(name: str, si_unit: str, *values: float) -> tuple[Any, ...]:
    """The unit for display of a channel or parameter ('1' for none), and the SI values in it."""
    unit, scale = display_unit(si_unit, name)
    return unit or "1", *(scale * value for value in values)


class Shown:
    """Base of results with a display: a headline and a table."""

    _made_in: Mapping[str, str]

    def __new__(cls, *_args: Any, **_fields: Any) -> Self:
        made = super().__new__(cls)
        object.__setattr__(made, "_made_in", displayed_units())
        return made

    @property
    def shown_units(self) -> Mapping[str, str]:
        """Units for display: SI unit, or name of a channel or parameter -> unit."""
        return self._made_in

    @property
    def headline(self) -> str:
        """The result in one sentence."""
        raise NotImplementedError

    @property
    def heading(self) -> str:
        """The headline with what the result is, for notebooks."""
        return self.headline

    def table(self) -> Table:
        """The numbers behind the headline; a column `unit` names the unit of each row."""
        raise NotImplementedError

    def brief(self) -> Table:
        """The part of the table that is printed."""
        return self.table()

    def __repr__(self) -> str:
        return f"{type(self).__name__}: {self.headline}\n{self.brief().text()}".rstrip()

    def _repr_html_(self) -> str:
        """Headline, table and picture for notebooks."""
        return f"<div><p><b>{escape(self.heading)}</b></p>{self.brief().html()}{self.picture()}</div>"

    def picture(self) -> str:
        """The picture below the table as HTML; empty if there is none."""
        return ""

    def to_pandas(self) -> Any:
        """The table as a pandas.DataFrame (extra `pandas`)."""
        return self.table().to_pandas()


class MissingExtraError(ImportError, ValueError):
    """A library of an extra is not installed. The text is a sentence with the command that installs it."""


def needed(library: str, extra: str = "") -> Any:
    """Import a library of an extra. Raises MissingExtraError if it is missing."""
    try:
        return import_module(library)
    except ModuleNotFoundError as error:
        if error.name != library.partition(".")[0]:
            raise
        sentence = (
            f"expected the library {library.partition('.')[0]}, got none; pip install 'fdi_torch[{extra or library}]'"
        )
        raise MissingExtraError(sentence) from None
