"""Options that several commands share.

This module imports nothing that takes long, so that ``COMMAND --help`` is quick: the checks of values import
what they need.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from gateway.cli.completion import one_of, source_names
from gateway.config.environment import VARIABLE_PREFIX
from gateway.config.files import DEFAULT_CONFIG
from gateway.config.words import describe, join_or
from gateway.errors import QueryError
from gateway.logs.log_format import LogFormat, LogLevel
from gateway.messages.topics import MAX_LABEL_LENGTH
from gateway.rtc3d.component_types import COMPONENTS_BY_KEY

if TYPE_CHECKING:
    from gateway.takes.files.description import TakeDetails

_RECORDED: Final = (*COMPONENTS_BY_KEY, "status", "clock", "parameters")
"""The values of ``--component`` for commands that read or write recordings."""

_COMPONENTS: Final = (*_RECORDED, "c3d")
_POSE: Final = "6d/"

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "-c",
        metavar="FILE",
        help=f"The configuration file (YAML); the default is {DEFAULT_CONFIG}. Environment variables "
        f"{VARIABLE_PREFIX}… override it or replace it.",
    ),
]
ServerOption = Annotated[
    str | None,
    typer.Option(
        metavar="HOST[:PORT]",
        help="HOST[:PORT] of an RT server, for a quick try without a configuration file.",
    ),
]

LogLevelOption = Annotated[
    LogLevel,
    typer.Option(
        case_sensitive=False, metavar="LEVEL", help="The lowest level to log: debug, info, warning or error."
    ),
]
VerboseOption = Annotated[
    bool, typer.Option("--verbose", "-v", help="Log everything; short for --log-level debug.")
]
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", help="Log problems only; short for --log-level warning.")
]
NoProgressOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress, only problems.")]
LogFormatOption = Annotated[
    LogFormat,
    typer.Option(
        case_sensitive=False,
        metavar="FORMAT",
        help="text, json or journal; auto means journal under systemd, otherwise text.",
    ),
]

MarkersOption = Annotated[int, typer.Option(min=0, max=10_000, help="Markers in the synthetic scene.")]
ToolsOption = Annotated[int, typer.Option(min=0, max=1_000, help="6D tools in the synthetic scene.")]
AnalogOption = Annotated[int, typer.Option(min=0, max=10_000, help="Analog channels in the synthetic scene.")]
PlatesOption = Annotated[int, typer.Option(min=0, max=100, help="Force plates in the synthetic scene.")]
RateOption = Annotated[float, typer.Option(min=0.1, max=10_000, help="3D and 6D frames per second, in Hz.")]
AnalogRateOption = Annotated[
    float, typer.Option(min=0.1, max=100_000, help="Analog and force samples per second, in Hz.")
]
C3dOption = Annotated[
    Path | None, typer.Option("--c3d", help="Play this C3D file instead of a synthetic scene.")
]


def _host() -> Any:
    from gateway.config.values import Host

    return Host


def _source_name() -> Any:
    from gateway.config.values import SourceName

    return SourceName


def _key_prefix() -> Any:
    from gateway.outputs.zenoh.settings import KeyPrefix

    return KeyPrefix


def _lcm_url() -> Any:
    from gateway.outputs.lcm.settings import LcmUrl

    return LcmUrl


def _checked(kind: Callable[[], Any]) -> Callable[[str | None], str | None]:
    """Return a callback for an option whose value must be valid as a type of the configuration."""

    def check(text: str | None) -> str | None:
        if text is None:
            return None
        from pydantic import TypeAdapter, ValidationError

        try:
            return str(TypeAdapter(kind()).validate_python(text))
        except ValidationError as error:
            raise typer.BadParameter(error.errors(include_url=False)[0]["msg"]) from None

    return check


checked_host = _checked(_host)
"""Checks that an option is a host name or an IP address."""

checked_key_prefix = _checked(_key_prefix)
"""Checks that an option is the beginning of a Zenoh key."""

_checked_source = _checked(_source_name)
_checked_lcm_url = _checked(_lcm_url)


def _one_of(components: Sequence[str]) -> Callable[[str | None], str | None]:
    def check(text: str | None) -> str | None:
        if text is not None and text not in components:
            raise typer.BadParameter(f"found {describe(text)}; expected {join_or(components)}")
        return text

    return check


def _checked_component(text: str | None) -> str | None:
    label = (text or "").removeprefix(_POSE)
    if label != text and text is not None and 0 < len(label) <= MAX_LABEL_LENGTH and label.isprintable():
        return text
    return _one_of(_COMPONENTS)(text)


def _checked_each(
    check: Callable[[str | None], str | None],
) -> Callable[[list[str] | None], list[str] | None]:
    """Return a callback for an option that can be repeated."""

    def check_each(texts: list[str] | None) -> list[str] | None:
        for text in texts or ():
            check(text)
        return texts

    return check_each


def check_exists(option: str, path: Path | None) -> None:
    """Raise BadParameter if there is no file of this name. Not a callback: parsing must not read the disk."""
    if path is not None and not path.exists():
        raise typer.BadParameter(f"{option}: {path} does not exist")


def checked_take_name(text: str | None) -> str | None:
    """Check that an argument can be the name of a take."""
    if text is None:
        return None
    from gateway.takes.files.new_file import check_name

    try:
        check_name(text)
    except QueryError as error:
        raise typer.BadParameter(str(error)) from None
    return text


def _checked_endpoint(text: str | None) -> str | None:
    if text is not None and not (text.isprintable() and re.fullmatch(r"[\w-]+/.{1,1000}", text)):
        raise typer.BadParameter(f"found {describe(text)}; expected an endpoint such as tcp/192.0.2.5:7447")
    return text


SubjectOption = Annotated[str | None, typer.Option(help="Who is recorded, such as S01.")]
SessionOption = Annotated[str | None, typer.Option(help="The session of the subject, such as baseline.")]
NoteOption = Annotated[str | None, typer.Option(help="Anything else that belongs to the recording.")]

SourceOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_source,
        autocompletion=source_names,
        help="Only this source; the default is all sources.",
    ),
]
ComponentOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_component,
        autocompletion=one_of(_COMPONENTS),
        help=f"Only this: {join_or(_COMPONENTS)}; 6d/LABEL for the pose of one tool, 6d/* for each tool's.",
    ),
]
SourcesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--source",
        callback=_checked_each(_checked_source),
        autocompletion=source_names,
        help="Only this source; can be repeated. The default is all sources.",
    ),
]
ComponentsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--component",
        callback=_checked_each(_one_of(_RECORDED)),
        autocompletion=one_of(_RECORDED),
        help=f"Only this: {join_or(_RECORDED)}; can be repeated.",
    ),
]
ConnectOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_endpoint,
        help="Zenoh endpoint of the gateway or router, for example tcp/192.0.2.5:7447.",
    ),
]
ListenOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_endpoint,
        help="Zenoh endpoint to listen on, for example tcp/127.0.0.1:7448.",
    ),
]
ZenohConfigOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Zenoh's configuration (JSON5) for this command's session: endpoints, certificates, password.",
    ),
]
UrlOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_lcm_url, help="LCM URL; the default is $LCM_DEFAULT_URL, else LCM's default URL."
    ),
]
PrefixOption = Annotated[
    str | None,
    typer.Option(
        callback=checked_key_prefix,
        help="The gateway's prefix; the default is mocap on Zenoh, MOCAP on LCM.",
    ),
]
QueriesUrlOption = Annotated[
    str | None,
    typer.Option(
        metavar="URL",
        callback=_checked_lcm_url,
        help="LCM URL of requests and replies: the gateway's lcm.queries_url.",
    ),
]


def check_transport(
    *,
    lcm: bool,
    connect: str | None,
    zenoh_config: Path | None,
    url: str | None,
    queries_url: str | None = None,
) -> None:
    """Raise BadParameter if there are options for Zenoh with ``--lcm``, or options for LCM without it."""
    if lcm and (connect is not None or zenoh_config is not None):
        raise typer.BadParameter("--connect and --zenoh-config are for Zenoh, not for --lcm")
    for name, value in (("--url", url), ("--queries-url", queries_url)):
        if value is not None and not lcm:
            raise typer.BadParameter(f"{name} is for LCM; add --lcm")


def checked_details(subject: str | None, session: str | None, note: str | None) -> "TakeDetails":
    """Return who and what a recording is about. Raises BadParameter."""
    from gateway.takes.files.description import TakeDetails

    try:
        return TakeDetails(subject or "", session or "", note or "").checked()
    except QueryError as error:
        raise typer.BadParameter(str(error)) from None


def chosen_log_level(level: LogLevel, *, verbose: bool, quiet: bool) -> LogLevel:
    """Return the level to log; raises BadParameter if the three options contradict each other."""
    if verbose + quiet + (level is not LogLevel.INFO) > 1:
        raise typer.BadParameter("give only one of --log-level, --verbose and --quiet")
    return LogLevel.DEBUG if verbose else LogLevel.WARNING if quiet else level
