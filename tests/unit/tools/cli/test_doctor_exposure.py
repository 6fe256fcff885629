"""``rtc3d-gateway doctor --exposure``: its exit status, and which options go together."""

import json
from pathlib import Path

import pytest

from tests.support.commands import run_in_process
from tests.support.configurations import write_config
from tests.support.errors import names


@pytest.mark.parametrize("remote_control", [True, False])
def test_the_status_is_1_if_others_can_control_recordings(tmp_path: Path, remote_control: bool) -> None:
    """A script that runs before the lab opens can rely on it, with and without JSON."""
    config = write_config(
        tmp_path / "gateway.yaml",
        3020,
        source={"remote_control": remote_control},
        rtc3d={"enabled": True, "host": "0.0.0.0", "ports": {"lab": 3120}},  # noqa: S104 - not bound
    )
    text = run_in_process("doctor", "--exposure", "--config", config, "--view", "127.0.0.1")
    assert text.returncode == remote_control
    assert ("FAIL" if remote_control else "warn") in text.stdout
    assert "tcp 8080" in text.stdout
    as_json = run_in_process("doctor", "--exposure", "--config", config, "--view", "[::1]:8081", "--json")
    assert as_json.returncode == remote_control
    ports = json.loads(as_json.stdout)["ports"]
    assert [(port["host"], port["port"]) for port in ports] == [("0.0.0.0", 3120), ("::1", 8081)]  # noqa: S104


@pytest.mark.parametrize(
    "options", [("--view", "::1"), ("--exposure", "--no-connect"), ("--exposure", "--subscriber")]
)
def test_exposure_connects_to_nothing_and_view_is_for_it(options: tuple[str, ...]) -> None:
    ended = run_in_process("doctor", *options)
    assert ended.returncode == 2
    assert names(ended.stderr, "--view", "--exposure")
