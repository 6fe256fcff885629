"""Whole configurations for tests, with a section for every output of the registry."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from gateway.config import loading
from gateway.outputs.registry import settings_type

MODEL: Final[Any] = settings_type()


def make_settings(**values: Any) -> Any:
    """Return settings. Their type is Any, because type checkers do not know the sections of the outputs."""
    return MODEL(**values)


def read(path: Path | None, environ: Mapping[str, str] = os.environ) -> Any:
    return loading.read(path, MODEL, environ)


def read_server(host: str, port: int, environ: Mapping[str, str] = os.environ) -> Any:
    return loading.read_server(host, port, MODEL, environ)


def load(path: Path | None, environ: Mapping[str, str] = os.environ) -> Any:
    """Return the settings from a file and the environment."""
    return read(path, environ).settings
