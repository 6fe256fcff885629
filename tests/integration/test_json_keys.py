"""JSON on Zenoh as a web page gets it, and the commands, which must not take it for something else."""

import json
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
import yaml
import zenoh

from gateway.live.live_data import LiveData
from gateway.subscriber.subscribe import Transport, subscribe_all
from gateway.takes.event_log import EventLogReader
from tests.gateway_process import PROGRAM, program, simulator
from tests.networks import free_endpoint, wait_for_zenoh, zenoh_keys
from tests.waiting import wait_until

SCENE: Final = ("--rate", "100", "--analog-rate", "100", "--markers", "12", "--analog", "8", "--tools", "2")
COMPONENTS: Final = {"3d", "6d", "analog", "force", "event"}


class Lab(NamedTuple):
    """A gateway with two sources, of which ``lazy`` streams on demand, and a peer of it.

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
        server = {"host": "127.0.0.1", "port": port}
        configuration = {
            "sources": [
                {"name": "lab", "remote_control": True, **server},
                {"name": "lazy", **server, "streams": [{"components": ["3d"], "on_demand": True}]},
            ],
            "zenoh": {"tool_poses": True, "config": zenoh_keys("router", listen=endpoint)},
            "lcm": {"enabled": False},
            "takes": {"enabled": True, "directory": str(folder / "takes")},
            "metrics": {"enabled": False},
        }
        (folder / "gateway.yaml").write_text(yaml.safe_dump(configuration))
        log = stack.enter_context((folder / "gateway.log").open("wb"))
        stack.enter_context(program("run", "--config", str(folder / "gateway.yaml"), stderr=log))
        peer = wait_for_zenoh(endpoint)
        stack.callback(peer.close)
        peer.declare_subscriber("mocap/lab/**", lambda sample: everything.update([str(sample.key_expr)]))
        wait_until(lambda: all(everything[f"mocap/lab/{key}/json"] > 1 for key in COMPONENTS))
        wait_until(lambda: any(key.startswith("mocap/lab/6d/") for key in everything))
        yield Lab(endpoint, folder / "takes", peer, everything)


def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([*PROGRAM, *arguments], capture_output=True, text=True, timeout=60, check=False)


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


def test_a_subscriber_of_json_alone_starts_a_stream_on_demand(lab: Lab) -> None:
    keys: set[str] = set()
    with lab.peer.declare_subscriber("mocap/lazy/3d/json", lambda sample: keys.add(str(sample.key_expr))):
        wait_until(lambda: keys)
    assert keys == {"mocap/lazy/3d/json"}


def test_echo_shows_messages_and_no_json(lab: Lab) -> None:
    shown = run("echo", "--source", "lab", "--count", "300", "--json", "--connect", lab.endpoint)
    assert (shown.returncode, shown.stderr) == (0, "")
    keys = {json.loads(line)["key"] for line in shown.stdout.splitlines()}
    assert {f"mocap/lab/{key}" for key in COMPONENTS - {"event"}} <= keys
    assert any(key.startswith("mocap/lab/6d/") for key in keys)
    assert not [key for key in keys if key.endswith("/json")]


def test_echo_of_rates_and_of_the_poses_shows_no_json(lab: Lab) -> None:
    rates = run("echo", "--hz", "--seconds", "1.5", "--source", "lab", "--connect", lab.endpoint)
    poses = run("echo", "--component", "6d/*", "--count", "50", "--source", "lab", "--connect", lab.endpoint)
    for shown in (rates, poses):
        assert (shown.returncode, shown.stderr) == (0, "")
        assert "mocap/lab/6d/" in shown.stdout
        assert "/json" not in shown.stdout


def test_list_and_params_are_as_without_json(lab: Lab) -> None:
    listed = run("list", "--json", "--source", "lab", "--connect", lab.endpoint)
    [source] = json.loads(listed.stdout)["sources"]
    assert (source["source"], source["problem"]) == ("lab", "")
    params = run("params", "3d", "--source", "lab", "--connect", lab.endpoint)
    assert (params.returncode, params.stderr) == (0, "")


def test_record_writes_messages_and_no_json(lab: Lab, tmp_path: Path) -> None:
    file = tmp_path / "take.lcmlog"
    done = run("record", str(file), "--seconds", "2", "--source", "lab", "--connect", lab.endpoint)
    assert done.returncode == 0
    assert "left out" not in done.stdout + done.stderr
    channels = {event.channel for event in EventLogReader(file).events()}
    assert "MOCAP_LAB_3D" in channels
    assert "MOCAP_LAB_6D" in channels
    assert not [channel for channel in channels if "JSON" in channel]


def test_a_take_of_the_gateway_has_no_json(lab: Lab) -> None:
    assert run("take", "start", "one", "--source", "lab", "--connect", lab.endpoint).returncode == 0
    before = lab.everything["mocap/lab/3d/json"]
    wait_until(lambda: lab.everything["mocap/lab/3d/json"] > before + 10)
    assert run("take", "stop", "--source", "lab", "--connect", lab.endpoint).returncode == 0
    channels = {event.channel for event in EventLogReader(lab.takes / "lab" / "one.lcmlog").events()}
    assert "MOCAP_LAB_3D" in channels
    assert not [channel for channel in channels if "JSON" in channel]


def test_the_view_and_top_receive_messages_and_no_json(lab: Lab) -> None:
    live = LiveData()
    subscriber = subscribe_all(Transport(connect=lab.endpoint), ["lab"], None, live)
    try:
        wait_until(lambda: any(series.num_messages > 100 for series in live.all_series))
        wait_until(lambda: len(live.all_series) >= 8)
    finally:
        subscriber.close()
    assert (live.num_foreign, live.num_beyond) == (0, 0)
    assert not [series.key for series in live.all_series if series.key.endswith("json")]
    top = run("top", "--json", "--once", "--source", "lab", "--connect", lab.endpoint)
    found = json.loads(top.stdout.splitlines()[0])
    assert (found["num_foreign"], found["num_beyond"]) == (0, 0)
