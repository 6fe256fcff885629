"""The section ``lsl`` of the configuration, and the output in the registry."""

from collections.abc import Sequence
from typing import Annotated, Final

from pydantic import AfterValidator, Field

from gateway.config.section import expects
from gateway.config.settings import OutputSettings, SourceSettings
from gateway.config.values import Switch
from gateway.outputs.kind import OutputKind, imported_late
from gateway.outputs.open_ports import Access, OpenPort


def _absolute_path(text: str) -> str:
    if not text.startswith("/") or not text.isprintable():
        raise ValueError
    return text


ConfigFile = Annotated[
    str, AfterValidator(_absolute_path), expects("the absolute path of a file lsl_api.cfg, or null")
]
BufferSeconds = Annotated[
    int, Field(strict=True, ge=1, le=360), expects("a whole number of seconds from 1 to 360")
]


class LslSettings(OutputSettings):
    """The settings of the output for Lab Streaming Layer."""

    enabled: Switch = False
    """Whether to offer one LSL stream per source and component. It needs the extra `lsl`."""

    config: ConfigFile | None = None
    """A file lsl_api.cfg for liblsl. null means where liblsl looks for one, else its defaults."""

    buffer_s: BufferSeconds = 30
    """How many seconds of samples liblsl keeps for a receiver that is too slow; it loses older ones."""


_SEARCH_PORT: Final = 16571
"""liblsl's default. A file lsl_api.cfg can have another one."""


def _open_ports(_settings: LslSettings, _sources: Sequence[SourceSettings]) -> list[OpenPort]:
    remedy = "LSL listens everywhere. Keep others out with a firewall: docs/how-to/lsl.md#who-can-reach-it."
    streams = "receivers read streams: a port of each stream, from 16572 on or any free one"
    return [
        OpenPort("udp", "::", _SEARCH_PORT, Access.READ, "receivers search for streams", remedy),
        OpenPort("tcp", "::", 0, Access.READ, streams, remedy),
        OpenPort("udp", "::", 0, Access.READ, "receivers compare clocks", remedy),
    ]


LSL: Final = OutputKind(
    name="lsl",
    settings=LslSettings,
    create=imported_late("gateway.outputs.adapters.lsl.output:LslOutput"),
    checks=("opens", "found", "gateway"),
    run_checks=imported_late("gateway.outputs.adapters.lsl.checks:check_lsl"),
    open_ports=_open_ports,
)
"""Its ports are open on every network interface."""
