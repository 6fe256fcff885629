"""The Debian package as a file: lintian finds no error, and a second build gives the same bytes."""

import hashlib
import os
import subprocess
from pathlib import Path

import pytest

from tests.release.test_debian_package import package
from tests.support.fresh_clones import ROOT, pip_environment
from tests.support.needs import need_programs

__all__ = ["package"]  # a fixture

pytestmark = [pytest.mark.netns, pytest.mark.timeout(1800)]


def test_lintian_finds_no_error(package: Path) -> None:
    need_programs("lintian", packages="lintian")
    subprocess.run(["lintian", "--allow-root", "--fail-on=error", package], check=True)


def test_a_second_build_gives_the_same_bytes(package: Path) -> None:
    first = hashlib.sha256(package.read_bytes()).hexdigest()
    command = ["sh", "-c", "umask 077; exec make --silent deb"]
    environment = {**os.environ, **pip_environment(), "MAKEFLAGS": "", "TZ": "Asia/Tokyo"}
    subprocess.run(command, cwd=ROOT, check=True, env=environment)
    assert hashlib.sha256(package.read_bytes()).hexdigest() == first
