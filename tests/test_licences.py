"""docs/licences.md beside pyproject.toml and the metadata of the installed packages."""

from __future__ import annotations

import importlib.metadata
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
FOR_DEVELOPERS = ("test", "docs", "benchmarks")
CLASSIFIED = {
    "MIT License": ("MIT",),
    "BSD License": ("BSD-2-Clause", "BSD-3-Clause"),
    "Apache Software License": ("Apache-2.0",),
    "Mozilla Public License 2.0 (MPL 2.0)": ("MPL-2.0",),
    "Python Software Foundation License": ("PSF-2.0", "Matplotlib licence (of the PSF's kind)"),
    "GNU Lesser General Public License v3 or later (LGPLv3+)": ("LGPL-3.0-or-later",),
    "BSD": ("BSD-2-Clause", "BSD-3-Clause"),
}
"""What older metadata says, as a classifier or in words, and the SPDX identifiers that it may mean."""


def rows() -> Iterator[tuple[str, str, str]]:
    """Package, licence and who needs it (empty in the second table)."""
    for line in (ROOT / "docs" / "licences.md").read_text().splitlines():
        cells = [c.strip() for c in line.strip("|").split("|")]
        if line.startswith("|") and not line.startswith("|---") and not cells[0].startswith("package"):
            for name in cells[0].split(","):
                yield canonicalize_name(name.strip()), cells[1], cells[2] if len(cells) > 2 else ""


PAGE = {name: (licence, needed) for name, licence, needed in rows()}


def named(requirements: Iterable[str]) -> list[str]:
    return [canonicalize_name(Requirement(r).name) for r in requirements]


def stated(package: str) -> tuple[str, ...]:
    """The SPDX expressions that agree with a package's metadata; none if the metadata states no licence."""
    metadata = importlib.metadata.metadata(package)
    if expression := metadata.get("License-Expression"):
        return (expression,)
    classifiers = [c.split(" :: ")[-1] for c in metadata.get_all("Classifier", []) if c.startswith("License ::")]
    words = classifiers or [metadata.get("License") or ""]
    return tuple(spdx for w in words for spdx in CLASSIFIED.get(w, (w,) if w else ()))


def installed(package: str) -> bool:
    try:
        importlib.metadata.distribution(package)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def needed_by(requirements: Iterable[str]) -> set[str]:
    """Installed packages that the requirements bring, directly or in turn."""
    result: set[str] = set()
    todo = [Requirement(r) for r in requirements]
    while todo:
        requirement = todo.pop()
        name = canonicalize_name(requirement.name)
        wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if wanted and name not in result and installed(name):
            result.add(name)
            todo += [Requirement(r) for r in importlib.metadata.requires(name) or []]
    return result


def test_every_named_package_is_on_the_page_with_its_extra() -> None:
    assert {p: PAGE[p][1] for p in named(PROJECT["dependencies"])} == dict.fromkeys(
        named(PROJECT["dependencies"]), "always"
    )
    elsewhere = {p for extra, group in EXTRAS.items() if extra != "test" for p in named(group)}
    for extra, group in EXTRAS.items():
        for package in named(group):
            if extra != "test" or package not in elsewhere:
                assert f"extra `{extra}`" in PAGE[package][1], package


def test_the_page_names_no_package_that_nothing_needs() -> None:
    everything = {p for group in (PROJECT["dependencies"], *EXTRAS.values()) for p in named(group)}
    assert {p for p, (_, needed) in PAGE.items() if needed} == everything


def test_packages_that_come_along_are_on_the_page() -> None:
    for_users = [r for extra, group in EXTRAS.items() if extra not in FOR_DEVELOPERS for r in group]
    assert needed_by([*PROJECT["dependencies"], *for_users]) <= set(PAGE)


@pytest.mark.parametrize("package", sorted(PAGE))
def test_licences_are_those_of_the_metadata(package: str) -> None:
    if not installed(package) or not (expressions := stated(package)):
        pytest.skip(f"{package} is not installed, or its metadata states no licence")
    assert PAGE[package][0] in expressions


def test_the_lowest_versions_are_the_bounds() -> None:
    """arviz needs a higher numpy than fdi_torch, and torch's lowest versions come with CUDA only."""
    lines = (ROOT / "constraints-lowest.txt").read_text().splitlines()
    lowest = {canonicalize_name(r.name): r for r in map(Requirement, (x for x in lines if not x.startswith("#")))}
    user_groups = [group for extra, group in EXTRAS.items() if extra not in FOR_DEVELOPERS]
    for requirement in map(Requirement, [*PROJECT["dependencies"], *(r for g in user_groups for r in g)]):
        name = canonicalize_name(requirement.name)
        if name in ("torch", "arviz-base", "arviz-stats", "ziglang"):
            continue
        (pinned,) = lowest[name].specifier
        (bound,) = requirement.specifier
        assert bound.operator == ">=" and pinned.operator == "=="
        assert requirement.specifier.contains(pinned.version)
        length = len(bound.version.split("."))
        assert pinned.version.split(".")[:length] == bound.version.split("."), name
