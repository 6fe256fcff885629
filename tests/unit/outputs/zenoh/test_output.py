import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
import zenoh

from gateway.errors import ConfigError, OutputError
from gateway.messages.topics import Topic
from gateway.outputs.contract import OutputHealth
from gateway.outputs.zenoh.config import command_config, zenoh_config
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.support.errors import names
from tests.support.networks import free_endpoint, zenoh_keys
from tests.support.waiting import wait_until
from tests.unit.outputs.zenoh.lab import Lab

MARKERS = Topic("lab", ("3d",), "rtc3d.markers_t")


def sample_of(lab: Lab, topic: Topic) -> zenoh.Sample:
    """Return what arrives of a message published under ``topic``."""
    publisher = lab.output.publisher(topic)
    wait_until(lambda: publisher.wanted)
    publisher.publish(b"message")
    wait_until(lambda: lab.samples)
    [sample] = lab.samples
    assert sample.payload.to_bytes() == b"message"
    return sample


def tokens(lab: Lab, keys: str) -> list[str]:
    replies = lab.peer.liveliness().get(keys)
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


# Keys and samples ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "type_name", "key"),
    [
        (("status",), "rtc3d.status_t", "mocap/lab/status"),
        (("6d", "a/b *?"), "rtc3d.tool_pose_t", "mocap/lab/6d/a%2Fb%20%2A%3F"),
    ],
)
def test_samples_have_the_topics_key_and_the_lcm_type_as_schema(
    lab: Lab, parts: tuple[str, ...], type_name: str, key: str
) -> None:
    lab.open()
    lab.subscribe("mocap/**")
    sample = sample_of(lab, Topic("lab", parts, type_name))
    assert str(sample.key_expr) == key
    assert str(sample.encoding) == f"application/x-lcm;{type_name}"


@pytest.mark.parametrize(
    "settings", [{"prefix": "site/hall", "express": express} for express in (False, True)]
)
def test_samples_are_dropped_rather_than_waited_for_and_express_as_configured(
    lab: Lab, settings: dict[str, Any]
) -> None:
    lab.open()
    lab.subscribe("**")
    sample = sample_of(lab, MARKERS)
    found = (sample.congestion_control, sample.express, str(sample.key_expr))
    assert found == (zenoh.CongestionControl.DROP, settings["express"], "site/hall/lab/3d")


def test_a_topic_is_wanted_while_somebody_subscribes_to_its_key(lab: Lab) -> None:
    early = lab.output.publisher(MARKERS)
    other = lab.output.publisher(Topic("lab", ("analog",), "rtc3d.analog_t"))
    assert not early.wanted
    lab.open()
    first, second = lab.subscribe("mocap/lab/3d"), lab.subscribe("mocap/*/3d")
    wait_until(lambda: early.wanted)
    late = lab.output.publisher(MARKERS)
    wait_until(lambda: late.wanted)
    assert not other.wanted
    first.undeclare()
    second.undeclare()
    wait_until(lambda: not early.wanted and not late.wanted)
    with lab.subscribe("mocap/lab/3d"):
        wait_until(lambda: early.wanted)
        early.close()
        assert not early.wanted


def test_the_keys_of_tools_are_declared_in_a_thread_that_can_be_waited_for(lab: Lab) -> None:
    """Until then, a message is refused with its key: the session is open."""
    assert lab.output.until_declared() is None
    lab.open()
    held = threading.Event()
    declarer = lab.output._declarer  # held where a slow peer would hold it
    declarer.submit(held.wait)
    publisher = lab.output.publisher(Topic("lab", ("6d", "Probe"), "rtc3d.tool_pose_t"))
    with pytest.raises(OutputError) as caught:
        publisher.publish(b"message")
    assert caught.value.cause == "not declared"
    assert "mocap/lab/6d/Probe" in str(caught.value)
    declared = lab.output.until_declared()
    assert declared is not None
    assert not declared.done()
    held.set()
    declared.result()
    publisher.publish(b"message")


def test_a_message_for_a_closed_publisher_is_refused_with_its_key(lab: Lab) -> None:
    publisher = lab.output.publisher(MARKERS)
    publisher.close()
    with pytest.raises(OutputError) as caught:
        publisher.publish(b"message")
    text = "Zenoh key mocap/lab/3d is closed; ask for a new publisher"
    assert (str(caught.value), caught.value.cause) == (text, "closed")


def test_a_message_that_zenoh_refuses_is_an_error_with_its_key_and_reason(lab: Lab) -> None:
    publisher = lab.output.publisher(MARKERS)
    lab.open()
    assert lab.output.session is not None
    lab.output.session.close()
    with pytest.raises(OutputError) as caught:
        publisher.publish(b"message")
    text = "Zenoh did not take a message for mocap/lab/3d: "
    assert str(caught.value).startswith(text)
    assert str(caught.value) != text
    assert caught.value.cause == "put failed"


# Liveliness ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["alive", "server"])
def test_tokens_show_sources_and_their_servers_until_the_output_closes(lab: Lab, name: str) -> None:
    """A source is alive from announcement to withdrawal, its server while its frames flow."""

    def show(source: str, is_shown: bool = True) -> None:
        for _ in range(2):
            if name == "server":
                lab.output.show_streaming(source, is_shown)
            else:
                (lab.output.announce if is_shown else lab.output.withdraw)(source)

    def wait_for(*sources: str) -> None:
        expected = [f"mocap/{source}/{name}" for source in sources]
        wait_until(lambda: tokens(lab, f"mocap/*/{name}") == expected)

    show("early")
    show("early", False)
    show("lab")
    lab.open()
    wait_for("lab")
    show("hall-2")
    wait_for("hall-2", "lab")
    show("lab", False)
    wait_for("hall-2")
    show("lab")
    wait_for("hall-2", "lab")
    lab.output.close()
    wait_for()


# Opening -------------------------------------------------------------------------------------


def test_a_process_ends_although_the_router_never_answers() -> None:
    # Zenoh's open() then blocks for ever, whatever happens to the process.
    keys = zenoh_keys("client", connect=free_endpoint())
    keys["connect"]["timeout_ms"] = -1
    program = f"""
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.outputs.zenoh.output import ZenohOutput
output = ZenohOutput(ZenohSettings(config={keys!r}))
output.start()
print(output.health().problem)
output.close()
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert names(done.stdout, "zenoh.config's")


def test_health_says_how_to_open_a_session_before_and_after(lab: Lab) -> None:
    before = lab.output.health()
    assert not before.connected
    assert names(before.problem, "zenoh.config's")
    lab.open()
    assert lab.output.health() == OutputHealth(True, "")
    lab.output.close()
    after = lab.output.health()
    assert (after.connected, after.problem not in {"", before.problem}) == (False, True)


# Configuration -------------------------------------------------------------------------------


def value_of(config: zenoh.Config, path: str) -> Any:
    return json.loads(config.get_json(path))


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        ({"mod": "client"}, "`mod`"),
        ({"mode": "clinet"}, "`clinet`"),
        ({"listen": {"endpoints": 5}}, "expected list of endpoints"),
        ({"connect": {"endpoints": ["foo"]}}, "Endpoints must be of the form <protocol>/<address>"),
        ({"transport": {"shared_memory": {"enable": True}}}, "unknown field `enable`"),
        ("{ mod: 'client' }", "unknown field `mod`"),
        ("{ mode: ", "expected"),
        (None, "No such file"),
    ],
)
def test_what_zenoh_refuses_is_a_config_error_with_its_reason(
    tmp_path: Path, config: dict[str, Any] | str | None, reason: str
) -> None:
    """A text is the content of a configuration file, None one that does not exist."""
    path = tmp_path / "zenoh.json5"
    if isinstance(config, str):
        path.write_text(config, encoding="utf-8")
    is_inline = isinstance(config, dict)
    with pytest.raises(ConfigError) as caught:
        ZenohOutput(ZenohSettings.model_construct(config=config if is_inline else path))
    text = str(caught.value)
    where = "the inline zenoh.config" if is_inline else f"the file {path}"
    assert names(text, where)
    assert reason in text
    assert ".rs:" not in text
    assert len(text.splitlines()) == 1


def test_a_json5_file_passes_whole_and_as_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(
        "// JSON5\n{ mode: 'peer', id: 'a1b2c3', transport: { link: { tx: { lease: 2000, }, }, }, }"
    )
    config = zenoh_config(path)
    assert (value_of(config, "id"), value_of(config, "transport/link/tx/lease")) == ("a1b2c3", 2000)
    # What the gateway prefers goes to inline configurations only.
    assert value_of(config, "connect/retry") == value_of(zenoh.Config.from_file(str(path)), "connect/retry")


def test_a_changed_json5_file_is_another_configuration(tmp_path: Path) -> None:
    """A reload must open another session for it, although its path is the same."""
    path = tmp_path / "zenoh.json5"
    outputs = []
    for lease in (2000, 2000, 3000):
        path.write_text(f"{{ transport: {{ link: {{ tx: {{ lease: {lease} }} }} }} }}")
        outputs.append(ZenohOutput(ZenohSettings(config=path)))
    assert [outputs[0].is_configured_like(other) for other in outputs] == [True, True, False]


@pytest.mark.parametrize("shared_memory", [{}, {"shared_memory": {"enabled": True}}])
def test_inline_keys_pass_whole_over_what_the_gateway_prefers(shared_memory: dict[str, Any]) -> None:
    retry = {"period_max_ms": 9000}
    link = {"tx": {"lease": 2000}}
    given = {"id": "a1b2c3", "connect": {"retry": retry}, "transport": {"link": link} | shared_memory}
    config = zenoh_config(given)
    assert (value_of(config, "id"), value_of(config, "transport/link/tx/lease")) == ("a1b2c3", 2000)
    used = value_of(config, "connect/retry")
    assert (used["period_max_ms"], used["period_init_ms"]) == (9000, 200)
    assert value_of(config, "transport/shared_memory/enabled") is bool(shared_memory)


def test_a_command_runs_although_the_gateway_cannot_be_reached() -> None:
    config = command_config({"mode": "peer", "connect": {"exit_on_failure": True}})
    assert value_of(config, "connect/exit_on_failure") is False


def test_a_configured_id_is_replaced_by_another_valid_one_for_commands() -> None:
    given = {"mode": "peer", "id": "abc1"}
    ids = {json.loads(command_config(given).get_json("id")) for _ in range(100)}  # raises if one is invalid
    assert len(ids) == 100
    assert "abc1" not in ids
