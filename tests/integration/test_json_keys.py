"""JSON on Zenoh as a web page gets it, and the commands, which must not take it for something else."""

import contextlib
import json
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
import zenoh

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.takes.files.event_log import EventLogReader
from gateway.tools.display.live import LiveData
from tests.support.commands import run_command
from tests.support.configurations import write_config
from tests.support.gateway_process import program, simulator
from tests.support.networks import free_endpoint, wait_for_zenoh, zenoh_keys
from tests.support.waiting import wait_until

SCENE: Final = ("--rate", "100", "--analog-rate", "100", "--markers", "12", "--analog", "8", "--tools", "2")
COMPONENTS: Final = {"3d", "6d", "analog", "force", "event"}


class Lab(NamedTuple):
    """A gateway and a peer of it.

    ``everything`` has the keys of all that is published, also of JSON: a careless program asks for it.
    """

    endpoint: str
    takes: Path
    peer: zenoh.Session
    everything: Counter[str]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("lab")
    endpoint = free_endpoint()
    everything: Counter[str] = Counter()
    with ExitStack() as stack:
        port, _ = stack.enter_context(simulator(*SCENE))
        config = write_config(
            folder / "gateway.yaml",
            port,
            source={"remote_control": True},
            zenoh={"tool_poses": True, "config": zenoh_keys("router", listen=endpoint)},
            takes={"enabled": True, "directory": str(folder / "takes")},
        )
        log = stack.enter_context((folder / "gateway.log").open("wb"))
        stack.enter_context(program("run", "--config", str(config), stderr=log))
        peer = wait_for_zenoh(endpoint)
        stack.callback(peer.close)
        peer.declare_subscriber("mocap/lab/**", lambda sample: everything.update([str(sample.key_expr)]))
        wait_until(lambda: all(everything[f"mocap/lab/{key}/json"] > 1 for key in COMPONENTS))
        wait_until(lambda: any(key.startswith("mocap/lab/6d/") for key in everything))
        yield Lab(endpoint, folder / "takes", peer, everything)


def test_a_web_page_gets_labelled_markers_at_its_pace(lab: Lab) -> None:
    """30 messages a second of 100, evenly spaced by the time of their capture."""
    received: list[dict[str, Any]] = []
    with lab.peer.declare_subscriber(
        "mocap/lab/3d/json", lambda sample: received.append(json.loads(sample.payload.to_string()))
    ):
        wait_until(lambda: len(received) >= 61)
    first, *_, last = received
    assert len(first["labels"]) == len(first["markers"]) == 12
    assert len(set(first["labels"])) == 12
    duration_s = (last["capture_utime"] - first["capture_utime"]) / 1e6
    assert (len(received) - 1) / duration_s < 31


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        ("echo --count 300 --json", [f'"mocap/lab/{key}"' for key in ("3d", "6d", "analog", "force")]),
        ("echo --hz --count 300", ["mocap/lab/6d/"]),
        ("echo --component 6d/* --count 50", ["mocap/lab/6d/"]),
        ("list --json", ['"source": "lab"', '"problem": ""']),
        ("params 3d --json", ["Marker 1"]),
        ("top --json --once", ['"num_foreign":0', '"num_beyond":0']),
    ],
)
def test_commands_show_messages_and_no_json(lab: Lab, arguments: str, shown: list[str]) -> None:
    done = run_command(*arguments.split(), "--source", "lab", "--connect", lab.endpoint)
    assert (done.status, done.stderr) == (0, "")
    assert [text for text in shown if text not in done.stdout] == []
    assert "/json" not in done.stdout


def channels_in(file: Path) -> set[str]:
    return {event.channel for event in EventLogReader(file).events()}


def test_recordings_have_messages_and_no_json(lab: Lab, tmp_path: Path) -> None:
    """What ``record`` writes, and the gateway's own take of the same time."""
    file = tmp_path / "take.lcmlog"
    assert run_command("take", "start", "one", "--source", "lab", "--connect", lab.endpoint).status == 0
    done = run_command("record", str(file), "--seconds", "3", "--source", "lab", "--connect", lab.endpoint)
    assert run_command("take", "stop", "--source", "lab", "--connect", lab.endpoint).status == 0
    assert done.status == 0
    assert "left out" not in done.stdout + done.stderr
    for channels in (channels_in(file), channels_in(lab.takes / "lab" / "one.lcmlog")):
        assert {"MOCAP_LAB_3D", "MOCAP_LAB_6D"} <= channels
        assert not [channel for channel in channels if "JSON" in channel]


def test_the_view_receives_messages_and_no_json(lab: Lab) -> None:
    live = LiveData()
    client = GatewayClient(GatewayAddress(connect=lab.endpoint))
    with contextlib.closing(client.subscribe(["lab"], None, live)):
        wait_until(lambda: any(series.num_messages > 100 for series in live.all_series))
        wait_until(lambda: len(live.all_series) >= 8)
    assert (live.num_foreign, live.num_beyond) == (0, 0)
    assert not [series.key for series in live.all_series if series.key.endswith("json")]
