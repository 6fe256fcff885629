"""Begins and ends a simulator's faults: now, or when a scenario says."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

import numpy as np

from gateway.errors import GatewayError
from gateway.simulator.faults.base import Fault, LineFault, Run, StrikeFault
from gateway.simulator.faults.kinds import KINDS
from gateway.simulator.faults.line import Line
from gateway.simulator.faults.server_faults import NoMeasurement, Restart
from gateway.simulator.scene_settings import SceneSettings

if TYPE_CHECKING:
    from gateway.rtc3d_server.client_connection import ClientConnection
    from gateway.rtc3d_server.server import Simulator

_RETRY_S: Final = 1.0  # until the port is free again, if something else took it meanwhile
_ORDER: Final = {kind: place for place, kind in enumerate(KINDS.values())}
_log = logging.getLogger(__name__)


class Faults:
    """A running simulator's faults. Each beginning and end is logged, in the command line's form.

    What is random depends on the seed of the last ``play`` (1 before any) and on how many faults
    were given since, not on time.
    """

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self.scene = SceneSettings()
        """What the faults that bring another scene change."""
        self._seed = 1
        self._given = 0
        self._on: list[Run] = []  # in the order of KINDS
        self._playing: set[asyncio.Task[None]] = set()
        self._coming_back: asyncio.Task[None] | None = None

    @property
    def active(self) -> list[Fault]:
        """The faults that are on, in the order in which they act."""
        return [run.fault for run in self._on]

    def play(self, faults: Iterable[Fault], *, seed: int = 1, scene: SceneSettings | None = None) -> None:
        """Begin each fault when it says, counted from now; ``scene`` is the one that is played."""
        self._seed, self._given = seed, 0
        self.scene = scene or self.scene
        for fault in faults:
            task = asyncio.get_running_loop().create_task(self._play(self._new_run(fault)))
            self._playing.add(task)
            task.add_done_callback(self._playing.discard)

    def begin(self, fault: Fault) -> Run:
        """Begin a fault now, once, whatever its ``at_s`` and ``every_s``."""
        run = self._new_run(fault)
        self._begin(run)
        return run

    def end(self, run: Run) -> None:
        """End a fault, if it is on."""
        if run not in self._on:
            return
        self._on.remove(run)
        run.end()
        for connection in self._simulator.connections:
            if connection.line is not None:
                connection.line.fault_ended()
        if not isinstance(run.fault, StrikeFault):
            _log.info("Fault ends: %s (happened so far: %d)", run.fault, run.times)

    async def clear(self) -> None:
        """Make the server well: when this returns, no fault is on or planned, and nothing waits."""
        await self._stop_playing()
        for run in list(self._on):
            self.end(run)
        for connection in list(self._simulator.connections):
            line = connection.line
            if line is not None:
                line.flush()
                line.read()
        if self._coming_back is not None:
            await self._coming_back

    async def close(self) -> None:
        """Drop all faults; a server that is away stays away."""
        await self._stop_playing()
        for run in self._on:
            run.cancel()
        self._on.clear()
        if self._coming_back is not None:
            self._coming_back.cancel()
            await asyncio.wait([self._coming_back])

    # What connections and lines call --------------------------------------------------------

    def connected(self, connection: ClientConnection) -> None:
        """Put a line into a connection if a fault that is on needs it."""
        if connection.line is None and self.on_line(connection):
            connection.line = Line(connection, self)

    def on_line(self, connection: ClientConnection) -> list[tuple[Run, LineFault]]:
        """Return the faults that are on for what passes through a connection, in their order."""
        return [
            (run, run.fault)
            for run in self._on
            if isinstance(run.fault, LineFault) and run.fault.covers(connection)
        ]

    def acted(self, runs: Iterable[Run]) -> None:
        """Count that faults happened, and end those that may not happen again."""
        for run in runs:
            run.times += 1
            if run.is_spent:
                self.end(run)

    # What faults call -----------------------------------------------------------------------

    def start_measurement(self) -> None:
        """Start a measurement, unless another fault forbids it."""
        if self._simulator.is_listening and not self._is_on(NoMeasurement):
            self._simulator.start_measurement()

    def come_back(self) -> None:
        """Start the server again, unless another fault keeps it away."""
        if self._coming_back is None or self._coming_back.done():
            self._coming_back = asyncio.get_running_loop().create_task(self._come_back())

    # ----------------------------------------------------------------------------------------

    def _new_run(self, fault: Fault) -> Run:
        self._given += 1
        return Run(fault, self._simulator, np.random.default_rng((self._seed, self._given)))

    async def _play(self, run: Run) -> None:
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        wait_s = run.first_wait_s()
        while True:
            await asyncio.sleep(began_s + wait_s - loop.time())
            began_s = loop.time()
            self._begin(run)
            await run.is_over.wait()
            if run.fault.every_s is None or run.is_spent:
                return
            wait_s = run.next_wait_s(run.fault.every_s)

    def _begin(self, run: Run) -> None:
        fault = run.fault
        _log.info("Fault: %s" if isinstance(fault, StrikeFault) else "Fault begins: %s", fault)
        self._on.append(run)
        self._on.sort(key=lambda on: _ORDER[type(on.fault)])
        run.begin()
        if isinstance(fault, LineFault):
            for connection in self._simulator.connections:
                self.connected(connection)
        else:
            run.times += 1
        if fault.lasts_s is not None:
            run.end_after(fault.lasts_s, self.end)

    def _is_on(self, kind: type[Fault]) -> bool:
        return any(isinstance(fault, kind) for fault in self.active)

    async def _come_back(self) -> None:
        while not (self._simulator.is_listening or self._is_on(Restart)):
            try:
                await self._simulator.start()
            except GatewayError as error:
                _log.error("%s", error)
                await asyncio.sleep(_RETRY_S)
        if self._is_on(Restart):
            self._simulator.vanish()  # another one began meanwhile
        elif self._is_on(NoMeasurement):
            self._simulator.stop_measurement()

    async def _stop_playing(self) -> None:
        for task in self._playing:
            task.cancel()
        if self._playing:
            await asyncio.wait(self._playing)
