"""Check which modules this run tests: the sources, or with ``make test-compiled`` the compiled modules."""

import importlib
import os
import subprocess
import sys
from typing import Final

import pytest

from tests.support.fresh_clones import COMPILED_MODULES, ROOT

_EXPECT_COMPILED: Final = os.environ.get("RTC3D_COMPILED") == "1"


@pytest.mark.parametrize("path", COMPILED_MODULES)
def test_modules_are_compiled_only_in_runs_for_compiled_modules(path: str) -> None:
    module = importlib.import_module(path.removesuffix(".py").replace("/", "."))
    assert str(module.__file__).endswith(".so") is _EXPECT_COMPILED, f"{module.__file__}: see docs/dev"


def test_programs_started_by_tests_use_the_same_modules() -> None:
    command = [sys.executable, "-m", "gateway", "--version"]
    output = subprocess.check_output(command, cwd=ROOT, text=True)
    assert output.endswith(" (compiled)\n") is _EXPECT_COMPILED
