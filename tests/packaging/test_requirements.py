"""The requirements files have a tested version of every dependency that pyproject.toml names.

requirements-view.txt has those of all extras; requirements.txt has the same ones without those of ``view``
and ``parquet``.
"""

import re
import tomllib
from typing import Final

import pytest
from packaging.requirements import Requirement

from tests.support.fresh_clones import ROOT

PROJECT: Final = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS: Final = PROJECT["optional-dependencies"]
NAMES: Final = {
    "requirements.txt": EXTRAS.keys() - {"parquet", "view"},
    "requirements-view.txt": EXTRAS.keys(),
}
"""The extras whose dependencies each file has."""


def text_of(name: str) -> str:
    return (ROOT / name).read_text()


def locked_in(name: str) -> list[Requirement]:
    lines = [line for line in text_of(name).splitlines() if not line.startswith(" ")]
    return [Requirement(line.removesuffix(" \\")) for line in lines]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13", "3.14"])
def test_every_dependency_is_locked_once_in_a_version_that_it_accepts(python: str, name: str) -> None:
    environment = {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "sys_platform": "linux",
        "platform_machine": "x86_64",
    }
    extras = (EXTRAS[extra] for extra in NAMES[name])
    for wanted in (Requirement(text) for texts in (PROJECT["dependencies"], *extras) for text in texts):
        [locked] = [
            each
            for each in locked_in(name)
            if each.name == wanted.name and (each.marker is None or each.marker.evaluate(environment))
        ]
        [specifier] = locked.specifier
        assert specifier.operator == "=="
        assert specifier.version in wanted.specifier, "run make lock"


@pytest.mark.parametrize("name", NAMES)
def test_every_package_has_hashes_and_no_address(name: str) -> None:
    entries = re.split(r"\n(?! )", text_of(name).strip())
    assert len(entries) == len(locked_in(name))
    assert all("--hash=sha256:" in entry for entry in entries)
    assert "://" not in text_of(name)


def test_the_service_has_the_same_versions_without_the_view() -> None:
    small, large = ({str(each) for each in locked_in(name)} for name in NAMES)
    assert small < large
    assert not any(text.startswith(("viser", "pyarrow")) for text in small)
