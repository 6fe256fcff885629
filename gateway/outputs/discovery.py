"""Finding gateways on any output: how long it may take, and what to say of sources that none serves."""

from collections.abc import Collection
from typing import Final

DISCOVERY_S: Final = 2.5
"""How long it may take to find a gateway: Zenoh needs time to connect; LCM carries one status a second."""

_MAX_NAMED: Final = 20


def missing_source(wanted: Collection[str], served: Collection[str]) -> str:
    """Return which of the ``wanted`` sources is not served, and which sources are; "" if all are."""
    missing = [source for source in wanted if source not in served]
    if not missing:
        return ""
    names = sorted(served)
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return f"no gateway serves source {missing[0]!r}; sources found: {', '.join(names[:_MAX_NAMED])}{more}"
