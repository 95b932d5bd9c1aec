"""HTML elements with everything escaped that was not built here, so that names from files cannot inject markup.

Text is that of the terminal; on the page, `typeset` gives its units raised exponents and its numbers minus signs.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from typing import Any

from fdi_torch.amounts import RAISED
from fdi_torch.tables import Table

MOST_ROWS = 300
NARROW = 3
SORTED = " ↓↑"  # the signs behind the column by which a table is sorted, which its cells do not repeat
_TAGS = re.compile("<[^>]*>")
_POWER = re.compile(r"(?<=[^\W\d_])\^(-?\d+)")
_NEGATIVE = re.compile(r"(?<![\w.])-(?=[\d∞])")
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff\u202a-\u202e\u2066-\u2069]")
_WITHIN_DATE = re.compile(r"(?<=\d)-(?=\d)")
_WITHIN_NUMBER = re.compile(r" (?=[±%])|(?<=±) |(?<=\d) (?=[^\s\d]{1,8}(?:[),;.]|$))")


class Markup(str):
    """HTML that needs no escaping."""

    __slots__ = ()


def clean(text: Any) -> str:
    """Text without control characters and characters that change the writing direction."""
    return _CONTROL.sub("\N{REPLACEMENT CHARACTER}", str(text))


def short(text: Any, most: int = 40) -> str:
    """Clean text of a limited length, for figures."""
    text = clean(text).replace("\n", " ")
    return text if len(text) <= most else text[: most - 1] + "…"


def typeset(text: Any) -> str:
    """Clean text as people read it: 'cm³/s' for 'cm^3/s', '−5' for '-5'; '2026-11-24', 'hA-hB' and '1e-05' stay."""
    return _NEGATIVE.sub("−", _POWER.sub(lambda power: power[1].translate(RAISED), clean(text)))


def escape(content: Any) -> Markup:
    """Text as HTML, letter by letter; markup is unchanged."""
    return content if isinstance(content, Markup) else Markup(html.escape(clean(content)))


def tag(name: str, /, *content: Any, **attributes: str) -> Markup:
    """An element with its text typeset; write `class_` and `for_` for attributes that are Python keywords."""
    written = "".join(f' {key.rstrip("_").replace("_", "-")}="{escape(value)}"' for key, value in attributes.items())
    return Markup(f"<{name}{written}>{join(content)}</{name}>")


def unbroken(sentence: str) -> str:
    """The sentence whose lines do not end within a number with its error and unit, or within a date."""
    return _WITHIN_DATE.sub("\u2060-\u2060", _WITHIN_NUMBER.sub("\u00a0", sentence))


def join(parts: Iterable[Any]) -> Markup:
    return Markup("".join(part if isinstance(part, Markup) else escape(typeset(part)) for part in parts))


def table(header: Sequence[Any], rows: Sequence[Sequence[Any]], left: int = 1, most: int = MOST_ROWS) -> Markup:
    """A table whose first `left` columns are left-aligned; very long tables are cut, with a note.

    A column whose cells are all empty is left out.
    A table of more than NARROW columns is `wide`: on a phone its rows become cards, each cell with its `data-label`.
    """
    labels = [_TAGS.sub("", name).rstrip(SORTED) if isinstance(name, Markup) else typeset(name) for name in header]
    sides = ["l" if i < left else "r" for i in range(len(header))]
    filled = [i for i in range(len(header)) if not rows or any(row[i] != "" for row in rows)]
    head = tag("tr", *(tag("th", header[i], class_=sides[i]) for i in filled))
    shown = [
        tag("tr", *(tag("td", row[i], class_=sides[i], data_label=labels[i]) for i in filled)) for row in rows[:most]
    ]
    cut = [] if len(rows) <= most else [tag("p", f"and {len(rows) - most} more rows", class_="note")]
    width = {"class_": "wide"} if len(filled) > NARROW else {}
    return join([tag("div", tag("table", tag("thead", head), tag("tbody", *shown), **width), class_="scroll"), *cut])


def shown(result: Table) -> Markup:
    """A table of results between its title and its summary."""
    title = [tag("h4", result.title[:1].upper() + result.title[1:])] if result.title else []
    summary = [tag("p", result.summary)] if result.summary else []
    return join([*title, table(result.header, result.cells(), result.left), *summary])


def pairs(entries: Sequence[tuple[Any, Any]]) -> Markup:
    """A list of names and values, which are shown as they are."""
    rows = (tag("div", tag("dt", escape(name)), tag("dd", escape(value))) for name, value in entries[:MOST_ROWS])
    return tag("dl", *rows)


def bullets(items: Iterable[Any], **attributes: str) -> list[Markup]:
    """The items as a list, or nothing without any. attributes: of each item."""
    entries = [tag("li", item, **attributes) for item in items]
    return [tag("ul", *entries)] if entries else []


def folded(summary: str, *content: Any) -> Markup:
    """Content that opens on a click; print-outs contain it."""
    return tag("details", tag("summary", summary), *content)
