"""Takes: recordings of a gateway's messages as LCM event logs, written and read.

``from gateway.takes import open_take`` is the beginning of an analysis: see its docstring.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gateway.takes.series import ParametersEntry, Series
    from gateway.takes.take import Take, TakeSource, open_take

__all__ = ["ParametersEntry", "Series", "Take", "TakeSource", "open_take"]


def __getattr__(name: str) -> Any:
    """Import the library when it is used: a gateway that records does not need it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from gateway.takes import series, take  # noqa: PLC0415 - see above

    return getattr(take, name, None) or getattr(series, name)
