"""Programs of earlier versions beside a gateway of this one, which streams a take of theirs."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pytest
import uvloop

from tests.compatibility.comparing import broken, broken_kinds
from tests.compatibility.lab import moment, observe
from tests.compatibility.promises import VERSIONS, recorded
from tests.compatibility.test_promises import messages_of

pytestmark = pytest.mark.netns

TAKE: Final = VERSIONS[0] / "take.lcmlog"

# They depend on when the take is played. Buttons have the server's time.
_CHANGING: Final = {
    "utime",
    "capture_utime",
    "sequence",
    "session",
    "parameters_version",
    "timestamp",
    "events",
}


def decoded(messages: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, str]]:
    """Return what does not change when a take is played; as text, because NaN does not equal itself."""
    return {
        name: {key: json.dumps(value) for key, value in values.items() if key not in _CHANGING}
        for name, values in messages.items()
    }


SENT: Final = decoded({moment(each): each for each in messages_of(TAKE) if "frame_number" in each})
"""The messages with frames in the take, by what identifies them."""


def test_programs_of_earlier_versions_find_what_they_found(tmp_path: Path) -> None:
    """Subscribers, queries and scripts go on working: on Zenoh, on LCM, and with what commands print as JSON.

    One gateway serves them all, because starting it and the commands takes the time.
    """
    network = recorded(VERSIONS[-1], "network")
    observed = uvloop.run(observe(TAKE, tmp_path, network["keys"], network["channels"], SENT))
    changes = [f"the subscriber of 1.0 misses {each}" for each in broken(SENT, decoded(observed.received))]
    for version in VERSIONS:
        promised = f"{version.name} promised"
        changes += [f"{promised} {each}" for each in broken(recorded(version, "network"), observed.network)]
        for command, output in recorded(version, "json_outputs").items():
            found = broken_kinds(output, observed.outputs[command])
            changes += [f"{promised} {command} with --json, {each}" for each in found]
    assert not changes
