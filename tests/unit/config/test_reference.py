"""The shipped description of the configuration, in words and as a JSON schema, is that of the program."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from jsonschema import Draft202012Validator
from pydantic import ValidationError

from gateway.config.loading import schema_text
from gateway.config.section import Section, key_descriptions
from gateway.config.settings import (
    HistorySettings,
    MetricsSettings,
    ReconnectSettings,
    Settings,
    SourceSettings,
    SpoolSettings,
    StreamSettings,
)
from gateway.config.values import RollPitchYaw, TransformSettings
from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.adapters.ros2.settings import OffsetSettings, Ros2Settings, ToolSettings
from gateway.outputs.adapters.rtc3d.settings import Rtc3dSettings
from gateway.outputs.adapters.vrpn.settings import VrpnSettings
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.property.test_config_properties import SETTINGS
from tests.support.configurations import MODEL
from tests.support.examples import examples

REFERENCE = (Path(__file__).parents[3] / "docs/reference/configuration.md").read_text(encoding="utf-8")

SECTIONS: dict[str, type[Section]] = {
    "sources[]": SourceSettings,
    "sources[].streams[]": StreamSettings,
    "sources[].reconnect": ReconnectSettings,
    "sources[].transform": TransformSettings,
    "sources[].transform.rotation_deg": RollPitchYaw,
    "zenoh": ZenohSettings,
    "lcm": LcmSettings,
    "takes": TakesSettings,
    "ros2": Ros2Settings,
    "ros2.tools": ToolSettings,
    "ros2.tools.offset": OffsetSettings,
    "rtc3d": Rtc3dSettings,
    "vrpn": VrpnSettings,
    "lsl": LslSettings,
    "foxglove": FoxgloveSettings,
    "spool": SpoolSettings,
    "history": HistorySettings,
    "metrics": MetricsSettings,
}


def default_of(section: type[Section], key: str) -> str:
    field = section.model_fields[key]
    if field.is_required():
        return "none"
    default = field.get_default(call_default_factory=True)
    if isinstance(default, Section) or (
        isinstance(default, tuple) and default and isinstance(default[0], Section)
    ):
        return "below"
    value = section.model_construct(**{key: default}).model_dump(mode="json", include={key})[key]
    if key == "components":
        value = ["all"]
    text: str = yaml.safe_dump(value, default_flow_style=True, width=1000)
    text = text.removesuffix("...\n").strip()
    return f"`{text}`"


def accepted_by(section: type[Section], key: str) -> str:
    """Return what the program says is accepted, when it finds something else."""
    try:
        section.model_validate({key: object()})
    except ValidationError as error:
        for details in error.errors():
            if details["loc"][0] == key:
                text = str(details["msg"]).partition("expected ")[2]
                return re.sub(r"a mapping with any of the keys .*", "a mapping", text)
    raise AssertionError(f"{key} accepts anything")


def table(section: type[Section]) -> str:
    lines = ["| key | default | accepted | what |", "|---|---|---|---|"]
    descriptions = key_descriptions(section)
    for key in section.model_fields:
        description = " ".join(descriptions[key].split())
        lines.append(
            f"| `{key}` | {default_of(section, key)} | {accepted_by(section, key)} | {description} |"
        )
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("name", SECTIONS)
def test_the_table_of_a_section_matches_the_program(name: str) -> None:
    heading = f"## {name}\n"
    assert heading in REFERENCE
    part = REFERENCE.partition(heading)[2].partition("\n## ")[0]
    assert table(SECTIONS[name]) in part, f"put this below {heading}{table(SECTIONS[name])}"


def test_the_reference_has_every_section() -> None:
    def sections_in(model: Any) -> set[type[Section]]:
        found = {model}
        for field in model.model_fields.values():
            default = field.get_default(call_default_factory=True)
            for value in default if isinstance(default, tuple) else (default,):
                if isinstance(value, Section):
                    found |= sections_in(type(value))
        return found

    found = sections_in(MODEL) | sections_in(SourceSettings) | {StreamSettings}  # the default is auto
    found |= sections_in(ToolSettings)  # the default is none
    assert found == {MODEL, *SECTIONS.values()}


@pytest.mark.parametrize("block", re.findall(r"```yaml\n(.*?)```", REFERENCE, re.DOTALL))
def test_the_examples_are_valid_configurations(block: str) -> None:
    assert MODEL.model_validate(yaml.safe_load(block)).sources


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


@hypothesis_settings(max_examples=examples(20))  # the validator takes 15 ms for each
@given(SETTINGS)
def test_valid_settings_match_the_schema(configuration: Settings) -> None:
    """An editor must not mark what the gateway accepts."""
    VALIDATOR.validate(configuration.model_dump(mode="json"))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "sources: []",
        "sources: [{name: lab}]",
        "sources: [{name: lab, host: lab, prot: 3020}]",
        "sources: [{name: lab, host: lab, port: 0}]",
        "sources: [{name: l b, host: lab}]",
        "sources: [{name: lab, host: lab, streams: []}]",
        "sources: [{name: lab, host: lab, streams: [{components: [7d]}]}]",
        "sources: [{name: lab, host: lab, streams: [{rate: fast}]}]",
        "sources: [{name: lab, host: lab, streams: [{rate: {divisor: 1.5}}]}]",
        "{sources: [{name: lab, host: lab}], lcm: {max_rate_hz: {3d: 0}}}",
        "{sources: [{name: lab, host: lab}], lcm: null}",
        "{sources: [{name: lab, host: lab}], zenoh: {config: 1}}",
    ],
)
def test_the_schema_rejects_mistakes(text: str) -> None:
    assert list(VALIDATOR.iter_errors(yaml.safe_load(text) or {}))
