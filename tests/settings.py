"""What tests of the configuration share: a source that is complete, and the mistakes in a value."""

import pytest
from pydantic import ValidationError

from gateway.config.section import Section


def mistakes(model: type[Section], value: object) -> list[tuple[str, str]]:
    """Return the location and the sentence of each mistake in ``value``."""
    with pytest.raises(ValidationError) as caught:
        model.model_validate(value)
    return [(".".join(map(str, item["loc"])), item["msg"]) for item in caught.value.errors()]


def source(**keys: object) -> dict[str, object]:
    return {"name": "lab", "host": "192.0.2.20", **keys}
