"""Whole configurations for tests, with a section for every output, and the mistakes that a section finds."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pytest
import yaml
from pydantic import ValidationError

from gateway.config import loading
from gateway.config.section import Section
from gateway.config.settings import MetricsSettings, ReconnectSettings, SourceSettings
from gateway.outputs.registry import settings_type

MODEL: Final[Any] = settings_type()


def make_settings(**values: Any) -> Any:
    """Return settings. Their type is Any, because type checkers do not know the sections of the outputs."""
    return MODEL(**values)


def local_source(port: int, name: str = "lab", **settings: Any) -> SourceSettings:
    """Return a source whose server listens on ``port`` of this host; it reconnects at once."""
    reconnect = ReconnectSettings(first_delay_s=0.01, max_delay_s=0.05)
    defaults: dict[str, Any] = {"name": name, "host": "127.0.0.1", "port": port, "reconnect": reconnect}
    return SourceSettings(**(defaults | settings))


def local_settings(*sources: SourceSettings, **sections: Any) -> Any:
    """Return settings with these sources and sections, and without metrics."""
    return make_settings(**{"sources": sources, "metrics": MetricsSettings(enabled=False), **sections})


def write_config(file: Path, port: int, *, source: Mapping[str, Any] | None = None, **sections: Any) -> Path:
    """Write a configuration with the source "lab" on ``port`` of this host; return its path.

    ``source`` has further keys of the source. Zenoh, LCM and metrics are off except for ``sections``, which
    must have an output.
    """
    configuration = {
        "sources": [{"name": "lab", "host": "127.0.0.1", "port": port, **(source or {})}],
        **{name: {"enabled": False} for name in ("zenoh", "lcm", "metrics")},
    }
    file.write_text(yaml.safe_dump(configuration | sections))
    return file


def read(path: Path | None, environ: Mapping[str, str] = os.environ) -> Any:
    return loading.read(path, MODEL, environ)


def read_server(host: str, port: int, environ: Mapping[str, str] = os.environ) -> Any:
    return loading.read_server(host, port, MODEL, environ)


def load(path: Path | None, environ: Mapping[str, str] = os.environ) -> Any:
    """Return the settings from a file and the environment."""
    return read(path, environ).settings


def mistakes(model: type[Section], value: object) -> list[tuple[str, str]]:
    """Return the location and the text of each mistake that ``model`` finds in ``value``."""
    with pytest.raises(ValidationError) as caught:
        model.model_validate(value)
    return [(".".join(map(str, item["loc"])), item["msg"]) for item in caught.value.errors()]


def source(**keys: object) -> dict[str, object]:
    return {"name": "lab", "host": "192.0.2.20", **keys}
