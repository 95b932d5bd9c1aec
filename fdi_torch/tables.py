"""Display of results in a session: a headline and a table, as text, as HTML, and for pandas.

Numbers are shown in the units of the plant file and of the recording from which the result was computed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from html import escape
from importlib import import_module
from typing import Any, Self, TypeVar, cast

from fdi_torch.amounts import rounded
from fdi_torch.quantities import display_unit, displayed_in, displayed_units, significant

MOST_ROWS = 60
"""Number of displayed rows; a data frame has all of them."""
ERRORS = ("std error", "std")
WITH_ERROR = ("value", "estimate", "median", *ERRORS, "95 % low", "95 % high")
"""Columns whose displayed digits follow from the standard error in the same row."""
LEFT, RIGHT = ' style="text-align: left"', ' style="text-align: right"'
_NUMBER = re.compile(r"\(?[-−]?\d")
Method = TypeVar("Method", bound=Callable[..., Any])


@dataclass(frozen=True, repr=False)
class Table:
    """Columns of equal length, by name."""

    columns: Mapping[str, Sequence[Any]]

    @classmethod
    def of_rows(cls, names: Sequence[str], rows: Sequence[Sequence[Any]]) -> Table:
        """The table with these rows, each with one value per name."""
        return cls({name: [row[k] for row in rows] for k, name in enumerate(names)})

    def __repr__(self) -> str:
        return self.text()

    def _repr_html_(self) -> str:
        return self.html()

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def rows(self, most: int = MOST_ROWS) -> list[list[str]]:
        """The first rows as text."""
        errors = next((self.columns[name] for name in ERRORS if name in self.columns), None)
        columns = [
            [
                _shown(name, value, errors[k] if errors and name in WITH_ERROR else None)
                for k, value in enumerate(column[:most])
            ]
            for name, column in self.columns.items()
        ]
        return [list(row) for row in zip(*columns, strict=True)]

    def text(self) -> str:
        lines = [list(self.columns), *self.rows()] if len(self) else []
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.columns))] if lines else []
        shown = ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines]
        return "\n".join([*shown, *self._rest()])

    def html(self) -> str:
        sides = [RIGHT if _is_numeric(column) else LEFT for column in self.columns.values()]
        head = "".join(f"<th{side}>{escape(name)}</th>" for side, name in zip(sides, self.columns, strict=True))
        cells = [[f"<td{side}>{escape(c)}</td>" for side, c in zip(sides, row, strict=True)] for row in self.rows()]
        body = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
        remark = "".join(f"<p>{line}</p>" for line in self._rest())
        table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        return f'<div style="overflow-x: auto">{table}</div>{remark}' if len(self) else ""

    def to_pandas(self) -> Any:
        """A pandas.DataFrame. Raises ImportError, with the command to install pandas, if it is missing."""
        return needed("pandas").DataFrame({name: list(column) for name, column in self.columns.items()})

    def _rest(self) -> list[str]:
        return [f"... and {len(self) - MOST_ROWS} more rows"] if len(self) > MOST_ROWS else []


def _is_numeric(column: Sequence[Any]) -> bool:
    """Whether a column holds numbers, also ones with their errors as text, such as '0.30 ± 0.01'."""
    given = [value for value in column if value not in (None, "", "–")]
    texts = (value if isinstance(value, str) else None for value in given)
    plain = (isinstance(v, int | float) and not isinstance(v, bool) for v in given)
    written = (text is not None and bool(_NUMBER.match(text)) for text in texts)
    return bool(given) and all(a or b for a, b in zip(plain, written, strict=True))


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


def _shown(column: str, value: Any, std: float | None) -> str:
    """A cell; probabilities are known to three digits at most."""
    return significant(value, 3) if column == "probability" and isinstance(value, float) else _cell(value, std)


def _cell(value: Any, std: float | None = None) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, float):
        return rounded(value, std or 0.0)
    return ", ".join(map(_cell, value)) if isinstance(value, list | tuple) else str(value)
