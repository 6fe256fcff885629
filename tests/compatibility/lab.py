"""What programs and people see of a running gateway: keys, channels, answers, and what commands print."""

import asyncio
import contextlib
import json
import subprocess
import sys
import urllib.request
from collections.abc import AsyncIterator, Awaitable, Collection
from pathlib import Path
from typing import Any, Final, NamedTuple

import rtc3d
import zenoh

from gateway.daemon.gateway import Gateway
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.session.server.scene import Scene
from gateway.simulator.simulator import Simulator
from gateway.simulator.take_scene import TakeScene
from tests.compatibility.comparing import kinds
from tests.support.commands import run
from tests.support.configurations import load, write_config
from tests.support.gateways import monitored_gateway
from tests.support.networks import free_endpoint, free_port, lcm_url, zenoh_keys
from tests.support.queried_gateway import Reply, query_all, wait_until_cached, zenoh_peer
from tests.support.waiting import wait_until_async

SUBSCRIBER: Final = Path(__file__).with_name("subscriber_of_1_0.py")

QUERIES: Final = (
    *("parameters", "parameters?fresh=true", "parameters?stale=ok", "parameters?format=json"),
    *("parameters/general", "parameters/3d?format=xml", "parameters/6d", "parameters/analog?format=json"),
    *("parameters/force", "parameters/events", "3d", "3d?format=json", "6d", "analog", "force?format=lcm"),
    *("event", "status", "status?format=json", "3d?from=0;to=3", "6d?last_s=1", "clock?last_s=10", "history"),
    *("status?since_utime=1", "6d/Tool%201?last_s=1", "frame", "schema/markers_t", "take", "c3d"),
    *("recording", "parameters/4d", "take?set=start;name=a/b", "recording?set=stop"),
)
"""What programs may ask: all keys and options, and questions with an error for an answer."""

_KEPT: Final = {"3d", "6d", "6d/Tool 1", "analog", "force", "event", "status", "clock"}
"""The keys of which the history has messages a second after the start."""

PATIENCE_S: Final = 30.0
"""What is received takes a fifth of it."""

_TOOL_POSES: Final = {"enabled": True, "tool_poses": True}


class Lab:
    """A gateway with all that it publishes for the source lab, and the configuration ``file`` that it has."""

    def __init__(self, folder: Path, port: int) -> None:
        self.endpoint = free_endpoint()
        self.url = lcm_url()
        self.takes = folder / "takes"
        self.metrics_port = free_port()
        self.zenoh = ("--connect", self.endpoint)
        self.file = write_config(
            folder / "lab.yaml",
            port,
            source={"remote_control": True},
            zenoh=_TOOL_POSES | {"config": zenoh_keys("peer", listen=self.endpoint)},
            lcm=_TOOL_POSES | {"url": self.url},
            takes=_TOOL_POSES | {"directory": str(self.takes), "keep_last_s": 60.0},
            metrics={"port": self.metrics_port},
        )
        self.gateway = Gateway(load(self.file))

    async def json(self, *arguments: str | Path) -> Any:
        """Return what a command prints with ``--json``."""
        done = await run(*arguments, "--json")
        assert done.stdout, done.stderr
        return json.loads(done.stdout)


@contextlib.asynccontextmanager
async def running_lab(scene: Scene, folder: Path) -> AsyncIterator[Lab]:
    """Run a simulator, and a gateway that streams from it."""
    async with Simulator(scene) as simulator:
        lab = Lab(folder, simulator.port)
        async with monitored_gateway(lab.gateway) as gateway:
            await wait_until_cached(gateway)
            await wait_until_async(lambda: all(each.frames_in for each in gateway.sources[0].statuses))
            yield lab


def facts(value: Any) -> list[str]:
    """Return ``kinds`` as lines of text."""
    return [f"{place}: {' or '.join(found)}" for place, found in kinds(value).items()]


class Observed(NamedTuple):
    """What a gateway shows of a take."""

    network: dict[str, Any]
    """Keys, channels, tokens, JSON and answers, as in ``network.json``."""

    outputs: dict[str, Any]
    """What commands print, as in ``json_outputs.json``."""

    received: dict[str, dict[str, Any]]
    """What the subscriber of 1.0 decodes, by ``moment``."""


async def observe(
    take: Path, folder: Path, keys: Collection[str], channels: Collection[str], moments: Collection[str] = ()
) -> Observed:
    """Stream a take until each of ``keys``, ``channels`` and ``moments`` has been received."""
    async with running_lab(TakeScene(take), folder) as lab, asyncio.TaskGroup() as group:
        publication = group.create_task(published(lab, keys, channels))
        reception = group.create_task(received(lab, moments))
        answers = await answered(lab)
        outputs = await printed(lab)  # they count the answers
        network, decoded = await publication, await reception
        return Observed(network | {"answers": answers}, outputs, decoded)


async def published(lab: Lab, keys: Collection[str], channels: Collection[str]) -> dict[str, Any]:
    """Return the encodings of all keys on Zenoh, and the types on all channels of LCM.

    Waits until each of ``keys`` and ``channels`` has had a message, at most PATIENCE_S.
    """
    encodings: dict[str, str] = {}
    payloads: dict[str, bytes] = {}
    types: dict[str, str] = {}
    names = {
        message_type._get_packed_fingerprint(): name
        for name, message_type in vars(rtc3d).items()
        if name.endswith("_t")
    }

    def receive(sample: zenoh.Sample) -> None:
        encodings[str(sample.key_expr)] = str(sample.encoding)
        payloads[str(sample.key_expr)] = sample.payload.to_bytes()

    def receive_lcm(channel: str, data: bytes) -> None:
        types[channel] = names[data[:8]]

    receivers = [open_lcm(url) for url in (lab.url, lcm_queries_url(lab.url))]
    for receiver in receivers:
        receiver.subscribe(".*", receive_lcm)

    def is_complete() -> bool:
        for receiver in receivers:
            while receiver.handle_timeout(0):
                pass
        return set(keys) <= encodings.keys() and set(channels) <= types.keys()

    with zenoh_peer(lab.endpoint) as peer:
        peer.declare_subscriber("mocap/**", receive)
        parameters = rtc3d.parameters_request_t()
        parameters.request_id, parameters.requester = 1, "test"
        command = rtc3d.command_request_t()
        command.request_id, command.requester, command.command = 1, "test", "history"
        command.options = ["key=3d", "from=0", "to=0"]
        command.num_options = len(command.options)
        receivers[1].publish("MOCAP_LAB_PARAMETERS_REQUEST", parameters.encode())
        receivers[1].publish("MOCAP_LAB_COMMAND_REQUEST", command.encode())
        with contextlib.suppress(AssertionError):  # the test says what is missing
            await wait_until_async(is_complete, PATIENCE_S)
        tokens = await asyncio.to_thread(lambda: list(peer.liveliness().get("mocap/lab/*", timeout=10)))
    return {
        "keys": encodings,
        "channels": types,
        "tokens": sorted(str(reply.ok.key_expr) for reply in tokens if reply.ok is not None),
        "json": {key: facts(json.loads(data)) for key, data in payloads.items() if key.endswith("/json")},
    }


async def answered(lab: Lab) -> dict[str, Any]:
    """Return what the gateway answers to QUERIES, once its history has all keys."""
    [source] = lab.gateway.sources
    await wait_until_async(lambda: source.fan_out.history_overview["keys"].keys() >= _KEPT)
    answers: dict[str, Any] = {}
    with zenoh_peer(lab.endpoint) as peer:
        for selector in QUERIES:
            answers[selector] = [_answer(reply) for reply in await query_all(peer, f"mocap/lab/{selector}")]
    source.publish_status()  # with the numbers of these answers
    return answers


def _answer(reply: Reply) -> dict[str, Any]:
    if reply.error:
        return {"error": reply.code}
    content = facts(reply.json) if reply.encoding == "application/json" else []
    return {"encoding": reply.encoding, "attachment": facts(reply.attachment), "content": content}


async def printed(lab: Lab) -> dict[str, Any]:
    """Return what each command with ``--json`` prints, by the command, and the health check."""

    async def echo(*options: str) -> dict[str, Any]:
        """Return the last line of each key. Whether there are parameters depends on other subscribers."""
        done = await run("echo", "--json", *options, *lab.zenoh)
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        return {line["key"]: line for line in lines if line["key"] != "mocap/lab/parameters"}

    async def takes() -> dict[str, Any]:
        steps = {"start": ("walk",), "stop": (), "save": ("kept",), "list": ()}  # in this order
        return {
            f"take {step}": await lab.json("take", step, *rest, *lab.zenoh) for step, rest in steps.items()
        }

    def health() -> Any:
        with urllib.request.urlopen(f"http://127.0.0.1:{lab.metrics_port}/healthz", timeout=30) as page:
            return json.load(page)

    outputs: dict[str, Awaitable[Any]] = {
        # As long as the take, so that there are events.
        "echo": echo("--last", "60", "--seconds", "1.3"),
        "echo 6d/*": echo("--component", "6d/*", "--count", "1"),
        "echo --hz": lab.json("echo", "--hz", "--count", "1", "--component", "3d", *lab.zenoh),
        "list": lab.json("list", *lab.zenoh),
        "top": lab.json("top", "--once", *lab.zenoh),
        "params": lab.json("params", *lab.zenoh),
        "doctor": lab.json("doctor", "--config", lab.file, "--no-connect", "--seconds", "0.3"),
        "doctor --subscriber": lab.json("doctor", "--subscriber", "--seconds", "0.3", *lab.zenoh),
        "config check": lab.json("config", "check", lab.file),
        "/healthz": asyncio.to_thread(health),
        "take": takes(),
    }
    found: dict[str, Any] = dict(zip(outputs, await asyncio.gather(*outputs.values()), strict=True))
    takes_found: dict[str, Any] = found.pop("take")
    return found | takes_found


async def received(lab: Lab, wanted: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return what the subscriber of 1.0 decodes, by ``moment``, until it has all that is ``wanted``.

    It waits PATIENCE_S at most.
    """
    port = lab.url.partition("?")[0].rpartition(":")[2]
    found: dict[str, dict[str, Any]] = {}
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-I", SUBSCRIBER, port), stdout=subprocess.PIPE, limit=1 << 20
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(PATIENCE_S):
            while not found.keys() >= set(wanted):
                values = json.loads(await process.stdout.readline())
                found[moment(values)] = values
    except TimeoutError:
        pass  # the test says what is missing
    finally:
        process.kill()
        await process.wait()
    return found


def moment(values: dict[str, Any]) -> str:
    """Return what identifies a message of a take: its channel and the server's number of the frame."""
    return f"{values['channel']} {values.get('frame_number', '')}"
