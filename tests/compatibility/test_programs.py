"""Programs of earlier versions beside a gateway of this one, which streams a take of theirs."""

import json
from pathlib import Path
from typing import Final

import pytest
import uvloop

from tests.compatibility.comparing import broken, broken_kinds
from tests.compatibility.lab import Observed, moment, observe
from tests.compatibility.promises import VERSIONS, recorded
from tests.compatibility.test_promises import each_version, messages_of

pytestmark = pytest.mark.netns

TAKE: Final = VERSIONS[0] / "take.lcmlog"
SENT: Final = {
    moment(values): json.loads(json.dumps(values)) for values in messages_of(TAKE) if "frame_number" in values
}
"""The messages with frames in the take, by what identifies them."""


@pytest.fixture(scope="module")
def observed(tmp_path_factory: pytest.TempPathFactory) -> Observed:
    network = recorded(VERSIONS[0], "network")
    folder = tmp_path_factory.mktemp("lab")
    return uvloop.run(observe(TAKE, folder, network["keys"], network["channels"], SENT))


@each_version
@pytest.mark.parametrize("name", ["keys", "channels", "tokens", "json", "answers"])
def test_keys_channels_and_queries_have_what_they_had(version: Path, observed: Observed, name: str) -> None:
    """Subscribers find what they ask for, under the same name and in the same encoding."""
    changes = list(broken(recorded(version, "network")[name], observed.network[name]))
    assert not changes, f"{version.name} promised these {name}"


@each_version
@pytest.mark.parametrize("command", sorted(recorded(VERSIONS[0], "json_outputs")))
def test_json_has_what_it_had(version: Path, observed: Observed, command: str) -> None:
    """Scripts find every field that they know, with a value of the same kind."""
    changes = list(broken_kinds(recorded(version, "json_outputs")[command], observed.outputs[command]))
    assert not changes, f"{version.name} printed this for {command}"


def test_a_subscriber_of_1_0_decodes_what_a_gateway_of_this_version_publishes(observed: Observed) -> None:
    """It uses the published layout only, as programs in other languages do."""
    changing = {"utime", "capture_utime", "sequence", "session", "parameters_version", "timestamp", "events"}
    for name, sent in SENT.items():
        # As text, because NaN does not equal itself.
        expected = {key: str(value) for key, value in sent.items() if key not in changing}
        assert not list(broken(expected, {key: str(value) for key, value in observed.received[name].items()}))
