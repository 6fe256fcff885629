"""Sentences about sources that no gateway serves, for every output."""

from collections.abc import Collection

_MAX_NAMED = 20


def missing_source(wanted: Collection[str], served: Collection[str]) -> str:
    """Return that one of the ``wanted`` sources is not served, and which are; "" if all are."""
    missing = [source for source in wanted if source not in served]
    if not missing:
        return ""
    names = sorted(served)
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return f"no gateway serves source {missing[0]!r}; sources found: {', '.join(names[:_MAX_NAMED])}{more}"
