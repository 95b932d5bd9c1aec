"""The pages of the viewer: the list of logs, a running job, reports. Links and forms only; no scripts are needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import urlencode

from fdi_torch.names import counted
from fdi_torch.report.html import Markup, clean, escape, folded, join, table, tag, unbroken
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import number
from fdi_torch.report.page import document
from fdi_torch.report.predictions import Progress
from fdi_torch.view.log_list import RUNNING, SORTS, UNREADABLE, Entry

SECONDS_BETWEEN_UPDATES = 2
NEWEST = 20
STYLE = """
form { display: flex; flex-wrap: wrap; gap: .6rem; align-items: center; margin: .6rem 0; }
form > div { flex-basis: 100%; min-width: 0; }
input[type=search] { min-width: 14rem; } input, select, button { font: inherit; padding: .2rem .5rem; }
nav { margin: 0 0 1rem; } progress { width: min(100%, 30rem); }
"""
NAVIGATION = tag("nav", tag("a", "← all logs", href="/"))  # the link to the list


@dataclass(frozen=True)
class Query:
    """What the list shows: words to be found, a kind, and the order."""

    text: str = ""
    kind: str = ""
    sort: str = "started"
    down: bool = True

    def link(self, sort: str) -> str:
        """Address of the list sorted by that column; a second click on a column reverses its order."""
        down = not self.down if sort == self.sort else sort in ("started", "error")
        return address("/", q=self.text, kind=self.kind, sort=sort, order="down" if down else "up")


def address(path: str, **values: str | Sequence[str]) -> str:
    return f"{path}?{urlencode(values, doseq=True)}"


def list_page(folder: str, entries: Sequence[Entry], kinds: Sequence[str], query: Query, total: int) -> str:
    """The list of logs with a filter; ticked logs are compared."""
    title = f"Folder {clean(folder)}"
    shown = f"{len(entries)} of {total} logs" if len(entries) != total else counted(total, "log")
    content = [tag("h1", title), tag("h2", shown), tag("section", _filter(kinds, query), _choice(entries, query))]
    if not total:
        hint = "Jobs write their logs into the folder logs; fdi train --out DIR names another one."
        content.append(tag("p", hint, class_="note"))
    return document(title, content, STYLE)


def _filter(kinds: Sequence[str], query: Query) -> Markup:
    chosen = {"selected": "selected"}
    options = [
        tag("option", kind or "every kind", value=kind, **(chosen if kind == query.kind else {}))
        for kind in ("", *kinds)
    ]
    return tag(
        "form",
        _field(type="search", name="q", value=query.text, aria_label="words to find", placeholder="words to find"),
        tag("select", *options, name="kind", aria_label="kind"),
        _field(type="hidden", name="sort", value=query.sort),
        _field(type="hidden", name="order", value="down" if query.down else "up"),
        tag("button", "Filter"),
        tag("a", "show all", href="/"),
        action="/",
    )


def _choice(entries: Sequence[Entry], query: Query) -> Markup:
    """The table of logs, with a box to tick in each row."""
    header = ["", *(_sorting(key, name, query) for key, name in SORTS.items())]
    rows = [_row(entry) for entry in entries]
    return tag(
        "form",
        tag("button", "Compare the ticked logs"),
        tag("div", table(header, rows, left=len(header), most=max(len(rows), 1))),
        tag("p", "error: root mean square of measured − model over all sensors", class_="note"),
        action="/report",
    )


def _sorting(key: str, name: str, query: Query) -> Markup:
    arrow = (" ↓" if query.down else " ↑") if key == query.sort else ""
    return tag("a", name + arrow, href=query.link(key))


def _row(entry: Entry) -> list[Markup | str]:
    """A log in the list; one that cannot be read has neither box nor link."""
    box, (name, started, kind, state, error, verdict) = "", entry.cells
    if entry.state != UNREADABLE:
        box = _field(type="checkbox", name="log", value=entry.name, aria_label=f"compare {entry.name}")
        page = "/follow" if entry.state == RUNNING else "/report"
        name = tag("a", escape(entry.name), href=address(page, log=entry.name))
    if entry.state == RUNNING:
        state = join([tag("span", RUNNING, class_="good"), " ", _bar(entry.progress)])
    elif entry.state != "completed":
        state = tag("span", entry.state, class_="bad")
    return [box, name, started, kind, state, error, unbroken(verdict)]


def _bar(progress: Progress) -> Markup:
    return Markup("") if progress.share is None else tag("progress", value=f"{progress.share:.3f}", max="1")


def _field(**attributes: str) -> Markup:
    """An input field, which has no end tag."""
    return Markup(tag("input", **attributes).removesuffix("</input>"))


def follow_page(entry: Entry, material: Material | None) -> str:
    """A running job: its progress and newest events; the page reloads itself until the job has ended."""
    content = [NAVIGATION, tag("h1", f"{entry.kind or 'Job'} · {entry.name}"), tag("h2", entry.progress.text)]
    content += [tag("p", _bar(entry.progress)), tag("p", f"running, started {entry.started or 'just now'} UTC")]
    content.append(tag("p", tag("a", "report of what is logged so far", href=address("/report", log=entry.name))))
    if material is not None:
        messages = [*material.of("/observer/alarm"), *material.of("/log")]
        rows = [[number(float(m.get("t", math.nan)), 6), m.get("message", "")] for m in messages]
        if rows:
            content.append(
                tag("section", tag("h3", "Newest events"), table(("t, s", "event"), rows[-NEWEST:][::-1], 2))
            )
        counts = sorted(material.counts.items())
        content.append(tag("section", folded("Messages logged", table(("topic", "messages"), counts))))
    return document(entry.name, content, STYLE, refresh=SECONDS_BETWEEN_UPDATES)


def problem_page(problem: str) -> str:
    return document("Not shown", [NAVIGATION, tag("h2", problem)], STYLE)


def query_of(values: dict[str, str]) -> Query:
    """The query in an address; unknown columns fall back to the default order."""
    sort = values.get("sort", "started")
    sort = sort if sort in SORTS else "started"
    down = values.get("order", "down" if sort in ("started", "error") else "up") == "down"
    return Query(values.get("q", ""), values.get("kind", ""), sort, down)
