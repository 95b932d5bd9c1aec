"""The report page: each run's verdict, then its sections, in one file without network access.

Its only script is uPlot with the charts made with it; the content security policy allows the script by its hash.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from fdi_torch.logbook import labels_of
from fdi_torch.report.html import Markup, bullets, join, tag, unbroken
from fdi_torch.report.material import Material
from fdi_torch.report.section import Maker, Picture, Section, section_html
from fdi_torch.report.sections import SECTIONS
from fdi_torch.report.sections.origin import RIG
from fdi_torch.report.style import save
from fdi_torch.report.verdict import headline, how_it_ended, kind_words

_ASSETS = files("fdi_torch.report") / "assets"


def _text(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


LICENCE = _text("uPlot.LICENSE.txt")
_OWN = f'(() => {{\n"use strict";\n{_text("charts.js")}\n{_text("page.js")}}})();\n'
SCRIPT = "\n".join((f"/*\n{LICENCE}*/", _text("uPlot.iife.min.js"), _OWN))
STYLESHEET = _text("uPlot.min.css") + _text("page.css")

# Even if something passed the escaping, the browser would load nothing, and run nothing but SCRIPT.
_HASH = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
POLICY = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{_HASH}'"


WIDEST_BESIDE = 5.3  # inches of a rig beside the result; a wider one would have letters too small to read


@dataclass(frozen=True)
class RunReport:
    """A run with its sections."""

    material: Material
    sections: tuple[Section, ...]

    @property
    def pictures(self) -> list[Picture]:
        return [picture for section in self.sections for picture in section.pictures]


def report_of(material: Material) -> RunReport:
    """All sections for which the log has content. An error in a log affects its section only."""
    with material.in_its_units():
        made = [_made(maker, material) for maker in SECTIONS]
    return RunReport(material, tuple(section for section in made if section is not None))


def page(reports: Sequence[RunReport], first: Sequence[Section] = (), above: Sequence[Markup] = ()) -> str:
    """The complete page. first: sections about all runs, such as their comparison. above: elements before them."""
    title = " · ".join(report.material.run.path.stem for report in reports[:4])
    articles = [_article(report, f"r{k}-") for k, report in enumerate(reports)]
    if len(reports) > 1:
        runs = [(f"r{k}-run", name) for k, name in enumerate(labels_of([r.material.run.path for r in reports]))]
        listed = [*((f"all-{k}", section.title) for k, section in enumerate(first)), *runs]
        shared = (section_html(section, "all-", f"all-{k}") for k, section in enumerate(first))
        articles = [tag("h1", f"Comparison · {title}"), _index(listed), _cards([*shared]), *articles]
    return document(title, [*above, *articles])


def document(title: str, content: Sequence[Markup], style: str = "", refresh: int = 0) -> str:
    """An HTML document under the content security policy. style: further CSS. refresh: seconds until it reloads."""
    head = join(
        [
            Markup('<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'),
            Markup(f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'),
            Markup(f'<meta http-equiv="refresh" content="{refresh}">' if refresh else ""),
            tag("title", f"{title} – fdi_torch"),
            tag("style", Markup(STYLESHEET + style)),
            tag("script", Markup(SCRIPT)),
        ]
    )
    return f"<!doctype html>\n{tag('html', tag('head', head), tag('body', tag('main', *content)), lang='en')}\n"


def write_pictures(pictures: Sequence[Picture], folder: Path) -> list[Path]:
    """Write every picture as PNG and SVG."""
    return [save(p.figure, folder / f"{p.name}{ending}") for p in pictures for ending in (".png", ".svg")]


def _article(report: RunReport, prefix: str) -> Markup:
    material = report.material
    top = [tag("h1", f"{kind_words(material)} · {material.run.path.stem}"), tag("h2", unbroken(headline(material)))]
    top += bullets(f"Doubt about the recording: {doubt}" for doubt in material.listed("doubts"))
    top.append(tag("p", how_it_ended(material), class_="meta"))
    named = {f"{prefix}s{k}": section for k, section in enumerate(report.sections)}
    ordered = dict(sorted(named.items(), key=lambda each: not each[1].lead))
    index = _index([(name, section.title) for name, section in ordered.items()])
    made = [section_html(section, prefix, name) for name, section in ordered.items()]
    leading = sum(section.lead for section in report.sections)
    return tag("article", *top, index, *_lead(report, made, leading), id=f"{prefix}run")


def _lead(report: RunReport, sections: list[Markup], leading: int) -> list[Markup]:
    """All sections as cards. The first `leading` ones are the result, a rig that is not wide beside the others."""
    rig = next((picture.figure for picture in report.pictures if picture.name == RIG), None)
    if rig is None or leading < 2 or rig.get_figwidth() > WIDEST_BESIDE:
        return [_cards(sections)]
    return [tag("div", sections[0], _cards(sections[1:leading]), class_="lead"), _cards(sections[leading:])]


def _cards(sections: Sequence[Markup]) -> Markup:
    return tag("div", *sections, class_="cards")


def _index(entries: Sequence[tuple[str, str]]) -> Markup:
    """Links to parts of the page, given as id and title."""
    return tag("nav", *(tag("a", title, href=f"#{name}") for name, title in entries), aria_label="Sections")


def _made(maker: Maker, material: Material) -> Section | None:
    try:
        return maker(material)
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, OSError) as error:
        name = maker.__name__.removesuffix("_section").replace("_", " ")
        reason = str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        return Section(name.capitalize(), [tag("p", f"The log cannot be shown here: {reason}", class_="bad")])
