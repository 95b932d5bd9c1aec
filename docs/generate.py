"""Generate the reference pages from the code, and pages that show the source files to which other pages link.

MkDocs calls `on_files`, `on_page_markdown` and `on_post_build` (`hooks` in mkdocs.yml). `generated()` needs fdi_torch
only, so that tests can check links without MkDocs.
"""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Iterable, Iterator
from importlib import import_module
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any

import fdi_torch
from fdi_torch.cli import COMMANDS, options_of
from fdi_torch.cli.options import add_arguments
from fdi_torch.config.key_reference import keys
from fdi_torch.config.plant_writer import plant_mapping
from fdi_torch.logbook.schemas import TOPICS
from fdi_torch.plant.description import FLOW_KINDS, PlantDescription, Tank
from fdi_torch.plant.effect import fits
from fdi_torch.plant.flow_component import FlowComponent

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
FILES = {"Run file": "train", "Monitor file": "monitor", "Study file": "study", "Rehearsal file": "rehearse"}
LINK = re.compile(r"(?<!!)\]\(([^)\s#:]+)(#[^)\s]*)?\)")
LOADED = re.compile(r'(?:src|<link[^>]* href)="(https?://[^"]*)"')
FENCE = re.compile(r"^```.*?^```", re.S | re.M)
CODE = {".py": "python", ".yaml": "yaml", ".toml": "toml", ".md": "markdown", ".hpp": "cpp"}


def generated() -> dict[str, str]:
    """Markdown of every generated page by its path in docs/."""
    return {
        "reference/commands.md": commands(),
        "reference/command-paths.md": command_paths(),
        "reference/configuration.md": configuration(),
        "reference/plant-file.md": plant_file(),
        "reference/effects.md": effects(),
        "reference/log-topics.md": log_topics(),
        "reference/python-api.md": python_api(),
    }


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table whose cells are escaped, unless they are code."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(list(header))]
    lines += ["| " + " | ".join(cell(c) for c in row) + " |" for row in rows]
    return "\n".join(lines)


def cell(text: str) -> str:
    text = " ".join(text.split())
    return text if text.startswith("`") else text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def code(text: str) -> str:
    return f"`{text}`" if text else ""


def commands() -> str:
    rows = ((f"[`{name}`](#fdi-{name})", options_of(name).SUMMARY) for name in COMMANDS)
    parts = [
        "# Commands",
        "Generated from the argument parsers. Results go to standard output, progress to standard error. Exit codes: "
        "0 done, 2 misuse, 3 ran but did not converge (recover, replay: something was lost, or differs), 4 "
        "converged, but the model does not explain the recording (check: something is wrong), 130 interrupted, 143 "
        "terminated.",
        "\n".join(["| command | purpose |", "|---|---|", *(f"| {a} | {cell(b)} |" for a, b in rows)]),
        "Every command also has `--json` (print JSON and nothing else on standard output; monitor: a line an event), "
        "`--quiet` (no progress) and `--traceback` (show where an error arose).",
        *(command(name) for name in COMMANDS),
    ]
    return "\n\n".join(parts) + "\n"


def command_paths() -> str:
    """The functions of each command in the order of their calls, from the docstrings of its module."""
    rows = ((code(name), " → ".join(f"`{f}`" for f in path_of(name))) for name in COMMANDS)
    return "\n\n".join(
        [
            "# The path of each command",
            "Generated from the docstrings of `cli/COMMAND.py`: the main functions (below `fdi_torch.`) in the order "
            "in which they are called. Every command starts in `cli.main`, which reads the arguments that "
            "`cli/options/COMMAND.py` declares.",
            "\n".join(["| command | path |", "|---|---|", *(f"| {a} | {b} |" for a, b in rows)]) + "\n",
        ]
    )


def path_of(name: str) -> list[str]:
    text = (import_module(f"fdi_torch.cli.{name}").__doc__ or "").partition("Path: ")[2]
    return re.findall(r"[a-z_]+(?:\.\w+)+", text)


def command(name: str) -> str:
    options = import_module(f"fdi_torch.cli.options.{name}")
    rows = [(code(usage(action)), (action.help or "").replace("%%", "%")) for action in parser_of(name)._actions]
    listed = [table(("argument", "meaning"), rows)] if rows else []
    examples = options.EXAMPLES.replace("examples:", "").strip("\n")
    return "\n\n".join([f"## fdi {name}", doc(options), *listed, f"```sh\n{inspect.cleandoc(examples)}\n```"])


def parser_of(command: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=f"fdi {command}", add_help=False)
    add_arguments(parser, command)
    return parser


def usage(action: argparse.Action) -> str:
    """An option with its value, as the help shows it."""
    value = action.metavar or ("{" + ",".join(map(str, action.choices)) + "}" if action.choices else "")
    value = value if isinstance(value, str) else " ".join(value)
    return " ".join([*action.option_strings[:1], value]).strip() or action.dest


def doc(thing: Any) -> str:
    return plain(inspect.cleandoc(thing.__doc__ or ""))


def plain(text: str) -> str:
    """A docstring as Markdown: what stands between backticks stays code, and nothing else is markup."""
    parts = text.split("`")
    for i in range(0, len(parts), 2):
        parts[i] = re.sub(r"([*_])", r"\\\1", parts[i]).replace("<", "&lt;")
    return "`".join(parts)


def configuration() -> str:
    parts = [
        "# Configuration files",
        "Generated from the models that read the files. `N` stands for the index in a list, `NAME` for any name; "
        "values may have units (`300 s`, `50 cm^3/s`). `extends: FILE` takes the keys of another file first, and "
        "`--set KEY=VALUE` changes one key on the command line. The recordings' keys are explained in "
        "[Use your own data](../how-to/own-data.md).",
    ]
    run_keys = set(keys_of("train"))
    for title, command in FILES.items():
        rows = [row for row in keys_of(command) if command != "study" or row not in run_keys]
        users = "`fdi train` and `fdi simulate`" if command == "train" else f"`fdi {command}`"
        note = "All keys of a run file, and in addition:\n\n" if command == "study" else ""
        parts.append(f"## {title}\n\nRead by {users}.\n\n{note}{key_table(rows)}")
    return "\n\n".join(parts) + "\n"


def keys_of(command: str) -> list[tuple[str, str, str]]:
    """Path, default and meaning of every key of the file that a command reads, as its option `--keys` prints them."""
    shown = next(action for action in parser_of(command)._actions if "--keys" in action.option_strings)
    models = [model.split(":") for model in shown.models]  # type: ignore[attr-defined]
    return [row for module, name in models for row in keys(getattr(import_module(module), name))]


def key_table(rows: Iterable[tuple[str, str, str]]) -> str:
    return table(("key", "default", "meaning"), ((code(path), code(default), text) for path, default, text in rows))


def plant_file() -> str:
    shipped = sorted((ROOT / "configs" / "plants").glob("*.yaml"))
    return (
        "\n\n".join(
            [
                "# Plant file",
                "Generated from the model that reads the file. `fdi new plant` writes a commented example, `fdi check "
                "--plant FILE` checks one, and `--picture FILE` draws it. Values have units; the table gives SI units.",
                key_table(keys_of("check")),
                "## Flow components",
                "A flow component has a section for its kind, and its name is its key there. Effects are placed on it "
                "by that name.",
                *(flow_kind(kind) for kind in FLOW_KINDS),
                "## Shipped plants",
                "A name may stand in place of a file; `fdi check --plant NAME` shows sizes and columns.",
                table(("name", "plant"), ((code(path.stem), introduction(path)) for path in shipped)),
                "```yaml\n" + (ROOT / "configs/plants/three_tank.yaml").read_text(encoding="utf-8") + "```",
            ]
        )
        + "\n"
    )


def introduction(path: Path) -> str:
    """The comment with which a file begins."""
    lines = takewhile(lambda line: line.startswith("#"), path.read_text(encoding="utf-8").splitlines())
    return " ".join(line.lstrip("# ") for line in lines)


def flow_kind(kind: type[FlowComponent]) -> str:
    """The law of a kind of flow component, an example, and the effects that can be placed on it."""
    tanks = (Tank("A", 0.015, 0.5), Tank("B", 0.015, 0.5))
    parts: dict[str, Any] = {kind.part(): (kind.example("X", "A", "B"),)}
    plant = PlantDescription("example", tanks, **parts)
    component = next(plant.flow_components())
    section = plant_mapping(plant)[kind.part()]["X"]
    example = ", ".join(f"{key}: {value}" for key, value in section.items())
    names = [f"[`{e.name}`](effects.md#{e.name})" for e in fdi_torch.EFFECTS if fits(e, plant, component.name)]
    law = plain(inspect.cleandoc(kind.__doc__ or ""))
    block = f"```yaml\n{kind.part()}:\n  X: {{{example}}}\n```"
    return f"### {kind.part()}\n\n{law}\n\n{block}\n\nEffects: {', '.join(names)}."


def effects() -> str:
    entries = fdi_torch.effects().entries
    known = {entry.name for entry in entries}
    rows = [f"| [`{e.name}`](#{e.name}) | {cell(e.meaning)} | {', '.join(e.kinds)} | {e.stage} |" for e in entries]
    parts = [
        "# Effects",
        "Generated from the library. A fault and an unmodelled effect are the same thing: a deviation of one component "
        "with an equation and parameters. The first parameter is the size; where it is nominal, the effect is absent. "
        "Ranges are those of a rig of 1 m height; `fdi effects --plant FILE` gives them for your plant. A new one is "
        "[one file and one line](../contributing.md#add-an-effect-without-or-with-memory).",
        "\n".join(["| effect | meaning | sits at a | stage |", "|---|---|---|---|", *rows]),
    ]
    for e in entries:
        parameters = [
            (code(p.name), p.unit, f"{p.nominal:g}", f"{p.low:.4g} to {p.high:.4g}", p.meaning) for p in e.parameters
        ]
        confused = ", ".join(f"[`{name}`](#{name})" for name in e.mistaken_for if name in known)
        parts += [
            f"## {e.name}",
            f"{e.meaning}. Sits at: {', '.join(e.kinds)}. Acts {e.begins}.",
            plain(e.law),
            table(("parameter", "unit", "nominal", "range", "meaning"), parameters),
            f"In a run file: `{e.in_a_run_file}`. In a plant file:\n\n```yaml\neffects:\n  {e.in_a_plant_file}\n```",
        ]
        parts += [f"Easily mistaken for {confused}."] if confused else []
    return "\n\n".join(parts) + "\n"


def log_topics() -> str:
    parts = [
        "# Log topics",
        "Generated from the schemas. Every message also has `t`, the plant's time in seconds. Topics marked *named* "
        "carry further numbers under names of channels or parameters. How a log is built: [Logs](logs.md).",
    ]
    for name, topic in TOPICS.items():
        fields = [(code(field), kind, unit, meaning) for field, (kind, unit, meaning) in topic.fields.items()]
        named = " *(named)*" if topic.named else ""
        parts.append(f"## {name}\n\n{topic.meaning[:1].upper() + topic.meaning[1:]}.{named} Schema `{topic.schema}`.")
        parts += [table(("field", "kind", "unit", "meaning"), fields)] if fields else []
    return "\n\n".join(parts) + "\n"


def python_api() -> str:
    names = fdi_torch.__all__
    parts = [
        "# Python API",
        "Generated from `fdi_torch.__all__`. Tensors are in SI, with leading dimensions as batches; `table()` is in "
        "your units. Examples: [Use it from Python](../how-to/python.md).",
        " · ".join(f"[`{name}`](#{anchor(name)})" for name in names),
        *(api_entry(name, getattr(fdi_torch, name)) for name in names),
    ]
    return "\n\n".join(parts) + "\n"


def anchor(name: str) -> str:
    """Of an entry: `EFFECTS` and `effects` differ in case only."""
    return name.lower() if name != "EFFECTS" else "effects-the-tuple"


def api_entry(name: str, thing: Any) -> str:
    if not callable(thing):
        return f"## {name}, the tuple\n\nA tuple of {len(thing)} effects: the [catalogue](effects.md) as objects."
    thing = getattr(thing, "__wrapped__", thing)
    parts = [f"## {name}", f"```python\n{signature(name, thing)}\n```", doc(thing), f"Defined in `{thing.__module__}`."]
    if inspect.isclass(thing):
        rows = [(code(member), summary) for member, summary in members(thing)]
        parts += [table(("member", "meaning"), rows)] if rows else []
    return "\n\n".join(parts)


class _Annotation:
    """An annotation that is shown as it is written."""

    def __init__(self, text: Any) -> None:
        self.text = text if isinstance(text, str) else inspect.formatannotation(text)

    def __repr__(self) -> str:
        return self.text


def signature(name: str, thing: Any) -> str:
    try:
        found = inspect.signature(thing)
    except ValueError:
        return name
    empty = inspect.Parameter.empty
    parameters = [
        p if p.annotation is empty else p.replace(annotation=_Annotation(p.annotation))
        for p in found.parameters.values()
    ]
    back = found.return_annotation
    back = empty if inspect.isclass(thing) or back is empty else _Annotation(back)
    found = found.replace(parameters=parameters, return_annotation=back)
    shown = name + str(found)
    if len(shown) < 100:
        return shown
    lines = [f"    {p}," for p in parameters]
    named = [i for i, p in enumerate(parameters) if p.kind is inspect.Parameter.KEYWORD_ONLY]
    if named:
        lines.insert(named[0], "    *,")
    return "\n".join([f"{name}(", *lines, ")" if back is empty else f") -> {back}"])


def members(cls: type) -> Iterator[tuple[str, str]]:
    """Public methods and properties of a class and of its own bases, with the first paragraph of their docstrings."""
    seen = set()
    for base in cls.__mro__:
        if not base.__module__.startswith("fdi_torch"):
            continue
        for name, value in vars(base).items():
            plain = value.__func__ if isinstance(value, staticmethod | classmethod) else value
            if name.startswith("_") or name in seen or not (inspect.isfunction(plain) or isinstance(plain, property)):
                continue
            seen.add(name)
            first = inspect.cleandoc(plain.__doc__ or "").split("\n\n")[0]
            yield name if isinstance(plain, property) else f"{name}()", first


def outside(page: str, text: str) -> Iterator[tuple[str, str]]:
    """Links of a page to files that are no pages of the site: the link, and the file's path in the repository."""
    for target, _ in LINK.findall(FENCE.sub("", text)):
        path = (DOCS / PurePosixPath(page).parent / target).resolve()
        if path.is_file() and (path.suffix == ".py" or not path.is_relative_to(DOCS)):
            yield target, path.relative_to(ROOT).as_posix()


def source_page(path: str) -> str:
    text = (ROOT / path).read_text(encoding="utf-8")
    return f"# {path}\n\n````{CODE.get(Path(path).suffix, 'text')}\n{text}\n````\n"


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages, and a page for each source file that some page links to."""
    from mkdocs.structure.files import File

    pages = {f.src_uri: f.content_string for f in files if f.src_uri.endswith(".md")}
    made = generated()
    linked = {path for page, text in [*pages.items(), *made.items()] for _, path in outside(page, text)}
    for name, text in [*made.items(), *((f"source/{path}.md", source_page(path)) for path in sorted(linked))]:
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Lead links to source files to their pages."""
    name = page.file.src_uri
    for target, path in set(outside(name, markdown)):
        up = "../" * name.count("/")
        markdown = markdown.replace(f"]({target})", f"]({up}source/{path}.md)")
    return markdown


def on_post_build(config: Any) -> None:
    """Raises ValueError if a page of the site loads something from elsewhere."""
    for page in sorted(Path(config["site_dir"]).rglob("*.html")):
        if loaded := LOADED.findall(page.read_text(encoding="utf-8")):
            raise ValueError(f"{page}: expected a page that loads nothing from elsewhere, got {', '.join(loaded)}")
