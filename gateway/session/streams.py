"""The streams of one source: as configured, or planned from the rates that the server announces."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

from gateway.config.settings import StreamSettings
from gateway.errors import LinkError, SilenceError
from gateway.rtc3d.commands import StreamFrames
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import General, Parameters
from gateway.session.plan import Components, StreamPlan, announced_rates_hz, plan_streams
from gateway.session.rate_check import AnnouncedRates
from gateway.session.state import Phase, StreamState
from gateway.session.supervisor import Listener, Supervisor

_MAX_FURTHER_FAILURES: Final = 2
_EARLY_END_S: Final = 10.0
"""How often in a row a further connection may end this early while the first one continues."""

_MAX_FIRST_FAILURES: Final = 3
_SUSPICIOUS_S: Final = 2.0
"""How often in a row the first connection may end or fall silent this soon after a further one was opened. A
few times can be a coincidence: somebody restarts the server."""

_RETRY_S: Final = 600.0
"""For how long the gateway then uses one connection. After that, it tries again when it reconnects."""

_MAX_QUIET_CHECKS: Final = 5
_MAX_WAITING_CHECKS: Final = 15
"""For how many seconds in a row frames may arrive on some connections only, without and with other replies on
the others. Seconds are counted by calls of ``check``, so that a stop of this process does not count."""

_RUNNING: Final = (StreamState.STREAMING, StreamState.NO_MEASUREMENT)

ENDS_FIRST: Final = "the server ends the first connection when there is a second one"
NO_FRAMES: Final = "the server sends no frames on a connection for them"
NO_NAMES: Final = "the server does not accept the names of components"
"""Why all components have one connection."""

NewStream = Callable[[StreamSettings, Listener], Supervisor]
"""Creates a stream; the listener follows its connections."""


class ConfiguredStreams(Listener):
    """The streams that a configuration lists."""

    def __init__(self, settings: Sequence[StreamSettings], new_stream: NewStream) -> None:
        self._announced_hz: AnnouncedRates = {}
        self.streams: Sequence[Supervisor] = [new_stream(each, self) for each in settings]
        """The streams, in the order of the configuration."""
        self.known = self.streams
        """The same as ``streams``: they never change."""

    async def run(self) -> None:
        """Run every stream until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            for stream in self.streams:
                tasks.create_task(stream.run())

    def planning(self, _stream: Supervisor, parameters: Parameters | None) -> None:
        """Note the rates that the server announces."""
        self._announced_hz = {} if parameters is None else announced_rates_hz(parameters)

    def parameters_changed(self, parameters: Parameters) -> None:
        """Note the rates that the server announces now."""
        self._announced_hz = announced_rates_hz(parameters)

    def check(self) -> None:
        """Check the rates of the streams. Call it once a second."""
        for stream in self.streams:
            stream.check_rate(self._announced_hz, reports_sharing=True)


class _Server(NamedTuple):
    """What a server says about itself. If any of it changes, it may be another server."""

    name: str
    version: str
    rates_hz: Mapping[ComponentType, float]


class _Verdict(NamedTuple):
    """Why ``server`` gets one connection only, and since when, on the monotonic clock.

    ``is_final`` means that another try is useless, or does harm.
    """

    reason: str
    server: _Server | None
    time_s: float
    is_final: bool


class _Further:
    """A further connection, for one of the faster rates.

    ``failures`` counts how often in a row it ended early. ``waiting`` and ``quiet`` count the checks in a row
    without frames, and without any byte.
    """

    def __init__(self, stream: Supervisor) -> None:
        self.stream = stream
        self.task: asyncio.Task[None] | None = None
        self.opened_s = 0.0
        self.failures = 0
        self.waiting = 0
        self.quiet = 0
        self._bytes_in = 0

    @property
    def age_s(self) -> float:
        """How long ago it was opened."""
        return _now_s() - self.opened_s

    @property
    def is_running(self) -> bool:
        """Whether it should be connected."""
        return self.task is not None and not self.task.cancelling()

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """Connect as soon as the earlier connection is closed."""
        self.opened_s = _now_s()
        self.failures = self.waiting = self.quiet = 0
        self._bytes_in = self.stream.status.bytes_in
        self.task = tasks.create_task(self._run_after(self.task))

    def stop(self, reason: str) -> None:
        """Close the connection."""
        if self.task is not None and self.is_running:
            self.task.cancel()
            self.stream.status.enter(Phase.WAITING, "the gateway ends the connection", reason)

    async def _run_after(self, former: asyncio.Task[None] | None) -> None:
        if former is not None:
            await asyncio.wait([former])
        await self.stream.run()

    def check(self) -> None:
        """Count the checks without frames. Call it once a second while the first connection has frames."""
        status = self.stream.status
        is_waiting = status.state not in _RUNNING
        is_quiet = is_waiting and status.bytes_in == self._bytes_in
        self.waiting = self.waiting + 1 if is_waiting else 0
        self.quiet = self.quiet + 1 if is_quiet else 0
        self._bytes_in = status.bytes_in

    @property
    def is_overdue(self) -> bool:
        """Whether it has been without frames for too long."""
        return self.quiet >= _MAX_QUIET_CHECKS or self.waiting >= _MAX_WAITING_CHECKS


class AutomaticStreams(Listener):
    """``streams: auto``: a connection for each rate that the server announces.

    The first stream connects, reads the parameters, requests the slowest components (see StreamPlan), and
    then starts a stream for each faster rate. These run only while the first one has a connection. If they
    fail, or the first one fails because of them (field note 21), the first requests all components, and its
    status has a limitation that says what this costs. The gateway remembers such a server.

    A server that is restarted also ends connections. So it takes several failures in a row, or several
    seconds in which frames arrive on some connections only.
    """

    def __init__(self, stall_timeout_s: float, new_stream: NewStream) -> None:
        self._stall_timeout_s = stall_timeout_s
        self._new_stream = new_stream
        self._first = new_stream(StreamSettings(), self)
        self._further: dict[Components, _Further] = {}  # those of former plans, too: their counters continue
        self._tasks = asyncio.TaskGroup()
        self._wanted = StreamPlan()
        self._plan = StreamPlan()  # _wanted, or the same on one connection
        self._server: _Server | None = None
        self._verdict: _Verdict | None = None
        self._failures = 0  # of the first connection in a row, each soon after a further one was opened
        self._waiting = 0  # checks in a row with frames on further connections only

    @property
    def streams(self) -> Sequence[Supervisor]:
        """The streams of the present plan, the slowest first."""
        return [self._first, *(self._further[group].stream for group in self._plan.groups[1:])]

    @property
    def known(self) -> Sequence[Supervisor]:
        """The streams of this plan and of former ones, which may return."""
        return [self._first, *(further.stream for further in self._further.values())]

    async def run(self) -> None:
        """Run the streams until cancelled."""
        async with self._tasks:
            self._tasks.create_task(self._first.run())

    # What the streams report.

    def planning(self, stream: Supervisor, parameters: Parameters | None) -> None:
        """Plan for the server that the first stream has connected to."""
        if stream is self._first:
            self._plan_for(parameters)

    def connected(self, stream: Supervisor, request: StreamFrames) -> None:
        """Start the further streams after the first one; check that the server knows component names."""
        if len(self._plan.groups) > 1 and not request.components:
            self._use_one_connection(NO_NAMES, is_final=True)
        if stream is self._first:
            self._waiting = 0
            self._start_further()
        elif stream.settings.components in self._further:
            self._further[stream.settings.components].opened_s = _now_s()

    def ended(self, stream: Supervisor, error: LinkError) -> None:
        """Count failures that several connections may have caused."""
        if stream is not self._first:
            further = self._further[stream.settings.components]
            if further.is_running:
                further.failures = further.failures + 1 if further.age_s < _EARLY_END_S else 1
                if further.failures >= _MAX_FURTHER_FAILURES and self._first.session is not None:
                    reason = str(error).partition("; ")[0]
                    self._use_one_connection(f"the server accepts one connection only ({reason})")
            return
        running = [further for further in self._further.values() if further.is_running]
        silent_s = self._stall_timeout_s if isinstance(error, SilenceError) else 0.0
        if any(further.age_s - silent_s < _SUSPICIOUS_S for further in running):
            self._failures += 1
            if self._failures >= _MAX_FIRST_FAILURES:
                self._use_one_connection(ENDS_FIRST, is_final=True)
        for further in running:
            further.stop("waiting for the first connection to the server")

    # Changes of the plan.

    def parameters_changed(self, parameters: Parameters) -> None:
        """Plan again if the server announces other rates; it is still the same server."""
        if self._first.session is None or not announced_rates_hz(parameters):
            return  # a server that no longer says its rates still has them
        if self._verdict is not None:
            self._verdict = self._verdict._replace(server=_server(parameters))
        self._plan_for(parameters)
        self._start_further()

    def _plan_for(self, parameters: Parameters | None) -> None:
        self._server = None if parameters is None else _server(parameters)
        self._wanted = plan = plan_streams(parameters)
        verdict = self._verdict
        if verdict is not None and len(plan.groups) > 1:
            is_recent = verdict.is_final or _now_s() - verdict.time_s < _RETRY_S
            if is_recent and verdict.server == self._server:
                plan = plan.on_one_connection(verdict.reason)
            else:
                self._verdict = None
                self._failures = 0
        self._adopt(plan)

    def _use_one_connection(self, reason: str, *, is_final: bool = False) -> None:
        """Use one connection from now on, and remember why."""
        self._verdict = _Verdict(reason, self._server, _now_s(), is_final)
        self._adopt(self._wanted.on_one_connection(reason))

    def _adopt(self, plan: StreamPlan) -> None:
        """Stop streams that the plan lacks, and let the first one request its components."""
        former, self._plan = self._plan, plan
        for group, further in self._further.items():
            if group not in plan.groups[1:]:
                further.stop("the first connection takes over")
        for group in plan.groups[1:]:
            if group not in self._further:
                stream = self._new_stream(StreamSettings(components=group), self)
                self._further[group] = _Further(stream)
        self._first.change_components(plan.groups[0])
        self._first.status.replace_limitation(former.limitation, plan.limitation)

    def _start_further(self) -> None:
        for group in self._plan.groups[1:]:
            if not self._further[group].is_running:
                self._further[group].start(self._tasks)

    # Once a second.

    def check(self) -> None:
        """Check the rates, and use one connection if only some have frames. Call it once a second."""
        announced_hz = {} if self._server is None else self._server.rates_hz
        for stream in self.streams:
            # The limitation of the plan says which components are slow because they share a connection.
            stream.check_rate(announced_hz, reports_sharing=False)
        further = [self._further[group] for group in self._plan.groups[1:]]
        if self._first.session is None or not further:
            return
        if self._first.status.state in _RUNNING:
            self._waiting = 0
            for each in further:
                each.check()
            if any(each.is_overdue for each in further):
                self._use_one_connection(NO_FRAMES)
        elif any(each.stream.status.state is StreamState.STREAMING for each in further):
            self._waiting += 1
            if self._waiting >= _MAX_QUIET_CHECKS:
                self._use_one_connection("the server sends frames only on the second connection")
        else:
            self._waiting = 0
        if all(each.age_s > _SUSPICIOUS_S + self._stall_timeout_s for each in further):
            self._failures = 0


def _now_s() -> float:
    return asyncio.get_running_loop().time()


def _server(parameters: Parameters) -> _Server:
    general = parameters.general or General()
    return _Server(general.name, general.version, announced_rates_hz(parameters))
