"""Whether a run tests what it says: the sources, or with ``make test-compiled`` what was compiled of them."""

import importlib
import os
import subprocess
import sys
from typing import Final

import pytest

from tests.fresh_clones import COMPILED_MODULES, ROOT

_WANTED: Final = os.environ.get("RTC3D_COMPILED") == "1"


@pytest.mark.parametrize("path", COMPILED_MODULES)
def test_modules_are_compiled_where_that_is_tested_and_nowhere_else(path: str) -> None:
    module = importlib.import_module(path.removesuffix(".py").replace("/", "."))
    assert str(module.__file__).endswith(".so") is _WANTED, f"{module.__file__}: see CONTRIBUTING.md"


def test_the_programs_that_tests_start_are_so_too() -> None:
    command = [sys.executable, "-m", "gateway", "--version"]
    said = subprocess.check_output(command, cwd=ROOT, text=True)
    assert said.endswith(" (compiled)\n") is _WANTED
