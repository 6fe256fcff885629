"""``streams: auto``: a connection for each rate, and one connection where the server serves no more."""

import asyncio
import logging
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from gateway.config.settings import StreamSettings
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, decode_text
from gateway.rtc3d_server.connection_filter import ConnectionFilter, FilteredConnection
from gateway.rtc3d_server.server import RtServer
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.memory_gateway import MemoryGateway, run_gateway
from tests.waiting import wait_until_async

ONE_CONNECTION = "analog and force arrive at 200 Hz instead of 2000 Hz: "
EVERYTHING = "3d 6d analog force event"


def lab_scene(rate_hz: float = 200, analog_rate_hz: float = 2000) -> SyntheticScene:
    return SyntheticScene(
        markers=3, tools=1, analog=2, plates=1, rate_hz=rate_hz, analog_rate_hz=analog_rate_hz
    )


class _Filter(ConnectionFilter):
    """Lets the server handle what its clients do while there is another client."""

    def __init__(self, connection: FilteredConnection, server: "OneClientServer") -> None:
        super().__init__(connection)
        self._server = server

    def receive(self, data: bytes) -> None:
        is_second = any(other.number < self.connection.number for other in self._server.connections)
        if is_second and self._server.on_second == "close":
            self.connection.transport.close()
        elif not is_second or self._server.on_second != "ignore":
            super().receive(data)

    def answer(self, packet: Packet) -> list[bytes]:
        text = decode_text(packet.body)
        self._server.commands.append((self.connection.number, text))
        replies = super().answer(packet)
        if text.startswith("StreamFrames") and self._server.num_clients > 1:
            if self._server.on_second == "close_first":
                self._server.close_others(self.connection)
            elif self._server.on_second == "crash":
                self._server.crash_and_restart()
        return replies


class OneClientServer(RtServer):
    """A server with field note 21.

    ``on_second`` says what happens to a second client: "serve", "refuse", "close" or "ignore" it; or when it
    requests frames: "close_first", "crash".
    """

    def __init__(self, on_second: str, scene: SyntheticScene | None = None, **keys: Any) -> None:
        super().__init__(scene or lab_scene(), new_filter=lambda each: _Filter(each, self), **keys)
        self.on_second = on_second
        self.commands: list[tuple[int, str]] = []
        self.num_opened = self.num_crashes = 0

    @property
    def num_clients(self) -> int:
        return len(self.connections)

    def connection_opened(self, connection: Any) -> int:
        self.num_opened += 1
        if self.on_second == "refuse" and self._server is not None:
            self._server.close()
            self._server = None
        return super().connection_opened(connection)

    @property
    def is_listening(self) -> bool:
        return self.on_second == "refuse" or super().is_listening

    def close_others(self, connection: FilteredConnection) -> None:
        for other in list(self.connections):
            if other.number != connection.number:
                other.transport.abort()

    def crash_and_restart(self) -> None:
        self.num_crashes += 1
        self.crash()
        asyncio.get_running_loop().call_later(0.1, lambda: asyncio.ensure_future(self.start()))


def components(lab: MemoryGateway) -> list[str]:
    return [status.components for status in lab.source.statuses]


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.message for record in caplog.records if record.levelno == logging.WARNING]


def steps(messages: list[Any]) -> set[int]:
    return {after.frame_number - before.frame_number for before, after in pairwise(messages)}


async def test_every_component_arrives_at_its_own_rate() -> None:
    async with OneClientServer("serve") as server, run_gateway(server.port) as lab:
        analog = await lab.wait_for("analog", 1000)
        markers = await lab.wait_for("3d", 50)
        await lab.wait_for("event")
        assert components(lab) == ["3d 6d event", "analog force"]
        assert (steps(markers), steps(analog), steps(lab.messages("force"))) == ({1}, {1}, {1})
        assert [message.sequence for message in analog] == list(range(len(analog)))
        assert [status.limitations for status in lab.source.statuses] == [[], []]
        assert [command for _, command in server.commands if command.startswith("StreamFrames")] == [
            "StreamFrames AllFrames 3D 6D Events",
            "StreamFrames AllFrames Analog Force",
        ]
        assert ({each.session for each in markers}, {each.session for each in analog}) == ({1}, {2})
        assert server.num_opened == 2


async def test_components_of_one_rate_share_a_connection() -> None:
    async with OneClientServer("serve", lab_scene(200, 200)) as server, run_gateway(server.port) as lab:
        await lab.wait_for("analog", 50)
        await lab.wait_for("3d", 50)
        assert components(lab) == [EVERYTHING]
        assert (server.num_opened, lab.status.limitations) == (1, [])


@pytest.mark.parametrize(
    ("on_second", "reason"),
    [
        ("refuse", "the server accepts one connection only (connection refused by 127.0.0.1:"),
        ("close", "the server accepts one connection only (the connection to 127.0.0.1:"),
        ("ignore", "the server accepts one connection only (127.0.0.1:"),
        ("close_first", "the server ends the first connection when there is a second one"),
        ("crash", "the server ends the first connection when there is a second one"),
    ],
)
async def test_a_server_for_one_client_sends_everything_on_one_connection(
    on_second: str, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with OneClientServer(on_second) as server, run_gateway(server.port) as lab:
        await lab.wait_until(lambda: components(lab) == [EVERYTHING] and lab.status.limitations)
        [limitation] = lab.status.limitations
        assert limitation.startswith(ONE_CONNECTION + reason)
        assert [text for text in warnings(caplog) if "instead of 2000 Hz" in text] == [
            f"lab ({EVERYTHING}): {limitation}"
        ]
        await lab.wait_until(lambda: lab.status.state is StreamState.STREAMING and lab.status.limitations)
        assert lab.status.limitations == [limitation]
        opened = server.num_opened
        before = {component: len(lab.messages(component)) for component in ("3d", "6d", "analog", "force")}
        for component, count in before.items():
            messages = (await lab.wait_for(component, count + 100))[count:]
            assert steps(messages[20:]) == ({10} if component in ("analog", "force") else {1})
        for component in before:
            messages = lab.messages(component)
            assert [each.sequence for each in messages] == list(range(len(messages)))
            assert all(after.session >= before.session for before, after in pairwise(messages))
        await asyncio.sleep(1)  # longer than any delay before a reconnection
        assert (server.num_opened, server.num_clients) == (opened, 1)


@pytest.mark.parametrize("on_second", ["refuse", "close", "ignore"])
async def test_the_first_connection_keeps_streaming(on_second: str) -> None:
    async with OneClientServer(on_second) as server, run_gateway(server.port) as lab:
        await lab.wait_until(lambda: lab.status.limitations)
        markers = await lab.wait_for("3d", len(lab.messages("3d")) + 50)
        assert steps(markers) == {1}
        assert [number for number, command in server.commands if command.startswith("StreamFrames")] == [1, 1]


async def test_a_server_for_one_client_is_remembered() -> None:
    async with OneClientServer("close_first") as server, run_gateway(server.port) as lab:
        await lab.wait_until(lambda: components(lab) == [EVERYTHING] and lab.status.limitations)
        await lab.wait_for("analog", len(lab.messages("analog")) + 10)
        opened = server.num_opened
        server.crash()
        await server.start()
        await lab.wait_until(lambda: server.num_opened > opened)
        await lab.wait_for("analog", len(lab.messages("analog")) + 10)
        assert components(lab) == [EVERYTHING]
        assert lab.status.limitations
        assert (server.num_opened, server.num_clients) == (opened + 1, 1)


async def test_another_server_on_the_same_port_gets_another_try() -> None:
    async with OneClientServer("close_first") as server, run_gateway(server.port) as lab:
        await lab.wait_until(lambda: components(lab) == [EVERYTHING] and lab.status.limitations)
        server.crash()
        server.on_second, server.name = "serve", "Another server"
        await server.start()
        await lab.wait_until(lambda: components(lab) == ["3d 6d event", "analog force"])
        count = len(lab.messages("analog"))
        analog = (await lab.wait_for("analog", count + 500))[count + 20 :]
        assert steps(analog) == {1}
        assert lab.status.limitations == []


async def test_a_server_that_is_restarted_gets_two_connections_again() -> None:
    async with OneClientServer("serve") as server, run_gateway(server.port) as lab:
        for _ in range(2):
            count = len(lab.messages("analog"))
            await lab.wait_for("analog", count + 100)
            await lab.wait_until(
                lambda: all(each.state is StreamState.STREAMING for each in lab.source.statuses)
            )
            assert components(lab) == ["3d 6d event", "analog force"]
            server.crash()
            await server.start()
        analog = await lab.wait_for("analog", len(lab.messages("analog")) + 100)
        assert [each.sequence for each in analog] == list(range(len(analog)))
        assert components(lab) == ["3d 6d event", "analog force"]


class _Nameless(_Filter):
    def answer(self, packet: Packet) -> list[bytes]:
        text = decode_text(packet.body)
        if text.startswith("StreamFrames") and text.rstrip("\0\n").endswith(("3D", "6D", "Events", "Force")):
            return [b"\0\0\0\x0e\0\0\0\0Error-"]
        return super().answer(packet)


async def test_a_server_that_knows_no_component_names_sends_everything_on_one_connection() -> None:
    server = OneClientServer("serve")
    server._new_filter = lambda each: _Nameless(each, server)
    async with server, run_gateway(server.port) as lab:
        analog = await lab.wait_for("analog", 100)
        assert steps(analog) == {10}
        assert components(lab) == [EVERYTHING]
        assert f"{ONE_CONNECTION}the server does not accept the names of components" in lab.status.limitations
        assert server.num_opened == 1


def without_rates(scene: SyntheticScene) -> SyntheticScene:
    parameters = scene.parameters
    assert parameters.analog is not None
    channels = tuple(replace(each, frequency_hz=None) for each in parameters.analog.channels)
    scene.parameters = replace(parameters, analog=replace(parameters.analog, channels=channels), force=None)
    return scene


async def test_components_without_an_announced_rate_stay_on_the_first_connection() -> None:
    scene = without_rates(lab_scene())
    async with OneClientServer("serve", scene) as server, run_gateway(server.port) as lab:
        assert steps(await lab.wait_for("analog", 100)) == {10}
        assert components(lab) == [EVERYTHING]
        assert lab.status.limitations == [
            "the server does not announce the rates of analog, so they share one connection, on which all "
            "components arrive at the rate of the slowest"
        ]


@pytest.mark.parametrize(("rates", "expected"), [((100, 100), [EVERYTHING]), ((500, 100), ["x"])])
async def test_other_rates_at_a_new_connection_are_planned_anew(
    rates: tuple[float, float], expected: list[str]
) -> None:
    expected = ["analog force event", "3d 6d"] if expected == ["x"] else expected
    async with OneClientServer("serve") as server, run_gateway(server.port) as lab:
        await lab.wait_until(lambda: components(lab) == ["3d 6d event", "analog force"])
        await lab.wait_for("analog", 10)
        server.crash()
        server.change_scene(lab_scene(*rates))
        await server.start()
        await lab.wait_until(lambda: components(lab) == expected)
        for component in ("3d", "analog"):
            count = len(lab.messages(component))
            messages = (await lab.wait_for(component, count + 60))[count + 10 :]
            assert steps(messages) == {1}
            everything = lab.messages(component)
            assert [each.sequence for each in everything] == list(range(len(everything)))
            assert all(after.session >= before.session for before, after in pairwise(everything))


async def test_other_rates_during_a_connection_are_planned_anew() -> None:
    async with (
        OneClientServer("serve", lab_scene(200, 200)) as server,
        run_gateway(server.port, parameters_interval_s=0.5) as lab,
    ):
        await lab.wait_for("analog", 50)
        server.change_scene(lab_scene())
        await lab.wait_until(lambda: components(lab) == ["3d 6d event", "analog force"])
        count = len(lab.messages("analog"))
        analog = (await lab.wait_for("analog", count + 300))[count + 50 :]
        assert steps(analog) == {1}
        server.change_scene(lab_scene(200, 200))
        await lab.wait_until(lambda: components(lab) == [EVERYTHING] and server.num_clients == 1)
        count = len(lab.messages("analog"))
        await lab.wait_for("analog", count + 50)
        for component in ("3d", "analog"):
            messages = lab.messages(component)
            assert [each.sequence for each in messages] == list(range(len(messages)))
            assert all(after.session >= before.session for before, after in pairwise(messages))


async def test_configured_streams_are_not_planned() -> None:
    stream = StreamSettings(components=(ComponentType.MARKERS, ComponentType.ANALOG))
    async with OneClientServer("serve") as server, run_gateway(server.port, streams=(stream,)) as lab:
        assert steps(await lab.wait_for("analog", 50)) == {10}
        assert components(lab) == ["3d analog"]
        assert server.num_opened == 1


async def test_rates_that_differ_from_the_announced_ones_are_reported() -> None:
    """The server announces 200 and 2000 Hz, but measures 3D at 100 Hz and analog at 4000 Hz."""
    scene = lab_scene(100, 4000)
    scene.parameters = lab_scene().parameters
    async with OneClientServer("serve", scene) as server, run_gateway(server.port) as lab:
        await wait_until_async(
            lambda: all(status.limitations for status in lab.source.statuses), timeout_s=30
        )
        [slow], [fast] = (status.limitations for status in lab.source.statuses)
        assert slow.startswith("frames arrive at 100 Hz instead of the announced 200 Hz")
        assert fast.startswith("frames arrive at 4000 Hz instead of the announced 2000 Hz")
