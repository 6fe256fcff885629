"""The section ``lcm`` of the configuration."""

import os
from typing import Annotated, Final
from urllib.parse import urlsplit, urlunsplit

from pydantic import AfterValidator, Field

from gateway.config.section import Effective, expects, join_or
from gateway.config.settings import OutputSettings
from gateway.config.values import MaxRates, Switch

DEFAULT_LCM_URL: Final = "udpm://239.255.76.67:7667?ttl=0"
"""LCM's own default, which stays on this host."""

LCM_PROVIDERS: Final = ("udpm", "mpudpm", "memq", "tcpq", "file")
"""The URL schemes that the lcm package knows."""


def _lcm_url(text: str) -> str:
    provider, separator, rest = text.partition("://")
    if provider not in LCM_PROVIDERS or not separator or not text.isprintable() or " " in text:
        raise ValueError
    if "@" in rest.partition("/")[0]:  # LCM knows no password, and says the whole URL in the log
        raise ValueError
    return text


ChannelPrefix = Annotated[
    str,
    Field(pattern=r"^[A-Za-z0-9_]{1,16}$"),
    expects("1 to 16 of the letters A to Z and a to z, digits and '_'"),
]
LcmUrl = Annotated[
    str,
    AfterValidator(_lcm_url),
    expects(
        f"a URL that begins with {join_or(f'{provider}://' for provider in LCM_PROVIDERS)}, "
        "without a user name"
    ),
]


def effective_lcm_url(url: str | None) -> str:
    """Return ``url``, else the environment's LCM_DEFAULT_URL, else DEFAULT_LCM_URL.

    The environment's is not checked here: LCM itself says what it cannot use.
    """
    return url or os.environ.get("LCM_DEFAULT_URL") or DEFAULT_LCM_URL


def lcm_queries_url(url: str) -> str:
    """Return where requests go unless told otherwise: to the next port, where a URL is multicast's.

    Whoever listens on a multicast URL is sent all that anybody sends there, the gateway its own messages
    too: that would double what LCM costs it, and more. Others pass on only what is subscribed to.
    """
    parts = urlsplit(url)
    try:
        port = parts.port or 7667
    except ValueError:  # LCM itself refuses it
        return url
    if parts.scheme != "udpm":
        return url
    host = parts.hostname or "239.255.76.67"
    other = port + 1 if port < 65535 else port - 1
    return urlunsplit(parts._replace(netloc=f"{host}:{other}"))


class LcmSettings(OutputSettings):
    """How data and answers go to LCM."""

    enabled: Switch = True
    """Whether anything is published, and answered, on LCM."""

    prefix: ChannelPrefix = "MOCAP"
    """What all channels begin with."""

    url: LcmUrl | None = None
    """Where to publish; null is the environment's LCM_DEFAULT_URL, else LCM's own, on this host only."""

    queries_url: LcmUrl | None = None
    """Where requests are awaited and answered; null is the port after that of url."""

    max_rate_hz: MaxRates = {}  # noqa: RUF012 - pydantic copies defaults
    """The highest rate of each component named; frames beyond it are left out, evenly."""

    tool_poses: Switch = False
    """Whether each tool's pose is published on a channel of its own."""

    @property
    def effective(self) -> dict[str, Effective]:
        """See Section."""
        url = {} if self.url is not None else {"url": Effective(self.effective_url, ("LCM_DEFAULT_URL",))}
        return {**url, "queries_url": Effective(self.effective_queries_url)}

    @property
    def effective_url(self) -> str:
        """What ``effective_lcm_url`` makes of ``url``."""
        return effective_lcm_url(self.url)

    @property
    def effective_queries_url(self) -> str:
        """``queries_url``, else what belongs to ``effective_url``."""
        return self.queries_url or lcm_queries_url(self.effective_url)
