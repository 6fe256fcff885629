"""The bill of materials of a file: what it installs or contains, with licences.

The program itself refuses a bill that is not valid CycloneDX.
"""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from packaging.utils import canonicalize_name

from gateway import __version__
from tests.packaging.test_requirements import locked_in
from tests.support.builds import Built, release
from tests.support.fresh_clones import skip_without_compiler

pytestmark = [pytest.mark.wheelhouse, pytest.mark.timeout(600)]

Bill = dict[str, Any]


@pytest.fixture(scope="module")
def files(pure: Built, compiled: Built, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A pure and a compiled wheel, or a second pure one on a machine without a compiler."""
    folder = tmp_path_factory.mktemp("dist")
    return [Path(shutil.copy(each.wheel, folder)) for each in (pure, compiled)]


@pytest.fixture(scope="module")
def bills(files: list[Path], python: Path) -> list[Bill]:
    result = release("-m", "release.sbom", python, *files)
    assert result.returncode == 0, result.stderr
    return [json.loads(Path(f"{file}.cdx.json").read_text()) for file in files]


def test_the_bill_names_the_file_and_its_hash(files: list[Path], bills: list[Bill]) -> None:
    for file, bill in zip(files, bills, strict=True):
        component = bill["metadata"]["component"]
        assert component["version"] == __version__
        assert component["properties"] == [{"name": "file", "value": file.name}]
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        assert component["hashes"] == [{"alg": "SHA-256", "content": digest}]


def test_the_bill_has_each_locked_package_with_its_licence(bills: list[Bill]) -> None:
    """And no other packages: the gateway itself is what the bill is about."""
    locked = {
        (canonicalize_name(each.name), str(each.specifier))
        for each in locked_in("requirements.txt")
        if each.marker is None or each.marker.evaluate()
    }
    found = {(canonicalize_name(each["name"]), f"=={each['version']}") for each in bills[0]["components"]}
    assert found == locked
    assert all(each["licenses"][0]["expression"] for each in bills[0]["components"])


def test_the_bill_has_the_libraries_inside_a_package(bills: list[Bill]) -> None:
    """A flaw in one of them is a flaw of the gateway, although pip does not know them."""
    [zenoh] = [each for each in bills[0]["components"] if each["name"] == "eclipse-zenoh"]
    assert {"rustls", "tokio"} <= {each["name"] for each in zenoh["components"]}


def test_only_the_bill_of_a_compiled_wheel_has_the_runtime_of_mypyc(bills: list[Bill]) -> None:
    skip_without_compiler()
    assert ["mypy" in [each["name"] for each in bill["components"]] for bill in bills] == [False, True]
