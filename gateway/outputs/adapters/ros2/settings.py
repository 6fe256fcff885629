"""The section ``ros2`` of the configuration, and the output in the registry."""

import re
from typing import Annotated, Final, Literal, Self, TypeAlias

from pydantic import AfterValidator, Field, TypeAdapter, WrapValidator, model_validator

from gateway.config.section import Section, expects, validation_errors
from gateway.config.settings import OutputSettings
from gateway.config.values import (
    FrameId,
    Metres3,
    QuaternionXyzw,
    RollPitchYaw,
    SourceName,
    Switch,
    check_one_rotation,
)
from gateway.messages.ros2.names import DEFAULT_NAMESPACE, MAX_PART_CHARS, PLATE_NAME
from gateway.messages.topics import MAX_LABEL_LENGTH
from gateway.outputs.kind import OutputKind, imported_late

MAX_NAMESPACE_CHARS: Final = 100

_PART: Final = "[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*"

NAMESPACE: Final = re.compile(f"{_PART}(/{_PART})*")
"""What a namespace may be, without slashes at both ends."""

DEFAULT_ROUTER: Final = "tcp/127.0.0.1:7447"
"""Where the router of rmw_zenoh listens."""

_ENDPOINT: Final = re.compile(r"(tcp|tls|quic|udp|ws)/(\[[0-9A-Fa-f:.]+\]|[\w.-]{1,253}):(\d{1,5})", re.ASCII)


def _namespace(text: str) -> str:
    name = text.removeprefix("/")
    if name and (len(name) > MAX_NAMESPACE_CHARS or not NAMESPACE.fullmatch(name)):
        raise ValueError
    return name


def _tool_name(text: str) -> str:
    if len(text) > MAX_PART_CHARS or not re.fullmatch(_PART, text) or PLATE_NAME.fullmatch(text):
        raise ValueError
    return text


def _endpoint(text: str) -> str:
    match = _ENDPOINT.fullmatch(text)
    if match is None or not 1 <= int(match[3]) <= 65535:
        raise ValueError
    return text


Namespace = Annotated[
    str,
    AfterValidator(_namespace),
    expects(
        "a ROS namespace such as mocap or site/mocap: letters, digits and single '_', each part beginning "
        f"with a letter, {MAX_NAMESPACE_CHARS} characters at most; '' for none"
    ),
]
RouterEndpoint = Annotated[
    str, AfterValidator(_endpoint), expects(f"the endpoint of a Zenoh router, such as {DEFAULT_ROUTER}")
]
Distribution = Annotated[
    Literal["humble", "jazzy", "kilted", "lyrical", "rolling"],
    expects("humble, jazzy, kilted, lyrical or rolling; for a later one rolling"),
]
Durability = Annotated[
    Literal["volatile"], expects("volatile; transient_local would keep old poses for nodes that start later")
]


ToolName = Annotated[
    str,
    AfterValidator(_tool_name),
    expects(
        "a name that ROS accepts in topics: letters, digits and single '_', with a letter at the beginning, "
        f"{MAX_PART_CHARS} characters at most; not one of a force plate, such as force_1"
    ),
]


class OffsetSettings(Section):
    """Where the published frame of a tool is in the tool's own frame: first moved, then rotated."""

    translation_m: Metres3 = (0.0, 0.0, 0.0)
    """Its origin, in metres along the axes of the tool."""

    rotation_xyzw: QuaternionXyzw | None = None
    """Its rotation, as a quaternion."""

    rotation_deg: RollPitchYaw = RollPitchYaw()
    """Its rotation, as angles. Only one of the two can be given."""

    @model_validator(mode="after")
    def _check_rotation(self) -> Self:
        check_one_rotation(self.rotation_xyzw, self.rotation_deg)
        return self


class ToolSettings(Section):
    """What a tool is called on ROS 2, if that is not its label, and which frame of it is published."""

    name: ToolName | None = None
    """Its name in topics, for example /mocap/lab/hand/pose. null means its label."""

    child_frame: FrameId | None = None
    """Its frame on /tf. null means SOURCE/NAME, for example lab/hand."""

    offset: OffsetSettings = OffsetSettings()
    """Where the published frame is in the tool's own frame."""


_TOOL_SETTINGS: Final = TypeAdapter(ToolSettings)

Tool: TypeAlias = ToolSettings | Literal[False]
"""In YAML: a mapping, or false for a tool without topics and transforms."""

ToolLabel = Annotated[
    str,
    Field(min_length=1, max_length=MAX_LABEL_LENGTH),
    expects(f"the label of a tool, of 1 to {MAX_LABEL_LENGTH} characters"),
]
_EXAMPLE: Final = "{Tool 1: {name: hand}, Tool 2: false}"

# As a mere union, a mistake in a mapping would also be reported as not being false.
Tools = Annotated[
    dict[
        ToolLabel,
        Annotated[
            Tool,
            WrapValidator(
                lambda value, _: value if value is False else _TOOL_SETTINGS.validate_python(value)
            ),
        ],
    ],
    expects(f"tools by label, as in {_EXAMPLE}"),
]
SourceTools = Annotated[
    dict[SourceName, Tools], expects(f"tools by source and label, as in {{lab: {_EXAMPLE}}}")
]


class Ros2Settings(OutputSettings):
    """The settings of the output for ROS 2."""

    enabled: Switch = False
    """Whether to publish for ROS 2, as a node does that uses rmw_zenoh."""

    domain_id: Annotated[int, Field(strict=True, ge=0, le=232), expects("a whole number from 0 to 232")] = 0
    """The domain: ROS_DOMAIN_ID of the computers with ROS."""

    namespace: Namespace = DEFAULT_NAMESPACE
    """The namespace of the node and its topics, for example /mocap/lab/markers."""

    connect: RouterEndpoint = DEFAULT_ROUTER
    """The Zenoh router that the nodes use (`ros2 run rmw_zenoh_cpp rmw_zenohd`)."""

    distribution: Distribution = "jazzy"
    """The distribution of ROS 2. All since jazzy are alike; humble has no type hashes."""

    reliability: Annotated[Literal["best_effort", "reliable"], expects("best_effort or reliable")] = (
        "best_effort"
    )
    """The reliability that the publishers announce."""

    durability: Durability = "volatile"
    """The durability that the publishers announce. There is only this one: old poses would mislead robots."""

    depth: Annotated[int, Field(strict=True, ge=1, le=10_000), expects("a whole number from 1 to 10000")] = 10
    """The depth of the history that the publishers announce (keep last)."""

    tf: Switch = True
    """Whether to publish the poses of tools on /tf, too. /tf_static is published in any case."""

    tools: SourceTools = {}  # noqa: RUF012 - pydantic copies defaults
    """Which tools are called otherwise than their labels, or are left out: {SOURCE: {LABEL: TOOL}}."""

    @model_validator(mode="after")
    def _check_names_of_tools(self) -> Self:
        mistakes: list[tuple[str, tuple[str | int, ...]]] = []
        frames: dict[str | None, str] = {}  # of all sources, because they share /tf
        for source, tools in self.tools.items():
            names: dict[str | None, str] = {}
            for label, tool in tools.items():
                if tool is False:
                    continue
                if tool.child_frame and tool.child_frame.partition("/")[0] in self.tools:
                    text = "expected one that does not begin with the name of a source, as others do"
                    mistakes.append(
                        (f"found {tool.child_frame!r}; {text}", ("tools", source, label, "child_frame"))
                    )
                place = f"tools.{source}.{label}"
                for key, value, owners in (
                    ("name", tool.name, names),
                    ("child_frame", tool.child_frame, frames),
                ):
                    if value is not None and (owner := owners.setdefault(value, place)) != place:
                        text = f"found {value!r}, which {owner} has too; expected another one for each tool"
                        mistakes.append((text, ("tools", source, label, key)))
        if mistakes:
            raise validation_errors(mistakes)
        return self


ROS2: Final = OutputKind(
    name="ros2",
    settings=Ros2Settings,
    create=imported_late("gateway.outputs.adapters.ros2.output:Ros2Output"),
    checks=("router", "gateway", "nodes", "types"),
    run_checks=imported_late("gateway.outputs.adapters.ros2.checks:check_ros2"),
    leaves_host=imported_late("gateway.outputs.adapters.ros2.checks:leaves_host"),
)
