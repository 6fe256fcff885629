import json
import warnings
from typing import Any

import pytest
from pydantic import TypeAdapter

from gateway.config.loading import schema_text
from gateway.config.settings import SourceSettings
from gateway.config.values import ChannelPrefix, SourceName, TransformSettings
from gateway.config.words import describe
from gateway.messages import topics
from gateway.outputs.lcm.settings import LcmSettings, lcm_queries_url
from gateway.outputs.registry import OUTPUTS
from gateway.rtc3d.components import ComponentType
from tests.support.configurations import MODEL, mistakes, source
from tests.support.errors import names

MARKERS, ANALOG, FORCE = ComponentType.MARKERS, ComponentType.ANALOG, ComponentType.FORCE
TOOLS, EVENT = ComponentType.TOOLS, ComponentType.EVENT


def test_the_longest_name_and_prefix_fit_a_channel() -> None:
    TypeAdapter(SourceName).validate_python("S" * 24)
    TypeAdapter(ChannelPrefix).validate_python("P" * 16)
    channel = f"{'P' * 16}_{'S' * 24}_PARAMETERS_REQUEST"
    assert len(channel) <= topics.MAX_CHANNEL_LENGTH
    assert topics.lcm_channel("P" * 16, "S" * 24, "PARAMETERS_REQUEST") == channel


def test_a_component_in_two_streams_is_refused() -> None:
    streams = [{"components": ["3d"]}, {"components": ["analog"]}, {"components": ["6d", "3d"]}]
    [(location, text)] = mistakes(SourceSettings, source(streams=streams))
    assert location == "streams.2.components"
    assert names(text, "'3d'", "streams[0]")


def test_a_rate_slower_than_the_stall_timeout_is_refused() -> None:
    streams = [{"components": ["3d"]}, {"components": ["6d"], "rate": {"frequency_hz": 0.25}}]
    [(location, text)] = mistakes(SourceSettings, source(streams=streams))
    assert location == "streams.1.rate.frequency_hz"
    assert names(text, 0.25, "4 s", "stall_timeout_s", 3, 0.333333)
    assert SourceSettings.model_validate(source(streams=streams, stall_timeout_s=4.1))


@pytest.mark.parametrize(("value", "found"), [([], "list"), ({}, "mapping"), ("x", "'x'"), (None, "nothing")])
def test_sources_and_streams_must_be_lists_with_at_least_one_item(value: object, found: str) -> None:
    [(location, text)] = mistakes(MODEL, {"sources": value})
    assert location == "sources"
    assert names(text, found, "name", "host")
    [(location, text)] = mistakes(SourceSettings, source(streams=value))
    assert location == "streams"
    assert names(text, found, "auto")


def test_without_an_lcm_url_the_environment_or_the_default_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LCM_DEFAULT_URL", raising=False)
    assert LcmSettings().effective_url == "udpm://239.255.76.67:7667?ttl=0"
    monkeypatch.setenv("LCM_DEFAULT_URL", "udpm://239.255.76.67:7667?ttl=1")
    assert LcmSettings().effective_url == "udpm://239.255.76.67:7667?ttl=1"
    assert LcmSettings(url="memq://").effective_url == "memq://"


@pytest.mark.parametrize(
    ("url", "queries_url"),
    [
        ("udpm://239.255.76.67:7667?ttl=1", "udpm://239.255.76.67:7668?ttl=1"),
        ("udpm://239.1.2.3:65535", "udpm://239.1.2.3:65534"),
        ("udpm://?ttl=1&recv_buf_size=2000000", "udpm://239.255.76.67:7668?ttl=1&recv_buf_size=2000000"),
        *((url, url) for url in ("mpudpm://", "memq://", "tcpq://lab:7700", "udpm://239.1.2.3:lcm")),
    ],
)
def test_requests_use_the_next_port_only_for_multicast_urls(url: str, queries_url: str) -> None:
    assert lcm_queries_url(url) == queries_url
    assert LcmSettings.model_construct(url=url).effective_queries_url == queries_url
    assert LcmSettings(url="memq://", queries_url="tcpq://lab:1").effective_queries_url == "tcpq://lab:1"


def test_at_least_one_output_must_be_enabled() -> None:
    off = {"enabled": False}
    *others, last = (f"{name}.enabled" for name in OUTPUTS)
    [(location, text)] = mistakes(MODEL, {"sources": [source()], "zenoh": off, "lcm": off})
    assert location == last
    assert names(text, "false", *others, "true")
    assert MODEL.model_validate({"sources": [source()], "zenoh": off}).lcm.enabled
    assert MODEL.model_validate({"sources": [source()], "lcm": off}).zenoh.enabled


def test_descriptions_of_values_are_one_bounded_line_without_passwords() -> None:
    """They are quoted in errors, which people send to each other."""
    assert describe("a\nb\x1b" + "x" * 1000) == repr("a\nb\x1b" + "x" * 56 + "…")
    assert describe("tcpq://me:geheim@lab:7700") == "'tcpq://me:***@lab:7700'"
    assert "geheim" not in describe("x" * 50 + "tls/lab#connect_private_key_base64=geheim")


@pytest.mark.parametrize(
    ("rotation", "found_first"),
    [
        ([0, 0, 0, 0], "found only zeros"),
        ([0, 0, 0, 0.98], "found [0, 0, 0, 0.98]"),
        ([0, 0, 2, 0], "found [0, 0, 2, 0]"),
        ([0, 0, 1], "found [0, 0, 1]"),
    ],
)
def test_a_quaternion_that_is_no_rotation_is_refused(rotation: list[float], found_first: str) -> None:
    """Poses would be scaled or mirrored, unnoticed until a robot moves."""
    [(location, found)] = mistakes(TransformSettings, {"rotation_xyzw": rotation})
    assert location == "rotation_xyzw"
    assert found.startswith(found_first)


def test_a_quaternion_with_few_digits_is_made_exact() -> None:
    """People write two or three digits."""
    rotation = TransformSettings.model_validate({"rotation_xyzw": [0, 0, 0.7, 0.72]}).rotation_xyzw
    assert rotation == pytest.approx((0, 0, 0.697078, 0.716995), abs=1e-6)
    both = {"rotation_xyzw": [0, 0, 0, 1], "rotation_deg": {"yaw": 90}}
    error = ("rotation_deg", "found rotation_xyzw, too; expected one of the two")
    assert mistakes(TransformSettings, both) == [error]


def test_every_key_has_a_description_in_the_schema() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        schema: dict[str, Any] = json.loads(schema_text(MODEL))
    sections = [schema, *schema["$defs"].values()]
    keys = [key for section in sections for key in section["properties"].values()]
    assert len(keys) > 20
    assert all(key["description"] for key in keys)


VRPN = {"enabled": True, "port": 9464}
RTC3D = {"enabled": True, "ports": {"lab": 3120, "hall": 3883}}


@pytest.mark.parametrize(
    ("sections", "key", "values"),
    [
        ({"vrpn": VRPN}, "vrpn.port", [9464, "metrics.port"]),
        (
            {"vrpn": VRPN | {"port": 8765}, "foxglove": {"enabled": True, "host": "::"}},
            "foxglove.port",
            [8765, "vrpn.port"],
        ),
        (
            {"vrpn": {"enabled": True}, "rtc3d": RTC3D},
            "vrpn.port",
            [3883, "rtc3d.ports.hall"],
        ),
        ({"vrpn": VRPN | {"enabled": False}}, "", []),
        ({"vrpn": VRPN, "metrics": {"enabled": False}}, "", []),
        ({"vrpn": VRPN | {"host": "192.0.2.7"}}, "", []),
    ],
)
def test_two_sections_cannot_listen_on_the_same_port_of_an_address(
    sections: dict[str, Any], key: str, values: list[object]
) -> None:
    configuration = {"sources": [source()], **sections}
    if key:
        [(location, text)] = mistakes(MODEL, configuration)
        assert location == key
        assert names(text, *values)
    else:
        assert MODEL.model_validate(configuration)
