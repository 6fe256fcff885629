"""Helpers for tests of settings: a complete source, and the mistakes that a section finds."""

import pytest
from pydantic import ValidationError

from gateway.config.section import Section


def mistakes(model: type[Section], value: object) -> list[tuple[str, str]]:
    """Return the location and the text of each mistake that ``model`` finds in ``value``."""
    with pytest.raises(ValidationError) as caught:
        model.model_validate(value)
    return [(".".join(map(str, item["loc"])), item["msg"]) for item in caught.value.errors()]


def source(**keys: object) -> dict[str, object]:
    return {"name": "lab", "host": "192.0.2.20", **keys}
