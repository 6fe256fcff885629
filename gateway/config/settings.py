"""The configuration of the gateway as frozen, validated settings.

The docstring under each key describes it for users; ``config/gateway.yaml`` explains when to change it.
Mistakes raise pydantic's ValidationError. Each mistake has its location and a sentence that says what was
found and what is expected. ``gateway.config.loading`` adds file, line and column.
"""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple, Self

from pydantic import (
    Field,
    PlainValidator,
    TypeAdapter,
    WrapValidator,
    create_model,
    field_validator,
    model_validator,
)
from pydantic.json_schema import SkipJsonSchema
from typing_extensions import override

from gateway.config import values
from gateway.config.files import folder_of
from gateway.config.section import Effective, Section, expects, validation_error, validation_errors
from gateway.rtc3d.commands import AllFrames, Frequency
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.packets import DEFAULT_MAX_C3D_BYTES, DEFAULT_MAX_PACKET_BYTES, FIRST_PRINCIPLES_PORT


class StreamSettings(Section):
    """One TCP session with the server of a source: its components and their rate."""

    components: values.Components = WIRE_ORDER
    """The components to request: [all], or a list of 3d, 6d, analog, force, event in any order."""

    rate: values.StreamRate = AllFrames()
    """The rate to request: all, {frequency_hz: NUMBER} or {divisor: WHOLE NUMBER}."""

    backlog: values.Backlog = "all"
    """While frames are late: publish all frames, or only the newest one. Events are never skipped."""

    backlog_speed: values.Speed = 2.0
    """How fast a backlog is published with `backlog: all`, as a multiple of the stream's own rate."""

    adapt_rate: values.Switch = False
    """Whether to request a lower rate from the server while frames are late."""

    on_demand: values.Switch = False
    """Whether to stream only while someone subscribes. No effect while LCM is enabled."""

    idle_after_s: values.Seconds = 5.0
    """How long an on-demand stream continues without subscribers before it stops."""

    @property
    def has_only_events(self) -> bool:
        """Whether nothing but events is requested, which are sporadic."""
        return set(self.components) == {ComponentType.EVENT}


_StreamList = Annotated[
    tuple[StreamSettings, ...],
    values.not_empty,
    expects("auto, or a list of streams, one or more"),
    Field(json_schema_extra={"minItems": 1}),
]
_STREAM_LIST: Final[TypeAdapter[tuple[StreamSettings, ...]]] = TypeAdapter(_StreamList)


# As a mere union, a mistake in a list would also be reported as not being the word auto.
Streams = Annotated[
    Literal["auto"] | _StreamList,
    WrapValidator(lambda value, _: value if value == "auto" else _STREAM_LIST.validate_python(value)),
]
"""In YAML: auto, or a list of streams."""


class ReconnectSettings(Section):
    """The delays between connection attempts: each about twice the previous one, up to a maximum."""

    first_delay_s: values.Seconds = 0.2
    """The first delay."""

    max_delay_s: values.Seconds = 10.0
    """The longest delay."""

    @model_validator(mode="after")
    def _check_max_delay(self) -> Self:
        if self.max_delay_s < self.first_delay_s:
            raise validation_error(
                f"found {self.max_delay_s:g}; expected first_delay_s ({self.first_delay_s:g}) or more",
                "max_delay_s",
            )
        return self


class SourceSettings(Section):
    """One RTC3D server and how to stream from it."""

    name: values.SourceName
    """The name of this source in keys and channels. In channels, it is in upper case, and '-' becomes '_'."""

    host: values.Host
    """The host name or IP address of the server."""

    port: values.Port = FIRST_PRINCIPLES_PORT
    """The TCP port of the server: 3020 for First Principles, 3030 for WaveFront."""

    byte_order: values.ServerByteOrder = "big"
    """The byte order to request. The published messages are the same in both."""

    frame_id: values.FrameId | None = None
    """The name of the coordinate frame of poses, which sources can share. null means the source's name."""

    transform: values.TransformSettings = values.TransformSettings()
    """From the server's units and axes to the frame of poses. Component messages are never transformed."""

    streams: Streams = "auto"
    """The TCP sessions with the server: auto for one per rate, or a list with components and rates."""

    reconnect: ReconnectSettings = ReconnectSettings()
    """The delays between connection attempts."""

    connect_timeout_s: values.Seconds = 5.0
    """How long a connection attempt may take, the look-up of the name included."""

    reply_timeout_s: values.Seconds = 2.0
    """How long the server may take to answer a command."""

    stall_timeout_s: values.Seconds = 3.0
    """How long a stream may be silent while a measurement runs."""

    max_lag_ms: values.Milliseconds = 50.0
    """How late frames may be: see `backlog` and `adapt_rate` of the streams."""

    max_packet_bytes: values.ByteLimit = DEFAULT_MAX_PACKET_BYTES
    """The largest accepted packet, except for C3D files."""

    max_c3d_bytes: values.ByteLimit = DEFAULT_MAX_C3D_BYTES
    """The largest accepted C3D file."""

    query_timeout_s: values.Seconds = 4.0
    """How long a query may wait for the server, including the time for queries before it."""

    fresh_interval_s: values.Seconds = 1.0
    """How long a reply of the server counts as fresh. It limits how often peers can query the server."""

    parameters_interval_s: values.IntervalSeconds = 10.0
    """How often to read the server's parameters again, for example for renamed markers. 0 means never."""

    remote_control: values.Switch = False
    """Whether peers may start and stop recordings on the server, and takes."""

    @property
    def effective(self) -> dict[str, Effective]:
        """The source's name as ``frame_id``."""
        return {} if self.frame_id is not None else {"frame_id": Effective(self.name)}

    @property
    def components(self) -> frozenset[ComponentType]:
        """The components that the streams request."""
        streams = (StreamSettings(),) if self.streams == "auto" else self.streams
        return frozenset(component for stream in streams for component in stream.components)

    def connects_like(self, other: "SourceSettings") -> bool:
        """Return whether these settings differ from ``other`` at most in the frame of poses."""
        return self == other.model_copy(update={"frame_id": self.frame_id, "transform": self.transform})

    def has_frame_of(self, other: "SourceSettings") -> bool:
        """Return whether poses have the same frame as with ``other``."""
        return (self.frame_id, self.transform) == (other.frame_id, other.transform)

    @field_validator("streams")
    @classmethod
    def _check_components_are_in_one_stream(
        cls, streams: Literal["auto"] | tuple[StreamSettings, ...]
    ) -> Literal["auto"] | tuple[StreamSettings, ...]:
        owners: dict[ComponentType, int] = {}
        for index, stream in enumerate(() if streams == "auto" else streams):
            for component in stream.components:
                if component in owners:
                    raise validation_error(
                        f"found {component.key!r}, which streams[{owners[component]}] has too; "
                        "expected each component in one stream only, because it has one key and one channel",
                        *(index, "components"),
                    )
                owners[component] = index
        return streams

    @model_validator(mode="after")
    def _check_rates_against_stall_timeout(self) -> Self:
        for index, stream in enumerate(() if self.streams == "auto" else self.streams):
            if isinstance(stream.rate, Frequency) and stream.rate.hz * self.stall_timeout_s <= 1:
                raise validation_error(
                    f"found {stream.rate.hz:g}, one frame in {1 / stream.rate.hz:g} s, which counts as "
                    f"silence because stall_timeout_s is {self.stall_timeout_s:g}; expected more than "
                    f"{1 / self.stall_timeout_s:g}, or a longer stall_timeout_s",
                    *("streams", index, "rate", "frequency_hz"),
                )
        return self


class ListenAddress(NamedTuple):
    """A TCP address that the gateway listens on; ``key`` is the path to the port in its section."""

    key: tuple[str, ...]
    host: str
    port: int


_ALL_ADDRESSES: Final = {"0.0.0.0", "::"}  # noqa: S104 - not bound here


class OutputSettings(Section):
    """The keys that all outputs have."""

    foreign_keys: ClassVar[Mapping[str, str]] = {}
    """The keys that hold the configuration of another program, each with a safe place for its secrets."""

    enabled: values.Switch = False
    """Whether to publish on this output."""

    @property
    def listens_on(self) -> Sequence[ListenAddress]:
        """The TCP addresses that the gateway listens on, except those in URLs of Zenoh and LCM."""
        return ()

    @property
    def certificates(self) -> Mapping[str, Path]:
        """The files with TLS certificates that the output uses, by the names of the keys that name them."""
        return {}


def default_folder(configured: str | None, name: str) -> dict[str, Effective]:
    """Return the effective ``directory`` of a section (see Section), if it is not a configured one."""
    if configured is not None:
        return {}
    folder = folder_of(None, name)
    return {"directory": Effective(str(folder), ("STATE_DIRECTORY", "XDG_STATE_HOME"))}


class SpoolSettings(Section):
    """Storage for complete C3D files from the servers."""

    directory: values.AbsoluteDirectory | None = None
    """The folder. null means c3d in the state directory of the service, or of the user without systemd."""

    max_files: values.FileLimit = 100
    """The maximum number of files of each source. Its oldest are deleted first."""

    max_bytes: values.ByteLimit = 1024 * 1024 * 1024
    """The maximum total size of the files of each source. Its oldest are deleted first."""

    @property
    @override
    def effective(self) -> dict[str, Effective]:
        return default_folder(self.directory, "c3d")

    @property
    def effective_directory(self) -> Path:
        """``directory``, or the default folder if it is None."""
        return folder_of(self.directory, "c3d")


class HistorySettings(Section):
    """The newest messages, kept in memory, so that subscribers can ask for those they have missed."""

    seconds: values.IntervalSeconds = 60.0
    """How long messages are kept. With 0, none are, and none come from the disk."""

    max_bytes: values.ByteLimit = 128 * 1024 * 1024
    """The memory for the messages of all sources, which share it equally. The oldest are dropped first."""


class MetricsSettings(Section):
    """Monitoring over HTTP: Prometheus metrics on /metrics, the health check on /healthz."""

    enabled: values.Switch = True
    """Whether to serve HTTP."""

    host: values.Host = "127.0.0.1"
    """The address to listen on: one of this host, or 0.0.0.0 or "::" for all."""

    port: values.Port = 9464
    """The TCP port."""

    @property
    def listens_on(self) -> Sequence[ListenAddress]:
        """See OutputSettings."""
        return [ListenAddress(("port",), self.host, self.port)]


class Settings(Section):
    """The configuration without outputs; ``settings_model`` adds a section for each output."""

    sources: Annotated[
        tuple[SourceSettings, ...],
        values.not_empty,
        expects("a list of sources, one or more, each with name and host"),
        Field(json_schema_extra={"minItems": 1}),
    ]
    """The motion-capture servers."""

    spool: SpoolSettings = SpoolSettings()
    """Storage for C3D files from the servers."""

    history: HistorySettings = HistorySettings()
    """The newest messages, for subscribers that have missed some."""

    metrics: MetricsSettings = MetricsSettings()
    """Monitoring over HTTP."""

    @property
    def outputs(self) -> dict[str, OutputSettings]:
        """The sections of the outputs, by name."""
        sections = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: section for name, section in sections.items() if isinstance(section, OutputSettings)}

    @model_validator(mode="after")
    def _check_names_differ(self) -> Self:
        lcm = self.outputs.get("lcm")
        has_channels = lcm is not None and lcm.enabled
        owners: dict[str, int] = {}
        mistakes: list[tuple[str, tuple[str | int, ...]]] = []
        for index, source in enumerate(self.sources):
            # gateway.messages.topics builds channels in the same way: upper case, and one '_' for the rest.
            identity = "_".join(re.findall("[A-Z0-9]+", source.name.upper())) if has_channels else source.name
            other = owners.setdefault(identity, index)
            if other == index:
                continue
            if source.name == self.sources[other].name:
                text = f"found {source.name!r}, the name of sources[{other}], too; expected another one"
            else:
                text = (
                    f"found {source.name!r}, which has the same LCM channels as {self.sources[other].name!r} "
                    f"(sources[{other}]); expected a name that differs in letters or digits, ignoring case, "
                    "or lcm.enabled: false"
                )
            mistakes.append((text, ("sources", index, "name")))
        if mistakes:
            raise validation_errors(mistakes)
        return self

    @model_validator(mode="after")
    def _check_any_output_is_enabled(self) -> Self:
        outputs = self.outputs
        if outputs and not any(section.enabled for section in outputs.values()):
            *others, last = (f"{name}.enabled" for name in outputs)
            found = f"found false here and in {' and '.join(others)}" if others else "found false"
            raise validation_error(f"{found}; expected true in at least one of them", *last.split("."))
        return self

    @model_validator(mode="after")
    def _check_ports_differ(self) -> Self:
        sections: dict[str, MetricsSettings | OutputSettings] = {"metrics": self.metrics, **self.outputs}
        used: dict[str, ListenAddress] = {}
        mistakes: list[tuple[str, tuple[str | int, ...]]] = []
        for name, section in sections.items():
            for address in section.listens_on if section.enabled else ():
                for other_key, other in used.items():
                    hosts = {address.host, other.host}
                    if address.port == other.port and (len(hosts) == 1 or hosts & _ALL_ADDRESSES):
                        text = f"found {address.port}, which {other_key} has too; expected another port"
                        mistakes.append((text, (name, *address.key)))
                        break
                used[".".join((name, *address.key))] = address
        if mistakes:
            raise validation_errors(mistakes)
        return self


def settings_model(
    outputs: Mapping[str, type[OutputSettings]], unusable: Mapping[str, str] | None = None
) -> type[Settings]:
    """Return the model of the whole configuration with these outputs, by the name of their section.

    A section with one of the names in ``unusable`` is refused with the text there.
    """
    sections: dict[str, Any] = {
        name: (section, Field(default=section(), description=f"The output {name}."))
        for name, section in outputs.items()
    }
    for name, text in (unusable or {}).items():
        refuse = PlainValidator(partial(_refuse, text))
        sections[name] = (Annotated[SkipJsonSchema[None], refuse], Field(default=None, exclude=True))  # type: ignore[misc]
    return create_model("Settings", __base__=Settings, __doc__="The whole configuration.", **sections)


def _refuse(text: str, _section: object) -> None:
    raise validation_error(text)
