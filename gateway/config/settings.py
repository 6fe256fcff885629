"""The gateway's configuration as frozen, validated settings.

The docstring under each key says what it is; ``config/gateway.yaml`` says why one would change it.
Mistakes raise pydantic's ValidationError, each with its location and a sentence: what was found and
what is accepted. ``gateway.config.loading`` adds file, line and column.
"""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import AfterValidator, Field, create_model, field_validator, model_validator

from gateway.config.section import Effective, Section, expects, join_or, validation_error
from gateway.config.values import (
    Backlog,
    ByteLimit,
    Components,
    FileLimit,
    Host,
    Milliseconds,
    Port,
    Seconds,
    ServerByteOrder,
    SourceName,
    SpoolDirectory,
    StreamRate,
    Switch,
    not_empty,
)
from gateway.rtc3d.commands import AllFrames, Frequency
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.packets import DEFAULT_MAX_C3D_BYTES, DEFAULT_MAX_PACKET_BYTES
from gateway.rtc3d.ports import FIRST_PRINCIPLES_PORT


class StreamSettings(Section):
    """One TCP session with a source's server: these components at this rate."""

    components: Components = WIRE_ORDER
    """What to ask for: [all], or a list of 3d, 6d, analog, force, event in any order."""

    rate: StreamRate = AllFrames()
    """How often: all, {frequency_hz: NUMBER} or {divisor: WHOLE NUMBER}."""

    backlog: Backlog = "latest"
    """While frames come late: publish the newest only, or all of them. Events are never skipped."""

    on_demand: Switch = False
    """Whether the stream runs only while somebody listens; with LCM on, somebody always may."""

    idle_after_s: Seconds = 5.0
    """How long nobody must have listened before an on-demand stream is stopped."""


class ReconnectSettings(Section):
    """The waits between tries to connect: each about twice the one before, up to a maximum."""

    first_delay_s: Seconds = 0.2
    """The first wait."""

    max_delay_s: Seconds = 10.0
    """The longest wait."""

    @model_validator(mode="after")
    def _max_is_not_below_first(self) -> Self:
        if self.max_delay_s < self.first_delay_s:
            raise validation_error(
                f"found {self.max_delay_s:g}; expected first_delay_s ({self.first_delay_s:g}) or more",
                "max_delay_s",
            )
        return self


class SourceSettings(Section):
    """One RTC3D server, and how to read it."""

    name: SourceName
    """What keys and channels call this source; channels in upper case, with '_' for '-'."""

    host: Host
    """The server's name or address."""

    port: Port = FIRST_PRINCIPLES_PORT
    """The server's TCP port: 3020 for First Principles, 3030 for WaveFront."""

    byte_order: ServerByteOrder = "big"
    """The byte order to ask for. What is published is the same in both."""

    streams: Annotated[
        tuple[StreamSettings, ...],
        AfterValidator(not_empty),
        expects("a list of streams, one or more"),
        Field(json_schema_extra={"minItems": 1}),
    ] = (StreamSettings(),)
    """The TCP sessions with the server, each with its components and its rate."""

    reconnect: ReconnectSettings = ReconnectSettings()
    """The waits between tries to connect."""

    connect_timeout_s: Seconds = 5.0
    """How long a try to connect may take."""

    reply_timeout_s: Seconds = 2.0
    """How long the server may take to answer a command."""

    stall_timeout_s: Seconds = 3.0
    """How long a stream may be silent while a measurement runs."""

    max_lag_ms: Milliseconds = 50.0
    """How late frames may come before less is asked of the server."""

    max_packet_bytes: ByteLimit = DEFAULT_MAX_PACKET_BYTES
    """The largest packet that is believed; C3D files have a limit of their own."""

    max_c3d_bytes: ByteLimit = DEFAULT_MAX_C3D_BYTES
    """The largest C3D file that is taken."""

    query_timeout_s: Seconds = 4.0
    """How long a peer's question may wait for the server, the questions before it included."""

    fresh_interval_s: Seconds = 1.0
    """How long an answer of the server counts as fresh: no peer makes it answer more often."""

    remote_control: Switch = False
    """Whether peers may start and stop the server's recording."""

    @field_validator("streams")
    @classmethod
    def _each_component_is_in_one_stream(
        cls, streams: tuple[StreamSettings, ...]
    ) -> tuple[StreamSettings, ...]:
        owners: dict[ComponentType, int] = {}
        for index, stream in enumerate(streams):
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
    def _frames_come_before_the_stall(self) -> Self:
        for index, stream in enumerate(self.streams):
            if isinstance(stream.rate, Frequency) and stream.rate.hz * self.stall_timeout_s <= 1:
                raise validation_error(
                    f"found {stream.rate.hz:g}, one frame in {1 / stream.rate.hz:g} s, which counts as "
                    f"silence because stall_timeout_s is {self.stall_timeout_s:g}; expected more than "
                    f"{1 / self.stall_timeout_s:g}, or a longer stall_timeout_s",
                    *("streams", index, "rate", "frequency_hz"),
                )
        return self


class OutputSettings(Section):
    """What the sections of all outputs have in common."""

    foreign_keys: ClassVar[Mapping[str, str]] = {}
    """The keys that hold another program's configuration, each with a place where its secrets may stay."""

    enabled: Switch = False
    """Whether the output is used."""


class SpoolSettings(Section):
    """Where complete C3D files that servers send are kept."""

    directory: SpoolDirectory | None = None
    """A folder; null is c3d in the service's state directory under systemd, else in the user's."""

    max_files: FileLimit = 100
    """How many files are kept; the oldest goes first."""

    max_bytes: ByteLimit = 1024 * 1024 * 1024
    """How many bytes they may take together; the oldest goes first."""

    @property
    def effective(self) -> dict[str, Effective]:
        """See Section."""
        if self.directory is not None:
            return {}
        return {"directory": Effective(str(self.effective_directory), ("STATE_DIRECTORY", "XDG_STATE_HOME"))}

    @property
    def effective_directory(self) -> Path:
        """The folder in use."""
        if self.directory is not None:
            return Path(self.directory)
        state = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
        if state:
            return Path(state) / "c3d"
        home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
        return Path(home) / "rtc3d-gateway" / "c3d"


class MetricsSettings(Section):
    """How the gateway is watched over HTTP: Prometheus' metrics on /metrics, and /healthz."""

    enabled: Switch = True
    """Whether HTTP is served at all."""

    address: Host = "127.0.0.1"
    """Where to listen: an address of this host, 0.0.0.0 or "::" for all."""

    port: Port = 9464
    """The TCP port."""


class Settings(Section):
    """The whole configuration, apart from the outputs: ``settings_model`` adds a section for each."""

    sources: Annotated[
        tuple[SourceSettings, ...],
        AfterValidator(not_empty),
        expects("a list of sources, one or more, each with name and host"),
        Field(json_schema_extra={"minItems": 1}),
    ]
    """The servers."""

    spool: SpoolSettings = SpoolSettings()
    """Where the servers' C3D files are kept."""

    metrics: MetricsSettings = MetricsSettings()
    """How the gateway is watched."""

    @property
    def outputs(self) -> dict[str, OutputSettings]:
        """The sections of the outputs, by name."""
        sections = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: section for name, section in sections.items() if isinstance(section, OutputSettings)}

    @field_validator("sources")
    @classmethod
    def _names_make_different_channels(
        cls, sources: tuple[SourceSettings, ...]
    ) -> tuple[SourceSettings, ...]:
        owners: dict[str, int] = {}
        for index, source in enumerate(sources):
            # As gateway.messages.topics makes channels: upper case, and everything else a single '_'.
            channel = "_".join(re.findall("[A-Z0-9]+", source.name.upper()))
            if channel in owners:
                other = owners[channel]
                raise validation_error(
                    f"found {source.name!r}, which has the same LCM channels as {sources[other].name!r} "
                    f"(sources[{other}]); expected a name that differs in letters or digits, ignoring case",
                    *(index, "name"),
                )
            owners[channel] = index
        return sources

    @model_validator(mode="after")
    def _something_is_published(self) -> Self:
        outputs = self.outputs
        if outputs and not any(section.enabled for section in outputs.values()):
            *others, last = (f"{name}.enabled" for name in outputs)
            found = f"found false here and in {join_or(others)}" if others else "found false"
            raise validation_error(f"{found}; expected true in at least one of them", *last.split("."))
        return self


def settings_model(outputs: Mapping[str, type[OutputSettings]]) -> type[Settings]:
    """Return the model of whole configurations with these outputs, by the name of their section."""
    sections: dict[str, Any] = {
        name: (section, Field(default=section(), description=f"The output {name}."))
        for name, section in outputs.items()
    }
    return create_model("Settings", __base__=Settings, __doc__="The whole configuration.", **sections)
