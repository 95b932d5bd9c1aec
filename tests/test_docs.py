"""Links, anchors, commands, options and function names in the README and the pages of docs/ exist."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import inspect
import re
import shlex
import unicodedata
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from types import ModuleType

import pytest
import yaml

import fdi_torch
from fdi_torch.cli import COMMANDS
from fdi_torch.cli.options import add_arguments
from tests.sessions import check, run_page

ROOT = Path(__file__).resolve().parents[1]
FENCE = re.compile(r"^( *)```.*?^\1```", re.S | re.M)
LINK = re.compile(r"\]\(([^)\s]+)\)")
COMMON = {"--json", "--quiet", "--traceback", "--help"}


def loaded(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


GENERATE = loaded(ROOT / "docs/generate.py")
GENERATED: dict[str, str] = {f"docs/{name}": text for name, text in GENERATE.generated().items()}
WRITTEN = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in [ROOT / "README.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").rglob("*.md"))]
}
PAGES = WRITTEN | GENERATED


def anchors(text: str) -> set[str]:
    """Of a page's headings, as GitHub and MkDocs make them."""
    found = set()
    for heading in re.findall(r"^#+ (.+)$", FENCE.sub("", text), flags=re.M):
        plain = unicodedata.normalize("NFKD", re.sub(r"\[([^]]*)\]\([^)]*\)|[`*]", r"\1", heading))
        slug = re.sub(r"[^\w\s-]", "", plain.encode("ascii", "ignore").decode()).strip().lower()
        found.add(re.sub(r"[-\s]+", "-", slug))
    return found


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    for link in LINK.findall(FENCE.sub("", PAGES[page])):
        target, _, anchor = link.partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        path = (ROOT / PurePosixPath(page).parent / target).resolve() if target else ROOT / page
        name = path.relative_to(ROOT).as_posix()
        assert path.is_file() or name in GENERATED, f"{page}: no file {link}"
        if anchor:
            assert anchor in anchors(PAGES[name]), f"{page}: no heading {link}"


@pytest.mark.parametrize("page", WRITTEN)
def test_written_pages_link_only_to_files_in_the_repository(page: str) -> None:
    """They are read in a checkout too, where the generated pages are missing; the index of the reference names them."""
    for link in LINK.findall(FENCE.sub("", PAGES[page])):
        target = link.partition("#")[0]
        assert not target or link.startswith("http") or (ROOT / PurePosixPath(page).parent / target).is_file(), link


def command_lines(text: str) -> Iterator[list[str]]:
    """Every `fdi ...` in a block of code or between backticks, in words."""
    for block in (match[0] for match in FENCE.finditer(text)):
        joined = re.sub(r"\\\n\s*", "", block)
        for line in re.findall(r"^ *(?:\$ )?(fdi .*)$", joined, flags=re.M):
            yield shlex.split(line.split("  ")[0], comments=True)
    for line in re.findall(r"`(fdi [^`]*)`", FENCE.sub("", text)):
        yield shlex.split(line)


def options_of(command: str) -> set[str]:
    parser = argparse.ArgumentParser(add_help=False)
    add_arguments(parser, command)
    return {option for action in parser._actions for option in action.option_strings} | COMMON


@pytest.mark.parametrize("page", PAGES)
def test_commands_and_their_options_exist(page: str) -> None:
    for words in command_lines(PAGES[page]):
        command = words[1] if len(words) > 1 else "--version"
        if command in ("COMMAND", "--version"):
            continue
        assert command in COMMANDS, f"{page}: {' '.join(words)}"
        options = {word.partition("=")[0] for word in words[2:] if word.startswith("--")}
        assert options <= options_of(command), f"{page}: {' '.join(words)}: {options - options_of(command)}"


def test_every_command_has_a_path_of_functions_that_exist() -> None:
    for command in COMMANDS:
        functions = GENERATE.path_of(command)
        assert functions[:1] == [f"cli.{command}.run"], f"{command}: expected a path in the docstring of its module"
        earlier = ""
        for function in functions:
            module, name = home(function)
            assert name, f"{command}: no function fdi_torch.{function}"
            assert not earlier or name.rpartition(".")[2] in earlier, f"{command}: nothing before it calls {function}"
            earlier += inspect.getsource(module)


def home(function: str) -> tuple[ModuleType, str]:
    """The module of a function below fdi_torch and its name there; the name is empty if it does not exist."""
    parts = function.split(".")
    for k in range(len(parts) - 1, 0, -1):
        try:
            module = importlib.import_module(".".join(["fdi_torch", *parts[:k]]))
        except ImportError:
            continue
        found: object = module
        for part in parts[k:]:
            found = getattr(found, part, None)
        return module, ".".join(parts[k:]) if callable(found) else ""
    return fdi_torch, ""


def test_every_page_is_in_the_navigation() -> None:
    def leaves(node: object) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            for child in node.values() if isinstance(node, dict) else node:  # type: ignore[attr-defined]
                yield from leaves(child)

    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    assert {f"docs/{page}" for page in leaves(nav)} == {page for page in PAGES if page.startswith("docs/")}


def test_every_effect_and_public_name_is_in_the_reference() -> None:
    for effect in fdi_torch.EFFECTS:
        assert f"\n## {effect.name}\n" in GENERATED["docs/reference/effects.md"]
    for name in fdi_torch.__all__:
        assert f"\n## {name}" in GENERATED["docs/reference/python-api.md"]


@pytest.mark.slow
@pytest.mark.parametrize("page", ["tutorial.md", "how-to/weir-and-transfer.md", "how-to/historian.md"])
def test_a_session_works_as_printed(page: str, here: Path) -> None:
    run_page(PAGES[f"docs/{page}"], check)


def test_a_site_that_loads_something_from_elsewhere_is_refused(tmp_path: Path) -> None:
    page = tmp_path / "how-to" / "page.html"
    page.parent.mkdir()
    page.write_text('<link rel="stylesheet" href="../site.css"><script src="../a.js"></script><a href="https://b.org">')
    GENERATE.on_post_build({"site_dir": str(tmp_path)})
    for loaded in ('<script src="https://b.org/a.js">', '<link rel="icon" href="http://b.org/i.png">'):
        page.write_text(loaded)
        with pytest.raises(ValueError, match=r"page.html: expected a page that loads nothing .* got https?://b.org/"):
            GENERATE.on_post_build({"site_dir": str(tmp_path)})
