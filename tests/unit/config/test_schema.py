import json
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from jsonschema import Draft202012Validator

from gateway.config.schema import schema_text
from gateway.config.settings import Settings
from tests.configurations import MODEL
from tests.property.test_config_properties import SETTINGS

SHIPPED = Path(__file__).parents[3] / "config"
VALIDATOR = Draft202012Validator(json.loads(schema_text(MODEL)))


def test_the_shipped_schema_is_current() -> None:
    shipped = (SHIPPED / "gateway.schema.json").read_text(encoding="utf-8")
    assert shipped == schema_text(MODEL), "rtc3d-gateway config schema > config/gateway.schema.json"


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.yaml")), ids=lambda path: path.name)
def test_shipped_configurations_name_and_match_the_schema(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# yaml-language-server: $schema=gateway.schema.json\n")
    VALIDATOR.validate(yaml.safe_load(text))


@settings(max_examples=20)  # the validator takes 15 ms for each
@given(SETTINGS)
def test_valid_settings_match_the_schema(configuration: Settings) -> None:
    """An editor must not mark what the gateway accepts."""
    VALIDATOR.validate(configuration.model_dump(mode="json"))


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"sources": []},
        {"sources": [{"name": "lab"}]},
        {"sources": [{"name": "lab", "host": "lab", "prot": 3020}]},
        {"sources": [{"name": "lab", "host": "lab", "port": 0}]},
        {"sources": [{"name": "l b", "host": "lab"}]},
        {"sources": [{"name": "lab", "host": "lab", "streams": []}]},
        {"sources": [{"name": "lab", "host": "lab", "streams": [{"components": ["7d"]}]}]},
        {"sources": [{"name": "lab", "host": "lab", "streams": [{"rate": "fast"}]}]},
        {"sources": [{"name": "lab", "host": "lab", "streams": [{"rate": {"divisor": 1.5}}]}]},
        {"sources": [{"name": "lab", "host": "lab"}], "lcm": {"max_rate_hz": {"3d": 0}}},
        {"sources": [{"name": "lab", "host": "lab"}], "lcm": None},
        {"sources": [{"name": "lab", "host": "lab"}], "zenoh": {"config": 1}},
    ],
)
def test_the_schema_rejects_mistakes(values: object) -> None:
    assert list(VALIDATOR.iter_errors(values))
