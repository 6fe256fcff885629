"""No test of takes fails because the machine is busy: no limit of waiting for the disk is reached by load."""

import pytest

from gateway.outputs.takes import disk, output


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests that need a limit set their own, while it is reached."""
    monkeypatch.setattr(disk, "_TIMEOUT_S", 300.0)
    monkeypatch.setattr(output, "_CLOSE_S", 300.0)
