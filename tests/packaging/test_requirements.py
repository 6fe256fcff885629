"""The requirements files have a tested version of every dependency that pyproject.toml names.

requirements-view.txt has those of all extras; requirements.txt has the same ones without those of ``view``
and ``parquet``. The files in release/ have the tools of a build and of a release.
"""

import re
import tomllib
from typing import Final

import pytest
from packaging.requirements import Requirement

from tests.support.fresh_clones import ROOT

PYPROJECT: Final = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT: Final = PYPROJECT["project"]
EXTRAS: Final = PROJECT["optional-dependencies"]
NAMES: Final = {
    "requirements.txt": EXTRAS.keys() - {"parquet", "view"},
    "requirements-view.txt": EXTRAS.keys(),
}
"""The extras whose dependencies each file has."""

_MYPYC: Final = PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"]["mypyc"]
WANTED: Final[dict[str, list[str]]] = {
    **{
        name: [*PROJECT["dependencies"], *(text for extra in extras for text in EXTRAS[extra])]
        for name, extras in NAMES.items()
    },
    "release/build-requirements.txt": [*PYPROJECT["build-system"]["requires"], *_MYPYC["dependencies"]],
    "release/tool-requirements.txt": PYPROJECT["dependency-groups"]["release"],
}
"""What pyproject.toml requires of each file."""


def text_of(name: str) -> str:
    return (ROOT / name).read_text()


def locked_in(name: str) -> list[Requirement]:
    lines = [line for line in text_of(name).splitlines() if not line.startswith(" ")]
    return [Requirement(line.removesuffix(" \\")) for line in lines]


@pytest.mark.parametrize("name", WANTED)
@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13", "3.14"])
def test_every_dependency_is_locked_once_in_a_version_that_it_accepts(python: str, name: str) -> None:
    environment = {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "sys_platform": "linux",
        "platform_machine": "x86_64",
    }
    for wanted in map(Requirement, WANTED[name]):
        [locked] = [
            each
            for each in locked_in(name)
            if each.name == wanted.name and (each.marker is None or each.marker.evaluate(environment))
        ]
        [specifier] = locked.specifier
        assert specifier.operator == "=="
        assert specifier.version in wanted.specifier, "run make lock"


@pytest.mark.parametrize("name", WANTED)
def test_every_package_has_hashes_and_no_address(name: str) -> None:
    entries = re.split(r"\n(?! )", text_of(name).strip())
    assert len(entries) == len(locked_in(name))
    assert all("--hash=sha256:" in entry for entry in entries)
    assert "://" not in text_of(name)


def test_the_runtime_in_the_compiled_modules_is_that_of_the_mypy_in_the_bill_of_materials() -> None:
    [compiler], [described] = (
        [each for each in locked_in(f"release/{name}-requirements.txt") if each.name == "mypy"]
        for name in ("build", "tool")
    )
    assert compiler == described


def test_the_service_has_the_same_versions_without_the_view() -> None:
    small, large = ({str(each) for each in locked_in(name)} for name in NAMES)
    assert small < large
    assert not any(text.startswith(("viser", "pyarrow")) for text in small)
