"""The JSON schema of the configuration, for editors that check and complete YAML."""

import json
from typing import Any, Final

from pydantic.json_schema import GenerateJsonSchema

from gateway.config.settings import Settings

_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


class _WithoutTitles(GenerateJsonSchema):
    """Omits the titles of keys, which only repeat the key."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002 - no key has one
        return False


def schema_text(model: type[Settings]) -> str:
    """Return the JSON schema of ``model``, the content of ``config/gateway.schema.json``."""
    schema = model.model_json_schema(schema_generator=_WithoutTitles)
    return json.dumps({"$schema": _DIALECT, **schema, "title": "RTC3D gateway"}, indent=2) + "\n"
