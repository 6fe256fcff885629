"""The section ``lcm`` of the configuration, and the output in the registry."""

import ipaddress
import os
import re
from typing import Annotated, Final
from urllib.parse import urlsplit, urlunsplit

from pydantic import AfterValidator, TypeAdapter
from typing_extensions import override

from gateway.config.section import Effective, expects, validation_error
from gateway.config.settings import OutputSettings
from gateway.config.values import ByteLimit, ChannelPrefix, Host, MaxRates, QueryRate, Switch
from gateway.config.words import describe, join_or, spelling_hint
from gateway.messages.topics import DEFAULT_LCM_PREFIX
from gateway.outputs.kind import OutputKind, imported_late
from gateway.outputs.lcm.connection import DEFAULT_GROUP, DEFAULT_PORT, MULTICAST_SCHEMES

DEFAULT_LCM_URL: Final = f"udpm://{DEFAULT_GROUP}:{DEFAULT_PORT}?ttl=0"
"""LCM's own default, which stays on this host."""

LCM_SCHEMES: Final = ("udpm", "mpudpm", "memq", "tcpq", "file")
"""The URL schemes that the lcm package supports."""


_HOST: Final[TypeAdapter[str]] = TypeAdapter(Host)


def _lcm_url(text: str) -> str:
    scheme, separator, rest = text.partition("://")
    if scheme not in LCM_SCHEMES or not separator or not text.isprintable():
        raise ValueError
    if " " in text and scheme != "file":  # folders have spaces, addresses do not
        raise ValueError
    if len(text) > 1000:
        raise ValueError
    parts = urlsplit(text)  # raises ValueError
    if scheme == "tcpq" and parts.hostname:
        _HOST.validate_python(parts.hostname)  # raises ValidationError, a ValueError
    if "@" in rest.partition("/")[0]:  # LCM has no passwords, and logs the whole URL
        raise ValueError
    return text


_PARAMETERS: Final = {
    "udpm": ("ttl", "recv_buf_size", "transmit_only"),
    "mpudpm": ("ttl", "recv_buf_size", "nports"),
}
"""Those that LCM knows. It ignores others, so that a misspelt ttl leaves messages on this computer."""

_MAX_TTL: Final = 255
_MAX_BUFFER_BYTES: Final = 2**31 - 1


def _check_multicast(url: str) -> str:
    """Return a URL. Raises ValidationError for a multicast URL that LCM refuses, or takes for another one.

    LCM decodes no %, reads numbers that begin with 0 as octal, ignores what follows a #, and has defaults of
    host and port only if both are missing.
    """
    parts = urlsplit(url)
    if parts.scheme not in MULTICAST_SCHEMES:
        return url
    found = f"found {describe(url)}; expected"
    host, _, port = parts.netloc.partition(":")
    try:
        is_multicast = not parts.netloc or ipaddress.IPv4Address(host).is_multicast
    except ValueError:
        is_multicast = False
    if not is_multicast:
        raise validation_error(f"{found} a multicast address, 224.0.0.0 to 239.255.255.255, as the host")
    if parts.netloc and not _is_whole_number(port, 1, 65535):
        raise validation_error(f"{found} a port from 1 to 65535")
    if parts.fragment:
        raise validation_error(f"{found} no #, because LCM ignores what follows it")
    for pair in filter(None, parts.query.split("&")):
        name, _, value = pair.partition("=")
        known = _PARAMETERS[parts.scheme]
        if name not in known:
            hint = spelling_hint(name, known)
            raise validation_error(f"{found} only {join_or(known)} after the ?, not {name}{hint}")
        most = {"ttl": _MAX_TTL, "recv_buf_size": _MAX_BUFFER_BYTES}.get(name)
        if most is not None and not _is_whole_number(value, 0, most):
            raise validation_error(f"{found} a whole number from 0 to {most} as {name}")
    return url


def _is_whole_number(text: str, least: int, most: int) -> bool:
    """Return whether ``text`` is a number in this range, in digits of ASCII without a 0 in front."""
    return re.fullmatch("0|[1-9][0-9]{0,18}", text) is not None and least <= int(text) <= most


LcmUrl = Annotated[
    str,
    AfterValidator(_lcm_url),
    expects(
        f"a URL that begins with {join_or(f'{scheme}://' for scheme in LCM_SCHEMES)}, without a user name"
    ),
    AfterValidator(_check_multicast),
]


def effective_lcm_url(url: str | None) -> str:
    """Return ``url``, else $LCM_DEFAULT_URL, else DEFAULT_LCM_URL.

    The environment variable is not checked here: LCM itself reports a URL that it cannot use.
    """
    return url or os.environ.get("LCM_DEFAULT_URL") or DEFAULT_LCM_URL


def lcm_queries_url(url: str) -> str:
    """Return the default URL of requests: ``url``, with the next port if it is a multicast URL.

    A program that listens on a multicast URL receives everything that is sent there. On ``url`` itself, the
    gateway would receive its own messages, which more than doubles the CPU time for LCM. The other schemes
    deliver only messages on subscribed channels.
    """
    try:
        parts = urlsplit(url)
        port = parts.port or DEFAULT_PORT
    except ValueError:  # LCM itself rejects it
        return url
    if parts.scheme != "udpm":
        return url
    host = parts.hostname or DEFAULT_GROUP
    other = port + 1 if port < 65535 else port - 1
    return urlunsplit(parts._replace(netloc=f"{host}:{other}"))


class LcmSettings(OutputSettings):
    """The settings of the LCM output."""

    enabled: Switch = True
    """Whether to publish, and to answer requests, on LCM."""

    prefix: ChannelPrefix = DEFAULT_LCM_PREFIX
    """The beginning of all channels."""

    url: LcmUrl | None = None
    """Where to publish; null means $LCM_DEFAULT_URL, else LCM's default URL, which stays on this host."""

    queries: Switch = True
    """Whether to receive and answer requests; anyone whose datagrams reach this computer can send them."""

    queries_url: LcmUrl | None = None
    """The URL of requests and replies; null means url, with the next port if url begins with udpm."""

    max_rate_hz: MaxRates = {}  # noqa: RUF012 - pydantic copies defaults
    """The highest rate of each listed component, in Hz; further frames are left out at even intervals."""

    tool_poses: Switch = False
    """Whether to publish the pose of each tool on its own channel."""

    max_queries_per_s: QueryRate = 200.0
    """How many requests a second to answer. Beyond this limit or the next two, they get the error rate."""

    max_queries_per_source_per_s: QueryRate = 100.0
    """How many requests a second to answer about each source."""

    max_reply_bytes_per_s: ByteLimit = 4 * 1024 * 1024
    """How many bytes a second to send in replies, which every program on the network receives."""

    @property
    @override
    def effective(self) -> dict[str, Effective]:
        url = {} if self.url is not None else {"url": Effective(self.effective_url, ("LCM_DEFAULT_URL",))}
        return {**url, "queries_url": Effective(self.effective_queries_url)}

    @property
    def effective_url(self) -> str:
        """The URL in use: see ``effective_lcm_url``."""
        return effective_lcm_url(self.url)

    @property
    def effective_queries_url(self) -> str:
        """``queries_url``, else the default for ``effective_url``."""
        return self.queries_url or lcm_queries_url(self.effective_url)

    @property
    def has_own_queries_url(self) -> bool:
        """Whether requests and replies do not use ``effective_url``."""
        return self.effective_queries_url != self.effective_url


LCM: Final = OutputKind(
    name="lcm",
    settings=LcmSettings,
    create=imported_late("gateway.outputs.lcm.output:LcmOutput"),
    subscribe=imported_late("gateway.outputs.lcm.subscriber:subscribe"),
    checks=("route", "requests", "buffers"),
    run_checks=imported_late("gateway.outputs.lcm.checks:check_lcm"),
    leaves_host=imported_late("gateway.outputs.lcm.checks:leaves_host"),
    open_ports=imported_late("gateway.outputs.lcm.checks:open_ports"),
    demo=imported_late("gateway.outputs.lcm.subscriber:demo"),
)
