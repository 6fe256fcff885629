"""Checks of the arguments of ``live``: a wrong name would wait for ever for data that never come."""

import math
from collections.abc import Sequence
from typing import Any

from gateway.config.section import validated
from gateway.config.values import ChannelPrefix, SourceName
from gateway.errors import ConfigError, SelectionError
from gateway.outputs.zenoh.settings import KeyPrefix


def check_arguments(sources: Sequence[object], last_s: object, prefix: str | None, *, is_lcm: bool) -> None:
    """Check names, seconds and a prefix. Raises SelectionError, which says what is expected."""
    if not all(isinstance(source, str) for source in sources):
        raise SelectionError("name each source as an argument of its own: live('lab', 'stage')")
    for source in sources:
        _check(SourceName, source, "no source can be called so")
    if prefix:  # "" is the default
        _check(ChannelPrefix if is_lcm else KeyPrefix, prefix, "the prefix cannot be used")
    if last_s is not None and not (isinstance(last_s, int | float) and 0 <= last_s < math.inf):
        raise SelectionError(f"last_s is {last_s!r}; expected seconds, such as last_s=5")


def _check(kind: Any, value: object, problem: str) -> None:
    try:
        validated(kind, value)
    except ConfigError as error:
        raise SelectionError(f"{problem}: {error}") from None
