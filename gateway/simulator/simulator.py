"""The simulator: an RT server that can have faults, whose kinds have names, and times in a scenario file."""

import asyncio
import contextlib
import logging
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Self, cast

import numpy as np
import yaml
from pydantic import BaseModel, PlainValidator, SerializeAsAny, ValidationError

from gateway.config.loading import load_as
from gateway.config.section import Section, expects, key_descriptions, validation_error
from gateway.config.words import describe, spelling_hint
from gateway.errors import ConfigError, GatewayError
from gateway.session.server.client_connection import ClientConnection
from gateway.session.server.scene import Scene
from gateway.session.server.server import RtServer
from gateway.simulator.fault_pipeline import ActiveConnectionFaults, FaultPipeline
from gateway.simulator.faults import (
    MOMENTARY_FAULTS,
    SERVER_FAULTS,
    STREAM_FAULTS,
    ActiveFault,
    ChangeScene,
    Cut,
    Fault,
    LastingConnectionFault,
    LastingFault,
    MomentaryFault,
    NoMeasurement,
    Rename,
    Restart,
    parameter_text,
)
from gateway.simulator.packet_faults import PACKET_FAULTS
from gateway.simulator.synthetic import RenamedScene, SceneSettings, Seed

_log = logging.getLogger(__name__)


class Simulator(RtServer):
    """An RT server that replaces the hardware in tests, and has faults on request.

    RtServer describes the arguments.
    """

    def __init__(
        self,
        scene: Scene,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        event_bytes: int = 24,
        once: bool = False,
    ) -> None:
        self.faults = Faults(self)
        """Begins and ends faults; by default there are none."""
        super().__init__(
            scene,
            host,
            port,
            event_bytes=event_bytes,
            once=once,
            name="RTC3D simulator",
            new_filter=self.faults.new_pipeline,
        )

    async def close(self) -> None:
        """End the faults, stop the measurement, close the connections, and stop listening."""
        await self.faults.close()
        await super().close()


_RETRY_S: Final = 1.0  # between attempts to listen on a port that another program has taken


class Faults:
    """The faults of a running server.

    Each beginning and end is logged in the form of the command line. All random choices depend on the
    seed of the last ``play`` (1 before the first) and on the number of faults since then, not on time.
    """

    def __init__(self, server: RtServer) -> None:
        self._server = server
        self.scene = SceneSettings()
        """The scenario's scene; faults that change the scene change its settings."""
        self._seed = 1
        self._num_added = 0  # faults since the last ``play``
        self._active: list[ActiveFault] = []  # in the order of KINDS
        self._playing: set[asyncio.Task[None]] = set()
        self._restarting: asyncio.Task[None] | None = None

    @property
    def active(self) -> list[Fault]:
        """The faults that are active, in the order in which they act."""
        return [active.fault for active in self._active]

    @property
    def connections(self) -> list[FaultPipeline]:
        """The pipelines of all connections."""
        filters = [connection.filter for connection in self._server.connections]
        return [pipeline for pipeline in filters if isinstance(pipeline, FaultPipeline)]

    def play(self, faults: Iterable[Fault], *, seed: int = 1, scene: SceneSettings | None = None) -> None:
        """Begin each fault at its own time, counted from now; ``scene`` is the scenario's scene."""
        self._seed, self._num_added = seed, 0
        self.scene = scene or self.scene
        for fault in faults:
            task = asyncio.get_running_loop().create_task(self._play(self._new_active_fault(fault)))
            self._playing.add(task)
            task.add_done_callback(self._playing.discard)

    def begin(self, fault: Fault) -> ActiveFault:
        """Begin a fault now, once; its ``at_s`` and ``every_s`` have no effect."""
        active = self._new_active_fault(fault)
        self._begin(active)
        return active

    def end(self, active: ActiveFault) -> None:
        """End a fault, if it is active."""
        if active not in self._active:
            return
        self._active.remove(active)
        active.cancel_end()
        if active.undo is not None:
            active.undo()
        active.ended.set()
        for pipeline in self.connections:
            pipeline.fault_ended()
        if not isinstance(active.fault, MomentaryFault):
            _log.info("Fault ends: %s (happened %d times so far)", active.fault, active.num_happened)

    async def clear(self) -> None:
        """End all faults and cancel planned ones. Send and read at once all bytes that faults hold back."""
        await self._stop_playing()
        for active in list(self._active):
            self.end(active)
        for pipeline in self.connections:
            pipeline.flush()
            pipeline.handle_unread()
        if self._restarting is not None:
            await self._restarting

    async def close(self) -> None:
        """Cancel all faults without undoing them: a server that has crashed does not come back."""
        await self._stop_playing()
        for active in self._active:
            active.cancel_end()
        self._active.clear()
        if self._restarting is not None:
            self._restarting.cancel()
            await asyncio.wait([self._restarting])

    # For connections ------------------------------------------------------------------------

    def new_pipeline(self, connection: ClientConnection) -> FaultPipeline:
        """Return the filter for a new connection."""
        return FaultPipeline(connection, self.active_on, self._count)

    def active_on(self, number: int) -> ActiveConnectionFaults:
        """Return the faults that are active on the connection with this number, in the order of KINDS."""
        return [
            (active, active.fault)
            for active in self._active
            if isinstance(active.fault, LastingConnectionFault) and active.fault.applies_to(number)
        ]

    # What faults do to the server and to connections ----------------------------------------

    def _begin(self, active: ActiveFault) -> None:
        fault = active.fault
        _log.info("Fault: %s" if isinstance(fault, MomentaryFault) else "Fault begins: %s", fault)
        self._active.append(active)
        self._active.sort(key=lambda active: _ORDER[active.fault.kind])
        active.begin()
        active.undo = self._apply(fault, active.rng)
        if not isinstance(fault, LastingConnectionFault):
            active.num_happened += 1
        match fault:
            case LastingFault():
                lasts_s = fault.for_s
            case Restart():
                lasts_s = fault.away_s
            case _:
                lasts_s = 0.0
        if lasts_s:
            active.end_timer = asyncio.get_running_loop().call_later(lasts_s, self.end, active)
        elif lasts_s is not None:
            self.end(active)

    def _apply(self, fault: Fault, rng: np.random.Generator) -> Callable[[], None] | None:
        """Do what a fault does when it begins; return what undoes it. Others act while data is sent."""
        match fault:
            case NoMeasurement():
                self._server.stop_measurement()
                return self._start_measurement
            case ChangeScene():
                return self._serve(self.scene.with_changes(fault.scene).build())
            case Rename():
                return self._serve(cast("Scene", RenamedScene(self._server.scene, fault.prefix)))
            case Restart():
                self._server.crash()
                if fault.scene.model_fields_set:
                    self._serve(self.scene.with_changes(fault.scene).build())
                return self._begin_restart
            case MomentaryFault():
                for pipeline in self.connections:
                    if not fault.applies_to(pipeline.connection.number):
                        continue
                    if isinstance(fault, Cut):
                        pipeline.disconnect(fault.data(rng), reset=fault.reset)
                    else:
                        pipeline.send_unchanged(fault.data(rng))
        return None

    def _start_measurement(self) -> None:
        """Start a measurement, unless another fault prevents it."""
        if self._server.is_listening and not self._is_active(NoMeasurement):
            self._server.start_measurement()

    def _begin_restart(self) -> None:
        """Listen again after a crash, unless another fault prevents it."""
        if self._restarting is None or self._restarting.done():
            self._restarting = asyncio.get_running_loop().create_task(self._restart())

    def _serve(self, scene: Scene) -> Callable[[], None]:
        before = self._server.scene
        self._server.change_scene(scene)
        return lambda: self._server.change_scene(before)

    def _new_active_fault(self, fault: Fault) -> ActiveFault:
        self._num_added += 1
        return ActiveFault(fault, np.random.default_rng((self._seed, self._num_added)))

    async def _play(self, active: ActiveFault) -> None:
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        delay_s = active.first_delay_s()
        while True:
            await asyncio.sleep(began_s + delay_s - loop.time())
            began_s = loop.time()
            self._begin(active)
            await active.ended.wait()
            if active.fault.every_s is None or active.is_exhausted:
                return
            delay_s = active.random_interval_s(active.fault.every_s)

    def _count(self, changed_by: Iterable[ActiveFault]) -> None:
        """Count that these faults changed something, and end those that are exhausted."""
        for active in changed_by:
            active.num_happened += 1
            if active.is_exhausted:
                self.end(active)

    def _is_active(self, kind: type[Fault]) -> bool:
        return any(isinstance(fault, kind) for fault in self.active)

    async def _restart(self) -> None:
        while not (self._server.is_listening or self._is_active(Restart)):
            try:
                await self._server.start()
            except GatewayError as error:
                _log.error("%s", error)
                await asyncio.sleep(_RETRY_S)
        if self._is_active(Restart):
            self._server.crash()  # another restart has begun in the meantime
        elif self._is_active(NoMeasurement):
            self._server.stop_measurement()

    async def _stop_playing(self) -> None:
        for task in self._playing:
            task.cancel()
        if self._playing:
            await asyncio.wait(self._playing)


KINDS: Final[dict[str, type[Fault]]] = {
    fault.kind: fault for fault in (*SERVER_FAULTS, *PACKET_FAULTS, *STREAM_FAULTS, *MOMENTARY_FAULTS)
}
"""All kinds by name, in the order in which they act on the bytes of a connection."""

COMMON_PARAMETERS: Final = {
    "at_s": "begin this many seconds after the start; without at_s and every_s, begin at the start",
    "every_s": "begin repeatedly, at intervals of this many seconds, varied at random by up to half",
    "for_s": "last this many seconds; without for_s, last until the simulator ends",
    "times": "happen at most this many times: packets, replies or reads changed; for other kinds, beginnings",
    "connection": "affect only the n-th connection since the server's start; without it, affect all",
}
"""The parameters that many kinds have, and what they do."""

_ORDER: Final = {name: position for position, name in enumerate(KINDS)}
_NAMES: Final = ", ".join(KINDS)
_COMMAS: Final = re.compile(r",(?![^\[]*\])")  # except commas in a list


def parse_fault(text: str) -> Fault:
    """Return the fault in the form ``KIND,NAME=VALUE,…``, such as ``restart,away_s=2,scene.markers=12``.

    Lists are written ``[a,b]``. Raises ConfigError, one line per mistake.
    """
    kind, *assignments = _COMMAS.split(text)
    values: dict[str, Any] = {"fault": kind}
    for assignment in assignments:
        path, equals, value = assignment.partition("=")
        *mappings, name = path.split(".")
        target = values
        for mapping in mappings:
            target = target.setdefault(mapping, {})
            if not isinstance(target, dict):
                raise ConfigError(
                    f"fault {text!r}: {mapping} has both a value and keys; expected only one of them"
                )
        if not equals or name in target:
            raise ConfigError(f"fault {text!r}: found {assignment!r}; expected NAME=VALUE, each name once")
        target[name] = value
        with contextlib.suppress(yaml.YAMLError):
            target[name] = yaml.safe_load(value)
    try:
        return validate_fault(values)
    except ValidationError as error:
        lines = []
        for details in error.errors(include_url=False):
            where = ".".join(map(str, details["loc"]))
            lines.append(f"fault {text!r}: {where}: {details['msg']}")
        raise ConfigError("\n".join(lines)) from None


def validate_fault(value: object) -> Fault:
    """Return the fault that a mapping describes: its kind under the key ``fault``, and its parameters.

    Raises pydantic's ValidationError.
    """
    match value:
        case Fault():
            return value
        case {"fault": str(kind), **parameters} if kind in KINDS:
            return KINDS[kind].model_validate(parameters)
        case {"fault": kind}:
            raise validation_error(
                f"found {describe(kind)}{spelling_hint(kind, KINDS)}; expected {_NAMES}", "fault"
            )
    raise validation_error(f"found {describe(value)}; expected a mapping with the key fault, one of {_NAMES}")


def parameters_of(kind: type[Fault]) -> Iterator[tuple[str, str, str]]:
    """Yield name, default ("" for none) and description of each parameter except the common ones."""
    descriptions = key_descriptions(kind)
    for name, field in kind.model_fields.items():
        if name not in COMMON_PARAMETERS:
            default = field.get_default()
            has_text = not field.is_required() and not isinstance(default, BaseModel)
            yield name, parameter_text(default) if has_text else "", descriptions.get(name, "")


def describe_kinds() -> str:
    """Return a text for the terminal that describes every kind and its parameters."""
    lines = []
    for name, kind in KINDS.items():
        common = [key for key in ("for_s", "connection") if key in kind.model_fields]
        lines.append(f"{name}{''.join(f' [{key}]' for key in common)}")
        lines.append(f"    {(kind.__doc__ or '').splitlines()[0]}")
        for key, default, text in parameters_of(kind):
            lines.append(f"    {key}{'=' if default else ''}{default}  {text}")
    lines += [
        "",
        "Every kind has at_s, every_s and times; for_s and connection only where they follow its name:",
    ]
    lines += [f"    {key}  {text}" for key, text in COMMON_PARAMETERS.items()]
    return "\n".join(lines)


_EXAMPLE: Final = "config/scenarios/bad-day.yaml"


class Scenario(Section):
    """The content of a scenario file."""

    scene: SceneSettings = SceneSettings()
    """The synthetic scene at the start."""

    faults: Annotated[
        tuple[Annotated[SerializeAsAny[Fault], PlainValidator(validate_fault)], ...],
        expects("a list of faults"),
    ]
    """The faults; ``rtc3d-gateway simulate --list-faults`` describes their kinds."""

    seed: Seed = 1
    """The seed of all random choices of the faults."""

    def with_overrides(self, scene: Mapping[str, float], faults: Iterable[Fault], seed: int | None) -> Self:
        """Return this scenario with changes to its scene, more faults, and ``seed`` unless it is None."""
        return self.model_copy(
            update={
                "scene": self.scene.model_copy(update=dict(scene)),
                "faults": (*self.faults, *faults),
                "seed": self.seed if seed is None else seed,
            }
        )


def load_scenario(path: Path) -> Scenario:
    """Return the scenario in the YAML file at ``path``.

    Raises ConfigError with one line per mistake: file, line, column, key, and what was expected.
    """
    return load_as(Scenario, path, example=_EXAMPLE)
