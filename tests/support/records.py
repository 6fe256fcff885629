"""What was logged, without the sentences: tests check levels, loggers, kinds, and the values in messages."""

import logging
from typing import NamedTuple

import pytest


class Logged(NamedTuple):
    """A record. ``kind`` is that of an event, or the cause of a loss; ``args`` are the message's values."""

    level: str
    logger: str
    kind: str
    args: tuple[object, ...]


def logged(caplog: pytest.LogCaptureFixture, level: int = logging.WARNING) -> list[Logged]:
    """Return the records of at least ``level`` so far."""
    return [
        Logged(record.levelname, record.name, getattr(record, "kind", ""), _args(record))
        for record in caplog.records
        if record.levelno >= level
    ]


def kinds(caplog: pytest.LogCaptureFixture, level: int = logging.WARNING) -> list[tuple[str, str]]:
    """Return the level and the kind of the records of at least ``level`` so far."""
    return [(record.level, record.kind) for record in logged(caplog, level)]


def levels(caplog: pytest.LogCaptureFixture, level: int = logging.WARNING) -> list[str]:
    """Return the levels of the records of at least ``level`` so far."""
    return [record.level for record in logged(caplog, level)]


def _args(record: logging.LogRecord) -> tuple[object, ...]:
    if record.args is None:
        return ()
    return record.args if isinstance(record.args, tuple) else (record.args,)
