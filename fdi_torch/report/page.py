"""The report page: each run's verdict, then its sections, in one file without network access or scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fdi_torch.report.html import Markup, join, tag
from fdi_torch.report.material import Material
from fdi_torch.report.section import Maker, Picture, Section, section_html
from fdi_torch.report.sections import SECTIONS
from fdi_torch.report.style import save
from fdi_torch.report.stylesheet import STYLESHEET
from fdi_torch.report.verdict import headline, how_it_ended, kind_words

# Even if something passed the escaping, the browser would load and run nothing.
POLICY = "default-src 'none'; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class RunReport:
    """A run with its sections."""

    material: Material
    sections: tuple[Section, ...]

    @property
    def pictures(self) -> list[Picture]:
        return [picture for section in self.sections for picture in section.pictures]


def report_of(material: Material, makers: Sequence[Maker] = SECTIONS) -> RunReport:
    """All sections for which the log has content. An error in a log affects its section only."""
    made = (_made(maker, material) for maker in makers)
    return RunReport(material, tuple(section for section in made if section is not None))


def page(reports: Sequence[RunReport], first: Sequence[Section] = (), above: Sequence[Markup] = ()) -> str:
    """The complete page. first: sections about all runs, such as their comparison. above: elements before them."""
    title = " · ".join(report.material.run.path.stem for report in reports[:4])
    articles = [*(section_html(section, "all-") for section in first)]
    articles += [_article(report, f"r{k}-") for k, report in enumerate(reports)]
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
        ]
    )
    return f"<!doctype html>\n{tag('html', tag('head', head), tag('body', tag('main', *content)), lang='en')}\n"


def write_pictures(report: RunReport, folder: Path) -> list[Path]:
    """Write every picture as PNG and SVG."""
    return [save(p.figure, folder / f"{p.name}{ending}") for p in report.pictures for ending in (".png", ".svg")]


def _article(report: RunReport, prefix: str) -> Markup:
    material = report.material
    top = [tag("h1", f"{kind_words(material)} · {material.run.path.stem}"), tag("h2", headline(material))]
    top += [tag("p", sentence, class_="meta") for sentence in how_it_ended(material)]
    return tag("article", *top, *(section_html(section, prefix) for section in report.sections))


def _made(maker: Maker, material: Material) -> Section | None:
    try:
        return maker(material)
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, OSError) as error:
        name = maker.__name__.removesuffix("_section").replace("_", " ")
        return Section(name.capitalize(), [tag("p", f"The log cannot be shown here: {_reason(error)}", class_="bad")])


def _reason(error: Exception) -> str:
    """The error as text."""
    return f"{type(error).__name__}: {error}" if not isinstance(error, OSError) else str(error)
