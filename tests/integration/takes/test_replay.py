"""``rtc3d-gateway replay`` with real Zenoh and LCM: what subscribers get, and what the command says."""

import asyncio
import contextlib
import json
import signal
from asyncio.subprocess import DEVNULL, PIPE
from collections import defaultdict
from collections.abc import AsyncIterator, Iterable, Iterator
from pathlib import Path
from typing import Any

import lcm
import pytest
import rtc3d
import zenoh

from gateway.messages.decode import decode
from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D, Parameters6D, Tool
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.takes.files.description import SourceDescription
from gateway.tools.replay.replay import lcm_destination, require_silence
from tests.integration.commands.test_command_line import Ended, end_of, run
from tests.support.commands import run_in_process
from tests.support.errors import names
from tests.support.gateway_process import PROGRAM
from tests.support.networks import free_endpoint, lcm_url, open_zenoh
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    encode_event,
    frame,
    log_bytes,
    markers,
    parameters,
    write_take,
)
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns

XML = encode_parameters(Parameters(markers=Parameters3D(100.0, "mm", (Marker("1", "head"),))))
OTHER_XML = XML.replace(b"head", b"hand")
RECORDED = {component.key: component for component in ComponentType}


def some_messages(source: str = "lab", frames: int = 200) -> list[Message]:
    """Return all five components of a second or two, with a change of the parameters in the middle."""
    messages = [description(source), parameters(XML, source=source)]
    for number in range(frames):
        utime = START_UTIME + 5000 * number
        options: dict[str, Any] = {"utime": utime, "source": source, "version": 1 + (number >= frames // 2)}
        if number == frames // 2:
            messages.append(parameters(OTHER_XML, 2, utime=utime, source=source))
        messages += [
            markers(1, number, **options),
            frame(ComponentType.TOOLS, [(1, 0, 0, 0, 1, 2, number, 0.1)], number, **options),
            frame(ComponentType.ANALOG, [number] * 8, number, **options),
            frame(ComponentType.FORCE, [(number,) * 6], number, **options),
        ]
        if not number % 50:
            event = frame(ComponentType.EVENT, [(1, number, -1, -1, -1)], number // 50, **options)
            messages.append(event)
    return messages


def by_channel(messages: Iterable[tuple[str, bytes]], prefix: str = "REPLAY") -> dict[str, list[bytes]]:
    found: defaultdict[str, list[bytes]] = defaultdict(list)
    for channel, message in messages:
        renamed = channel.replace("MOCAP", prefix, 1)
        if renamed.startswith(prefix) and not channel.endswith("_TAKE"):
            found[renamed].append(message)
    return dict(found)


class Subscribers:
    """A Zenoh session and an LCM subscriber, and what they have received, in order.

    ``samples`` has the payloads and attachments by Zenoh key; ``options`` let ``replay`` publish to them.
    """

    def __init__(self, session: zenoh.Session, endpoint: str, url: str) -> None:
        self.session = session
        self.endpoint = endpoint
        self.url = url
        self.options = ("--connect", endpoint, "--url", url)
        self.samples: defaultdict[str, list[tuple[bytes, str]]] = defaultdict(list)
        self.messages: list[tuple[str, bytes]] = []

    def receive_sample(self, sample: zenoh.Sample) -> None:
        attachment = "" if sample.attachment is None else sample.attachment.to_string()
        self.samples[str(sample.key_expr)].append((sample.payload.to_bytes(), attachment))

    async def wait_for(self, key: str, payloads: list[bytes]) -> None:
        """Wait until a Zenoh key had exactly these: some may be on their way when ``replay`` ends."""
        await wait_until_async(lambda: [payload for payload, _ in self.samples[key]] == payloads)


@pytest.fixture
def subscribers() -> Iterator[Subscribers]:
    endpoint, url = free_endpoint(), lcm_url()
    session = open_zenoh("peer", listen=endpoint)
    found = Subscribers(session, endpoint, url)
    with contextlib.ExitStack() as stack:
        stack.callback(session.close)
        session.declare_subscriber("**", found.receive_sample)
        receive = lambda channel, message: found.messages.append((channel, message))  # noqa: E731
        stack.callback(LcmSubscriber(lcm.LCM(f"{url}&recv_buf_size=2000000"), ".*", receive).close)
        yield found


async def replay(path: Path, *options: str) -> Ended:
    return await run("replay", str(path), *options)


@contextlib.asynccontextmanager
async def running(path: Path, *options: str) -> AsyncIterator[asyncio.subprocess.Process]:
    process = await asyncio.create_subprocess_exec(
        *(*PROGRAM, "replay", str(path), *options), stdin=DEVNULL, stdout=PIPE, stderr=PIPE
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.send_signal(signal.SIGINT)
        assert (await end_of(process)).status in {0, 1}


async def test_subscribers_get_every_byte_under_its_prefix(tmp_path: Path, subscribers: Subscribers) -> None:
    messages = some_messages()
    path = write_take(tmp_path / "take.lcmlog", messages)
    ended = await replay(path, *subscribers.options, "--rate", "2")
    assert ended.status == 0, ended.stderr
    expected = by_channel(messages)
    await wait_until_async(lambda: by_channel(subscribers.messages) == expected)
    for key in RECORDED:
        await subscribers.wait_for(f"replay/lab/{key}", expected[lcm_channel("REPLAY", "lab", key)])
    assert {key.split("/")[0] for key in subscribers.samples} == {"replay"}
    parameters_seen = list(dict.fromkeys(subscribers.samples["replay/lab/parameters"]))
    assert [(xml, json.loads(attachment)["parameters_version"]) for xml, attachment in parameters_seen] == [
        (XML, 1),
        (OTHER_XML, 2),
    ]
    assert "│ 3d         │      200 │" in ended.stdout
    assert "806 messages in" in ended.stdout


async def test_the_parameters_of_a_replay_can_be_queried(tmp_path: Path, subscribers: Subscribers) -> None:
    path = write_take(tmp_path / "take.lcmlog", some_messages())
    async with running(path, *subscribers.options, "--loop", "--from", "0.6"):
        await wait_until_async(lambda: subscribers.samples["replay/lab/3d"])
        [reply] = subscribers.session.get("replay/lab/parameters")
        assert reply.ok is not None
        assert reply.ok.payload.to_bytes() == OTHER_XML
        [reply] = subscribers.session.get("replay/lab/parameters/3d?format=json")
        assert reply.ok is not None
        assert json.loads(reply.ok.payload.to_bytes())["markers"][0]["label"] == "hand"
        [reply] = subscribers.session.get("replay/lab/3d")
        assert reply.ok is not None
        assert len(decode(reply.ok.payload.to_bytes()).markers) == 1
        keys = {str(reply.ok.key_expr) for reply in subscribers.session.get("replay/*/**") if reply.ok}
        assert {"replay/lab/parameters", "replay/lab/3d", "replay/lab/schema/markers_t"} <= keys
        for key in ("recording?set=start", "c3d", "status", "parameters/6d"):
            [reply] = subscribers.session.get(f"replay/lab/{key}")
            assert reply.err is not None
        tokens = [str(reply.ok.key_expr) for reply in subscribers.session.liveliness().get("**") if reply.ok]
        assert sorted(tokens) == ["replay/lab/alive", "replay/lab/server"]
        on_lcm = ("--lcm", "--url", subscribers.url, "--prefix", "REPLAY")
        ended = await run("params", "--json", "--source", "lab", *on_lcm)
        assert json.loads(ended.stdout)["lab"]["parameters"]["3d"]["markers"][0]["label"] == "hand"


async def test_a_replay_does_not_mix_with_somebody_else(tmp_path: Path, subscribers: Subscribers) -> None:
    path = write_take(tmp_path / "take.lcmlog", some_messages())
    async with running(path, *subscribers.options, "--loop"):
        await wait_until_async(lambda: subscribers.samples["replay/lab/3d"])
        for options in (("--zenoh", "--connect", subscribers.endpoint), ("--lcm", "--url", subscribers.url)):
            ended = await replay(path, *options)
            assert ended.status == 1
            assert names(ended.stderr, "somebody else", "--prefix")
        ended = await replay(path, *subscribers.options, "--prefix", "site/two", "--to", "0.1")
        assert ended.status == 0, ended.stderr
    expected = by_channel(some_messages(), "SITE_TWO")["SITE_TWO_LAB_3D"][:21]
    await wait_until_async(
        lambda: by_channel(subscribers.messages, "SITE_TWO")["SITE_TWO_LAB_3D"] == expected
    )
    await subscribers.wait_for("site/two/lab/3d", expected)


async def test_programs_that_wait_for_a_replay_do_not_prevent_it() -> None:
    """They ask for parameters or takes on LCM, maybe on the URL of the messages; gateways show themselves."""
    url = lcm_url()
    requests = {
        "REPLAY_LAB_PARAMETERS_REQUEST": rtc3d.parameters_request_t().encode(),
        "REPLAY_LAB_COMMAND_REQUEST": rtc3d.command_request_t().encode(),
        "REPLAY_LAB_GATEWAY": rtc3d.command_request_t().encode(),
    }
    others = lcm.LCM(url)
    listening = asyncio.create_task(require_silence([lcm_destination("REPLAY", url)]))
    while not listening.done():
        for channel, message in requests.items():
            others.publish(channel, message)
        await asyncio.sleep(0.02)
    await listening


async def test_an_output_that_does_not_open_is_left_out(tmp_path: Path, subscribers: Subscribers) -> None:
    path = write_take(tmp_path / "take.lcmlog", some_messages(frames=20))
    nowhere = ("--connect", free_endpoint())
    ended, required = await asyncio.gather(
        replay(path, *nowhere, "--url", subscribers.url), replay(path, *nowhere, "--zenoh")
    )
    assert ended.status == 0
    assert names(ended.stderr, "zenoh")
    expected = by_channel(some_messages(frames=20))
    await wait_until_async(lambda: by_channel(subscribers.messages) == expected)
    assert required.status == 1
    assert "zenoh" in required.stderr
    assert required.stdout == ""


def test_what_is_left_out_of_a_bad_take_is_reported(tmp_path: Path) -> None:
    messages = some_messages(frames=20)[2:]
    log = log_bytes(messages[:30]) + b"garbage" + log_bytes(messages[30:])
    for name, content, status, *texts in (
        (
            *("bad", log + encode_event(0, START_UTIME, b"OTHER", b"x") + log[:99], 0),
            *("left out, on OTHER", "in 2 places were left out", "no parameters of lab at the beginning"),
        ),
        ("empty", b"", 1, "is empty"),
        ("foreign", b"text" * 1000, 1, "without an LCM event"),
        ("missing", None, 1, "No such file"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        ended = run_in_process("replay", tmp_path / name, "--lcm", "--url", "memq://", "--rate", "max")
        assert ended.returncode == status, ended.stderr
        assert [text for text in texts if text not in ended.stderr] == []


def test_the_replay_of_a_take_that_was_cut_off_says_so(tmp_path: Path) -> None:
    about = SourceDescription("lab", "MOCAP_LAB")
    begin = [(channel.decode(), message) for channel, message in about.beginning("walk", START_UTIME)]
    path = write_take(tmp_path / "walk.lcmlog", begin + some_messages(frames=20)[2:])
    ended = run_in_process("replay", path, "--lcm", "--url", "memq://", "--rate", "max")
    assert ended.returncode == 0, ended.stderr
    assert "INCOMPLETE" in ended.stderr


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ("--rate 0", "from 0.01 to 1000, or max"),
        ("--rate nan", "from 0.01 to 1000, or max"),
        ("--from 5 --to 5", "--to"),
        ("--zenoh --lcm", "--zenoh or --lcm"),
        ("--zenoh --url memq://", "--url is for LCM"),
        ("--component c3d", "expected"),
        ("--prefix a/long/name/of/a/prefix", "16 characters"),
    ],
)
def test_options_are_checked(tmp_path: Path, options: str, text: str) -> None:
    take = write_take(tmp_path / "take.lcmlog", some_messages())
    ended = run_in_process("replay", take, *options.split())
    assert ended.returncode == 2
    assert text in " ".join(ended.stderr.replace("│", " ").split())


async def test_a_folder_is_replayed_as_fast_as_possible(tmp_path: Path, subscribers: Subscribers) -> None:
    folder = tmp_path / "take"
    folder.mkdir()
    lab, stage = some_messages(frames=1000), some_messages("stage-2", frames=1000)
    merged = [message for pair in zip(lab, stage, strict=True) for message in pair]
    write_take(folder / "take-001.lcmlog", merged[:3000])
    write_take(folder / "take-002.lcmlog", merged[3000:])
    ended = await replay(folder, "--zenoh", "--connect", subscribers.endpoint, "--rate", "max")
    assert ended.status == 0, ended.stderr
    expected = by_channel(merged)
    for source in ("lab", "stage-2"):
        for key in RECORDED:
            payloads = expected[lcm_channel("REPLAY", source, key)]
            await subscribers.wait_for(f"replay/{source}/{key}", payloads)


def with_tools(*, late: int) -> list[Message]:
    """Return poses of two tools and events; the second tool appears after ``late`` poses of the first."""
    tools = Parameters6D(100.0, tuple(Tool(str(number), f"Tool {number}") for number in (1, 2)))
    messages = [description(), parameters(Parameters(tools=tools))]
    for number in range(2 * late):
        utime = START_UTIME + 5000 * number
        pose = rtc3d.tool_pose_t()
        pose.utime = pose.capture_utime = utime
        for tool in (1, 2)[: 1 + (number >= late)]:
            pose.sequence = number - late * (tool - 1)
            messages.append((f"MOCAP_LAB_6D_TOOL_{tool}", pose.encode()))
        messages.append(frame(ComponentType.EVENT, [(1, number, -1, -1, -1)], number, utime=utime))
    return messages


@pytest.mark.parametrize("options", [("--rate", "max"), ("--rate", "1")])
async def test_the_first_message_of_each_key_arrives(
    tmp_path: Path, subscribers: Subscribers, options: tuple[str, ...]
) -> None:
    """Each tool has a key of its own, which is declared with its first pose, also in the middle of a take.

    An event may be the only message of its key, also as JSON.
    """
    messages = with_tools(late=10)
    path = write_take(tmp_path / "take.lcmlog", messages)
    ended = await replay(path, "--zenoh", "--connect", subscribers.endpoint, *options)
    assert ended.status == 0, ended.stderr
    expected = by_channel(messages)
    for channel, key in (
        ("REPLAY_LAB_6D_TOOL_1", "replay/lab/6d/Tool%201"),
        ("REPLAY_LAB_6D_TOOL_2", "replay/lab/6d/Tool%202"),
        ("REPLAY_LAB_EVENT", "replay/lab/event"),
    ):
        assert len(expected[channel]) in {10, 20}
        await subscribers.wait_for(key, expected[channel])
    as_json = [json.loads(payload)["sequence"] for payload, _ in subscribers.samples["replay/lab/event/json"]]
    assert as_json == list(range(20))


async def test_lcm_logplayer_plays_a_take(tmp_path: Path, subscribers: Subscribers) -> None:
    """LCM's own program: it must find nothing in our files that it does not understand."""
    messages = some_messages()
    path = write_take(tmp_path / "take.lcmlog", messages)
    program = Path(lcm.__file__).parents[1] / "bin/lcm-logplayer"  # .venv/bin has a script that starts it
    player = await asyncio.create_subprocess_exec(
        *(program, f"--lcm-url={subscribers.url}", "--speed=2", path), stdout=DEVNULL, stderr=DEVNULL
    )
    assert await player.wait() == 0
    expected = by_channel(messages, "MOCAP")
    await wait_until_async(lambda: by_channel(subscribers.messages, "MOCAP") == expected)
