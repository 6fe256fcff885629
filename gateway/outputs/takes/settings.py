"""The section ``takes`` of the configuration, and the output in the registry."""

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator
from typing_extensions import override

from gateway.config.files import folder_of
from gateway.config.section import Effective, expects, validation_error
from gateway.config.settings import OutputSettings, default_folder
from gateway.config.values import AbsoluteDirectory, ChannelPrefix, Components, Switch
from gateway.messages.topics import DEFAULT_LCM_PREFIX
from gateway.outputs.kind import OutputKind, imported_late
from gateway.rtc3d.components import WIRE_ORDER

MAX_KEEP_S: Final = 3600.0

FolderBytes = Annotated[
    int,
    Field(strict=True, ge=1024 * 1024, le=1 << 60),
    expects("a whole number of bytes from 1048576 (1 MiB)"),
]
Days = Annotated[
    float,
    Field(strict=True, gt=0, le=36_500, allow_inf_nan=False),
    expects("a number of days above 0, or null for no limit"),
]
KeepSeconds = Annotated[
    float,
    Field(strict=True, ge=0, le=MAX_KEEP_S, allow_inf_nan=False),
    expects(f"0 for off, or a number of seconds up to {MAX_KEEP_S:g}"),
]


Follow = Annotated[
    Literal["none", "recording", "measurement", "events"],
    expects("none, recording, measurement or events"),
]
EventId = Annotated[
    int, Field(strict=True, ge=0, le=0xFFFF_FFFF), expects("a whole number from 0 to 4294967295, or null")
]


class TakesSettings(OutputSettings):
    """The settings of the output that records takes."""

    enabled: Switch = False
    """Whether takes can be recorded, started and stopped by peers (see `remote_control` of the sources)."""

    directory: AbsoluteDirectory | None = None
    """The folder. null means takes in the state directory of the service, or of the user without systemd."""

    prefix: ChannelPrefix = DEFAULT_LCM_PREFIX
    """The beginning of all channels in the files, as on LCM."""

    components: Components = WIRE_ORDER
    """The components to record: [all], or a list. Status, clock and parameters are always recorded."""

    tool_poses: Switch = False
    """Whether to record the pose of each tool on its own channel, too."""

    max_bytes: FolderBytes = 100 * 1024 * 1024 * 1024
    """The maximum size of the folder, over all sources. The oldest takes are deleted first."""

    max_age_days: Days | None = None
    """Older takes are deleted. null means no limit."""

    keep_last_s: KeepSeconds = 0.0
    """How many of the last seconds to keep always, so that they can be saved as a take. 0 means off."""

    follow: Follow = "none"
    """What starts and stops takes besides peers: recordings or measurements of the server, or its events."""

    start_event_id: EventId | None = None
    """With `follow: events`: the id of the event that starts a take."""

    stop_event_id: EventId | None = None
    """With `follow: events`: the id of the event that stops the take. It can be the same id."""

    @model_validator(mode="after")
    def _check_event_ids(self) -> Self:
        if self.follow == "events":
            for key in ("start_event_id", "stop_event_id"):
                if getattr(self, key) is None:
                    raise validation_error("found nothing; expected a number with follow: events", key)
        return self

    @property
    @override
    def effective(self) -> dict[str, Effective]:
        return default_folder(self.directory, "takes")

    @property
    def effective_directory(self) -> Path:
        """``directory``, or the default folder if it is None."""
        return folder_of(self.directory, "takes")


TAKES: Final = OutputKind(
    name="takes",
    settings=TakesSettings,
    create=imported_late("gateway.outputs.takes.output:TakesOutput"),
    checks=("folder", "space", "links"),
    run_checks=imported_late("gateway.outputs.takes.checks:check_takes"),
    commands=("take",),
    leaves_host=lambda _settings: False,
)
