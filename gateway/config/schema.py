"""The JSON schema of configurations, for editors that check and complete YAML while it is written."""

import json
from typing import Any, Final

from pydantic.json_schema import GenerateJsonSchema

from gateway.config.settings import Settings

_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


class _WithoutTitles(GenerateJsonSchema):
    """Gives keys no titles: pydantic's only repeat the key."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002 - no key has one
        return False


def schema_text(model: type[Settings]) -> str:
    """Return the schema of ``model`` as JSON, the content of ``config/gateway.schema.json``."""
    schema = model.model_json_schema(schema_generator=_WithoutTitles)
    return json.dumps({"$schema": _DIALECT, **schema, "title": "RTC3D gateway"}, indent=2) + "\n"
