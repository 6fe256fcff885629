"""requirements.txt has a tested version of every dependency that pyproject.toml names."""

import re
import tomllib
from typing import Final

import pytest
from packaging.requirements import Requirement

from tests.fresh_clones import ROOT

PROJECT: Final = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TEXT: Final = (ROOT / "requirements.txt").read_text()
LOCKED: Final = [
    Requirement(line.removesuffix(" \\")) for line in TEXT.splitlines() if not line.startswith(" ")
]
EXTRAS: Final = PROJECT["optional-dependencies"].values()
WANTED: Final = [Requirement(text) for texts in (PROJECT["dependencies"], *EXTRAS) for text in texts]


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13", "3.14"])
def test_every_dependency_is_locked_once_in_a_version_that_it_accepts(python: str) -> None:
    environment = {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "sys_platform": "linux",
        "platform_machine": "x86_64",
    }
    for wanted in WANTED:
        [locked] = [
            each
            for each in LOCKED
            if each.name == wanted.name and (each.marker is None or each.marker.evaluate(environment))
        ]
        [specifier] = locked.specifier
        assert specifier.operator == "=="
        assert specifier.version in wanted.specifier, "run make lock"


def test_every_package_has_hashes_and_no_address() -> None:
    entries = re.split(r"\n(?! )", TEXT.strip())
    assert len(entries) == len(LOCKED)
    assert all("--hash=sha256:" in entry for entry in entries)
    assert "://" not in TEXT
