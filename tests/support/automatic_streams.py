"""``streams: auto`` without connections: tests decide what each connection does, and when."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Any, cast

from gateway.config.settings import StreamSettings
from gateway.errors import ClosedError, SilenceError
from gateway.rtc3d.client_protocol import ProtocolState
from gateway.rtc3d.commands import AllFrames, StreamFrames
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    General,
    Marker,
    Parameters,
    Parameters3D,
    ParametersAnalog,
    ParametersForce,
    Plate,
)
from gateway.session.state import Phase, StreamState
from gateway.session.status import StreamStatus
from gateway.session.streams import AutomaticStreams
from gateway.session.supervisor import Listener, Supervisor

STALL_TIMEOUT_S = 3.0


class ScriptedStream:
    """A stream without a connection: what AutomaticStreams uses of a Supervisor, and its states."""

    def __init__(self, settings: StreamSettings, listener: Listener) -> None:
        self.settings = settings
        self.listener = listener
        self.status = StreamStatus("", name="lab")
        self.session: object | None = None
        self.is_running = False

    async def run(self) -> None:
        """Run until cancelled, like Supervisor.run."""
        self.is_running = True
        try:
            await asyncio.Event().wait()
        finally:
            self.is_running = False
            self.session = None

    def change_components(self, components: tuple[ComponentType, ...]) -> None:
        """See Supervisor."""
        self.settings = self.settings.model_copy(update={"components": components})

    def check_rate(self, *_args: object, **_options: object) -> None:
        """See Supervisor."""


class ManualLoop(asyncio.SelectorEventLoop):
    """An event loop whose clock only the tests advance. Nothing may wait for a timer."""

    now_s = 1000.0

    def time(self) -> float:
        """Return the time that the test has set."""
        return self.now_s


class StreamsLab:
    """The streams of a source, on a clock that only ``second`` and tests advance."""

    def __init__(self) -> None:
        self.loop = ManualLoop()
        self.streams: AutomaticStreams = self._in_loop(
            lambda: AutomaticStreams(STALL_TIMEOUT_S, cast("Any", self._new_stream))
        )
        self._task = self.loop.create_task(self.streams.run())
        self.settle()

    def _new_stream(self, settings: StreamSettings, listener: Listener) -> ScriptedStream:
        return ScriptedStream(settings, listener)

    def _in_loop(self, call: Callable[[], Any]) -> Any:
        async def run() -> Any:
            return call()

        return self.loop.run_until_complete(run())

    def settle(self) -> None:
        """Let everything happen that does not wait for a time."""
        for _ in range(8):
            self.loop.run_until_complete(asyncio.sleep(0))

    def close(self) -> None:
        """End the streams and the loop."""
        self._task.cancel()
        self.loop.run_until_complete(asyncio.wait([self._task]))
        self.loop.close()

    @property
    def connections(self) -> list[ScriptedStream]:
        """The streams of the present plan."""
        return [cast("ScriptedStream", stream) for stream in self.streams.streams]

    def call(self, call: Callable[[], object]) -> None:
        """Call something in the loop, and let everything happen that follows from it."""
        self._in_loop(call)
        self.settle()

    # What the server does.

    def connect(self, stream: ScriptedStream, parameters: Parameters, *, names: bool = True) -> None:
        """Connect a stream: its handshake succeeds, and no frame has arrived."""

        def connect() -> None:
            stream.listener.planning(cast("Supervisor", stream), parameters)
            stream.session = object()
            stream.status.enter(Phase.READY, "connected", "lab")
            components = stream.settings.components if names else ()
            stream.listener.connected(cast("Supervisor", stream), StreamFrames(AllFrames(), components))

        self.call(connect)

    def show(self, stream: ScriptedStream, state: StreamState, num_bytes: int = 0) -> None:
        """Let a connected stream have this state, and receive bytes."""
        protocol = {
            StreamState.STREAMING: ProtocolState.STREAMING,
            StreamState.NO_MEASUREMENT: ProtocolState.NO_MEASUREMENT,
        }.get(state, ProtocolState.IDLE)
        self.call(lambda: stream.status.protocol_changed(protocol, "big", "lab"))
        stream.status.bytes_in += num_bytes

    def end(self, stream: ScriptedStream, *, is_silent: bool = False) -> None:
        """End the connection of a stream."""

        def end() -> None:
            error = SilenceError("silent") if is_silent else ClosedError("closed")
            stream.session = None
            stream.status.enter(Phase.WAITING, "ended", "lab")
            stream.listener.ended(cast("Supervisor", stream), error)

        self.call(end)

    def second(self, seconds: float = 1.0) -> None:
        """Let a second pass, and check the streams."""
        self.loop.now_s += seconds
        self.call(self.streams.check)


def announcing(rates_hz: Mapping[str, float], version: str = "1") -> Parameters:
    """Return parameters of a server of this version, with the rates of some of 3d, analog and force."""
    return Parameters(
        general=General(name="NDI", version=version),
        markers=Parameters3D(rates_hz["3d"], markers=(Marker("1"),)) if "3d" in rates_hz else None,
        analog=ParametersAnalog((AnalogChannel("1", frequency_hz=rates_hz["analog"]),))
        if "analog" in rates_hz
        else None,
        force=ParametersForce((Plate("1", frequency_hz=rates_hz["force"]),)) if "force" in rates_hz else None,
    )
