"""Live data for programs in Python: ``live`` gives frames as they arrive."""

import asyncio
import contextlib
import logging
import math
import threading
import time
import warnings
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Final, Self

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.client.live_arguments import check_arguments
from gateway.client.live_frames import Frame, LiveReception, decode_frames
from gateway.client.live_join import Join
from gateway.client.queued_reception import QueuedMessage, QueuedSeries
from gateway.client.transport import GatewaySubscriber, close_in_time, silence_text
from gateway.messages.encode import VERSION_OFFSET
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.program_end import Process, close_at_end
from gateway.runtime.safe_text import safe_text
from gateway.takes.files.reader import MessageBatch
from gateway.takes.files.take import Take, TakeLoader, check_components

DESCRIBED_WITHIN_S: Final = 2.0
"""How long frames wait for the parameters that describe them."""

_TICK_S: Final = 0.1
_SILENCE_S: Final = 3.0
"""How long nothing is heard before this is logged."""

_CLOSE_S: Final = 0.5

_COLLECT_S: Final = 0.05
"""How often ``collect`` takes what has arrived."""

_MIN_STEP_S: Final = 0.005
"""How long after one decoding the next one begins, if much arrives: waking up costs more than decoding."""

_MANY: Final = 3
"""Much arrives if as many messages as this were decoded together; fewer are decoded when they arrive."""

_MAX_WAIT_S: Final = 0.5
"""Python does not see a Ctrl-C that comes just before it begins to wait until it has waited."""

_BATCH: Final = 256
"""How many messages are decoded at once: of those that still wait, the oldest can be left out."""

_VERSION: Final = slice(VERSION_OFFSET, VERSION_OFFSET + 4)

logger = logging.getLogger(__name__)


def live(  # noqa: PLR0913 - each is an option of its own, by name
    *sources: str,
    components: Collection[str] | str | None = None,
    join: bool = False,
    complete: bool = False,
    last_s: float | None = None,
    connect: str | None = None,
    zenoh_config: PathLike[str] | str | None = None,
    lcm: bool = False,
    url: str | None = None,
    prefix: str | None = None,
) -> "Live":
    """Receive frames from gateways as they arrive.

    ::

        from gateway.client import live

        for frame in live("lab", components=["3d"]):
            print(frame.markers["head"], frame.capture_time)

    ``sources`` (names; none: all) and ``components`` (of 3d, 6d, analog, force, event, or one of them; None:
    all) say what is received. Without ``join``, each message is a frame. With it, each frame of the first
    component has everything that the other components, and other sources, have had since the frame before.
    With ``complete``, what was lost on the way comes from the gateway's history, in its order; ``last_s``
    seconds from before the first message come first.

    Gateways on Zenoh are found by multicast, or at an endpoint (``connect``), such as tcp/192.0.2.5:7447, or
    as a configuration file of Zenoh says. With ``lcm`` or ``url``, they are received on LCM. ``prefix`` is
    what keys or channels begin with, if it is not the default. Raises SelectionError if there is no such
    component, or if something cannot be the name of a source, a number of seconds, or a prefix.
    """
    is_lcm = lcm or url is not None
    check_arguments(sources, last_s, prefix, is_lcm=is_lcm)
    components = [components] if isinstance(components, str) else components
    check_components(components or ())
    config = None if zenoh_config is None else Path(zenoh_config)
    address = GatewayAddress(is_lcm, connect, config, url, prefix)
    return Live(address, sources, components, join=join, complete=complete, last_s=last_s)


class Live:
    """Frames that arrive: iterate (``for`` or ``async for``), or use ``on_frame``, ``latest`` or ``collect``.

    It connects when it is first used, and waits for sources that are not there yet. Opening raises
    QueryError if Zenoh does not open, OutputError if LCM does not. ``with`` closes it at the end of the
    block; otherwise, it is closed when nothing refers to it.

    Frames wait from the first iteration, ``on_frame`` or ``collect`` on, which all take from the same ones;
    with ``last_s``, from the beginning on. If too many wait, the oldest are left out: ``num_dropped`` and the
    ``gap`` of the next frame count them, and there is a RuntimeWarning, once.
    """

    def __init__(
        self,
        address: GatewayAddress,
        sources: Sequence[str] = (),
        components: Collection[str] | None = None,
        *,
        join: bool = False,
        complete: bool = False,
        last_s: float | None = None,
    ) -> None:
        self.client = GatewayClient(address)
        """Asks the same gateways, starts, stops and saves takes: ``live.client.start_take("walk")``."""
        self._wanted = (tuple(sources), tuple(components or COMPONENTS_BY_KEY))
        self._completeness = complete or last_s is not None, last_s
        # The past can come before the program iterates: it would be lost.
        self._reception = LiveReception(is_queueing=last_s is not None)
        self._connection: _Connection | None = None
        self._is_closed = False
        self._is_slow = False
        self._taking = threading.RLock()  # of what waits here
        self._pending: list[QueuedMessage] = []
        self._pending_s = 0.0
        self._given_up: set[tuple[object, bytes]] = set()
        self._ready: deque[Frame] = deque()
        self._decoded_s = 0.0
        self._num_decoded = 0  # the last time, together
        self._join = Join(sources, components) if join else None

    # Opening and closing.

    def open(self) -> Self:
        """Connect now, and not when it is first used."""
        self._check_process()
        with self._taking:
            if self._connection is None and not self._is_closed:
                complete, last_s = self._completeness
                subscriber = self.client.subscribe(
                    *self._wanted, self._reception, complete=complete, last_s=last_s
                )
                self._connection = _Connection(subscriber, self._reception)
                weakref.finalize(self, self._connection.close)
                close_at_end(self)
        return self

    def _check_process(self) -> None:
        """Raise ForkError if this is a fork of the process that has opened it: nothing would arrive."""
        if self._connection is not None:
            self._connection.process.check("live()")

    def close(self) -> None:
        """Disconnect. Iterations end."""
        self._is_closed = True
        if self._connection is not None and self._connection.process.is_forked:
            return  # a thread of the parent may have held any lock at the fork
        self._reception.close()
        if self._connection is not None:
            self._connection.close()
        self.client.close()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    async def __aenter__(self) -> Self:
        return await asyncio.to_thread(self.open)

    async def __aexit__(self, *_: object) -> None:
        await asyncio.to_thread(self.close)

    # What is received.

    @property
    def num_dropped(self) -> int:
        """How many messages were left out, because the program was too slow for them."""
        return self._reception.num_dropped + (self._join.num_dropped if self._join else 0)

    @property
    def sources(self) -> list[str]:
        """The names of the sources so far."""
        return sorted(source.name for source in self._reception.sources_now)

    def parameters(self, source: str | None = None) -> Parameters:
        """Return the newest parameters of a source (None: of the first); without sections if unknown."""
        with self._taking:
            for each in self._reception.sources_now:
                if source in {None, each.name}:
                    each.update_parameters()
                    if each.newest_entry is not None:
                        return each.newest_entry.parameters
        return Parameters()

    def latest(
        self, component: str | None = None, *, source: str | None = None, max_age_s: float = math.inf
    ) -> Frame | None:
        """Return the newest frame of a component (None: of any) and a source (None: of any).

        Returns None before the first, and if it is older than ``max_age_s``, counted from its capture.
        Nothing waits for it, so it also serves programs that are slower than the data. Its ``gap`` counts
        only what was lost directly before it. Raises SelectionError if there is no such component.
        """
        check_components(() if component is None else (component,))
        self.open()
        arrivals = [
            series.newest
            for series in self._reception.all_series
            if series.newest is not None
            and component in {None, series.key}
            and source in {None, series.source.name}
        ]
        if not arrivals:
            return None
        newest = max(arrivals, key=lambda arrival: arrival.steady_us)  # a clock that nobody sets
        with self._taking:
            self._update_sources()
            frame = next(decode_frames([newest], self._reception.start_utime), None)
        return frame if frame is not None and frame.age_s <= max_age_s else None

    def __iter__(self) -> Iterator[Frame]:
        self._start_queueing()
        while not self._is_closed:
            self._check_process()  # what waits here came for the parent
            if self._ready:
                with contextlib.suppress(IndexError):  # another thread was faster
                    yield self._ready.popleft()
                continue
            if (early_s := self._early_s()) > 0:
                time.sleep(early_s)
            num_seen = self._reception.num_changes
            wait_s = self._decode()
            if not self._ready:
                self._reception.wait(num_seen, wait_s)

    async def __aiter__(self) -> AsyncIterator[Frame]:
        await asyncio.to_thread(self._start_queueing)
        loop = asyncio.get_running_loop()
        while not self._is_closed:
            self._check_process()  # what waits here came for the parent
            if self._ready:
                with contextlib.suppress(IndexError):  # another thread was faster
                    yield self._ready.popleft()
                continue
            if (early_s := self._early_s()) > 0:
                await asyncio.sleep(early_s)
            num_seen = self._reception.num_changes
            wait_s = self._decode()
            if self._ready:
                continue
            changed = asyncio.Event()
            self._reception.call_at_change(num_seen, lambda: loop.call_soon_threadsafe(changed.set))  # noqa: B023 - used before the next one
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await changed.wait()

    def on_frame(self, function: Callable[[Frame], object]) -> Self:
        """Call a function with each frame, in a thread of its own, until ``close``.

        An exception of the function is shown as that of any thread, and ends the calls.
        """

        def call() -> None:
            for frame in self:
                function(frame)

        self._start_queueing()
        threading.Thread(target=call, name="live-frames", daemon=True).start()
        return self

    def collect(self, seconds: float = 0.0) -> Take:
        """Return everything that arrives in so many seconds, as ``open_take`` returns a take.

        0 returns what has arrived since the last call. A source or component that has not come is missing. At
        most as many messages wait as for an iteration, so call it again before 15 s at 2200 messages per
        second. Frames are neither joined nor limited to those with parameters.
        """
        self._start_queueing()
        end_s = time.monotonic() + seconds
        loader = TakeLoader(None, COMPONENTS_BY_KEY)
        while True:
            for batch in self._take_batches():
                loader.add(batch)
            left_s = end_s - time.monotonic()
            if left_s <= 0 or self._is_closed:
                break
            time.sleep(min(left_s, _COLLECT_S))
        with self._taking:
            self._update_sources()
            for source in self._reception.sources_now:
                loader.describe(source.name, source.status, source.entries)
        start_utime = self._reception.start_utime
        return Take(None, start_utime, loader.finish(start_utime))

    # The details.

    def _start_queueing(self) -> None:
        self._reception.is_queueing = True
        self.open()

    def _decode(self) -> float:
        """Make frames of what waits, if it is known what describes them.

        Returns how long to wait for the next call unless something arrives.
        """
        self._check_process()
        self._num_decoded = 0
        if self._join is None and not (self._pending or self._reception.has_waiting):
            return _MAX_WAIT_S  # as before each wait of a program that keeps up
        with self._taking:
            now_s = self._decoded_s = time.monotonic()
            arrivals, wait_s = self._described(now_s)
            self._num_decoded = len(arrivals)
            waits: list[float | None] = [wait_s, _MAX_WAIT_S]
            frames = decode_frames(arrivals, self._reception.start_utime)
            if self._join is None:
                self._ready.extend(frames)
            else:
                for frame in frames:
                    self._join.add(frame, now_s)
                self._ready.extend(self._join.take(now_s))
                waits.append(self._join.wait_s(now_s))
        if self.num_dropped and not self._is_slow:
            self._is_slow = True
            warnings.warn(
                f"the program is too slow for the data: {self.num_dropped} messages were dropped so far; "
                "num_dropped counts them",
                RuntimeWarning,
                stacklevel=3,
            )
        return min(each for each in waits if each is not None)

    def _early_s(self) -> float:
        """Return how long to wait before decoding again, so that much that arrives is decoded together."""
        if self._num_decoded < _MANY:
            return 0.0
        return self._decoded_s + _MIN_STEP_S - time.monotonic()

    def _described(self, now_s: float) -> tuple[list[QueuedMessage], float | None]:
        """Return the next messages if their parameters are known; none, and how long to wait for these."""
        if not self._pending:
            self._pending = self._reception.take_waiting(_BATCH)
            self._pending_s = now_s
        self._update_sources()
        unknown = {
            (source, version)
            for source, version in {(each.series.source, each.message[_VERSION]) for each in self._pending}
            if not self._has_parameters(source, version)
        }
        left_s = self._pending_s + DESCRIBED_WITHIN_S - now_s
        if unknown and left_s > 0:
            return [], left_s
        self._given_up |= unknown
        arrivals, self._pending = self._pending, []
        return arrivals, 0.0 if len(arrivals) == _BATCH else None

    def _has_parameters(self, source: Any, version: bytes) -> bool:
        """Return whether there are parameters of a version, or they are no longer waited for."""
        number = int.from_bytes(version, "big", signed=True)
        return not number or source.has_version(number) or (source, version) in self._given_up

    def _update_sources(self) -> None:
        for source in self._reception.sources_now:
            source.update_parameters()

    def _take_batches(self) -> list[MessageBatch]:
        """Return what waits, by source and component."""
        with self._taking:
            arrivals, self._pending = [*self._pending, *self._reception.take_waiting()], []
        batches: dict[QueuedSeries, MessageBatch] = {}
        for series, message, arrived_utime, *_ in arrivals:
            batch = batches.get(series)
            if batch is None:
                batch = batches[series] = MessageBatch(series.source.name, series.key)
            batch.messages.append(message)
            batch.utimes.append(arrived_utime)
        return [*batches.values()]


class _Connection:
    """A subscriber, and a thread that asks about new sources and says once why nothing is heard."""

    def __init__(self, subscriber: GatewaySubscriber, reception: LiveReception) -> None:
        self._subscriber = subscriber
        self._reception = reception
        self.process = Process()
        self._closed = threading.Event()
        # Zenoh's threads for the replies to its queries are daemons only if this one is: see program_end.
        self._thread = threading.Thread(target=self._run, name="live-sources", daemon=False)
        self._thread.start()

    def close(self) -> None:
        """Unsubscribe."""
        if not (self._closed.is_set() or self.process.is_forked):
            self._closed.set()
            self._thread.join(_CLOSE_S)
            close_in_time(self._subscriber)

    def _run(self) -> None:
        start_s = time.monotonic()
        is_silent = True
        problems: set[tuple[str, str]] = set()
        while not self._closed.wait(_TICK_S):
            self._subscriber.tick()
            former, problems = problems, self._reception.refill_problems()
            for source, problem in sorted(problems - former):
                logger.warning("%s: messages are missing: %s", safe_text(source), safe_text(problem))
            is_silent = is_silent and self._reception.first_heard_s is None
            if is_silent and time.monotonic() - start_s > _SILENCE_S:
                is_silent = False
                text = silence_text(self._subscriber, self._reception)
                if self._reception.first_heard_s is None and not self._closed.is_set():
                    logger.warning("nothing is heard so far: %s", safe_text(text))
