"""The doctor's checks of LSL, with streams that need not exist."""

import socket
from pathlib import Path

import pytest

from gateway.findings import Result
from gateway.outputs.lsl import checks
from gateway.outputs.lsl.settings import LslSettings
from tests.lsl_receiver import lsl_config


def test_streams_of_a_source_whose_name_begins_alike_are_not_those_of_this_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    names = ("doctor_event", "lab_2_3d", "lab_2_event")
    streams = [{"computer": socket.gethostname(), "name": name} for name in names]
    monkeypatch.setattr(checks, "_find_streams", lambda *_: streams)
    settings = LslSettings(enabled=True, config=str(lsl_config(tmp_path)))
    opens, found, gateway = checks.check_lsl(settings, ["lab", "lab_2"], [], 20.0)
    assert (opens.result, found.result) == (Result.PASSING, Result.PASSING)
    assert gateway.result is Result.WARNING
    assert gateway.found == "streams of lab_2 are offered, but none of lab"
