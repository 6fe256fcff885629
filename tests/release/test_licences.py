"""The licences of what is shipped: texts of all packages, and no licence that nobody has looked at."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.packaging.test_requirements import locked_in
from tests.support.builds import release


def environment_with(folder: Path, name: str, *metadata: str) -> Path:
    """Make a Python that has one package, with these lines in its metadata."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    [packages] = folder.glob("lib/python3*/site-packages")
    info = packages / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "\n".join(["Metadata-Version: 2.4", f"Name: {name}", "Version: 1.0", *metadata])
    )
    return folder / "bin/python"


@pytest.mark.wheelhouse
@pytest.mark.timeout(600)
def test_the_file_has_the_licence_of_each_package(python: Path, tmp_path: Path) -> None:
    result = release("-m", "release.licences", python, tmp_path / "THIRD_PARTY.txt")
    assert result.returncode == 0, result.stderr
    sections = (tmp_path / "THIRD_PARTY.txt").read_text().lower().split(f"\n{'=' * 80}\n")
    names = {section.split()[0].replace("_", "-") for section in sections[1:]}
    locked = {
        each.name for each in locked_in("requirements.txt") if not each.marker or each.marker.evaluate()
    }
    assert names == locked | {"mypy"}
    [lcm] = [section for section in sections if section.startswith("lcm ")]
    assert "licence: lgpl-2.1-only" in lcm
    assert "gnu lesser general public license" in lcm


@pytest.mark.parametrize(
    ("metadata", "problem"),
    [
        ("License-Expression: MIT OR GPL-3.0-only", None),
        ("License-Expression: Apache-2.0 WITH LLVM-exception", None),
        ("License: BSD-3-Clause", None),
        ("License-Expression: MIT AND GPL-3.0-only", "MIT AND GPL-3.0-only is not allowed"),
        ("License: Proprietary", "unknown licence, ['Proprietary']"),
        ("Classifier: License :: OSI Approved", "unknown licence, []"),
    ],
)
def test_a_licence_that_is_unknown_or_not_allowed_is_refused(
    metadata: str, problem: str | None, tmp_path: Path
) -> None:
    python = environment_with(tmp_path / "venv", "newcomer", metadata)
    result = release("-m", "release.licences", python, tmp_path / "THIRD_PARTY.txt")
    expected = f"newcomer 1.0: {problem}\nSee release/licences.toml.\n" if problem else ""
    assert result.stderr == expected
    assert result.returncode == bool(problem)
