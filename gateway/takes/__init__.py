"""Takes: recordings of a gateway's messages as LCM event logs, written and read.

``from gateway.takes import open_take`` is the beginning of an analysis: see its docstring.

In ``files``:

- Writing: ``take_writer`` is a take that is being written. ``writer_thread`` has one thread for all files and
  a queue with a limit in front of it. ``description`` says what is at the beginning and at the end of a file;
  ``new_file`` gives a file its name when it is complete. The output ``takes`` and the command ``record`` are
  built on these.
- Reading: ``event_log`` reads events one after the other and goes on behind damage. ``reader`` adds what each
  of them is: the source, the component or kind of message.
- Arrays: ``take``, ``series`` and ``series_data`` decode a take into numpy arrays; ``component_rows`` does so
  for many messages at once, and ``parameters_history`` says which parameters describe them. ``joined`` makes
  one series of several, ``resampling`` changes the rate, and ``tables`` makes tables for pandas and xarray.
- Statistics: ``statistics``, ``component_statistics`` and ``parameters_statistics`` describe a take in one
  pass with bounded memory, with what interrupts it.

``export`` converts takes for other programs. What records takes is elsewhere: ``gateway.client.recorder`` as
a subscriber, and the output ``gateway.outputs.takes`` in the gateway itself. ``gateway.tools.replay``
publishes a take again.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gateway.takes.files.parameters_history import ParametersEntry
    from gateway.takes.files.series import Series
    from gateway.takes.files.take import Take, TakeSource, open_take

__all__ = ["ParametersEntry", "Series", "Take", "TakeSource", "open_take"]


def __getattr__(name: str) -> Any:
    """Import the library when it is used: a gateway that records does not need it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from gateway.takes.files import series, take  # noqa: PLC0415 - see above

    return getattr(take, name, None) or getattr(series, name)
