"""The section ``ros2``: what it accepts, and what it says of mistakes."""

import pytest

from gateway.outputs.ros2.settings import Ros2Settings
from tests.settings import mistakes


def test_the_defaults_are_those_of_ros() -> None:
    settings = Ros2Settings()
    assert not settings.enabled
    assert (settings.domain_id, settings.namespace, settings.distribution) == (0, "mocap", "jazzy")
    assert settings.connect == "tcp/127.0.0.1:7447"
    assert (settings.reliability, settings.durability, settings.depth) == ("best_effort", "volatile", 10)


@pytest.mark.parametrize(
    ("key", "given", "used"),
    [
        *(("namespace", given, given) for given in ("mocap", "site/hall_2", "", "a" * 100)),
        *(("namespace", f"/{used}", used) for used in ("mocap", "")),
        *(
            ("connect", given, given)
            for given in ("tcp/[::1]:7447", "tcp/robot.example.org:1", "tls/a:65535", "udp/192.0.2.5:7447")
        ),
        *(("domain_id", given, given) for given in (0, 232)),
        *(("distribution", given, given) for given in ("humble", "jazzy", "kilted", "lyrical", "rolling")),
    ],
)
def test_what_is_accepted(key: str, given: object, used: object) -> None:
    assert getattr(Ros2Settings.model_validate({key: given}), key) == used


NAMESPACES = ("2nd", "a b", "a__b", "_a", "a_", "a//b", "a/", "a/2b", "ä", "a" * 101, "~a", "{x}", "a/*")
ENDPOINTS = ("", "192.0.2.5:7447", "tcp/192.0.2.5", "tcp/:7447", "tcp/a:0", "tcp/a:65536", "tcp/a b:1")


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        *(("namespace", value, "a ROS namespace such as mocap or site/mocap") for value in NAMESPACES),
        *(
            ("connect", value, "the endpoint of a Zenoh router, such as tcp/127.0.0.1:7447")
            for value in ENDPOINTS
        ),
        ("distribution", "jazy", ""),
        ("domain_id", -1, ""),
        ("domain_id", 233, ""),
        ("reliability", "best effort", ""),
        ("durability", "transient_local", ""),
        ("depth", 0, ""),
    ],
)
def test_mistakes(key: str, value: object, expected: str) -> None:
    [(place, text)] = mistakes(Ros2Settings, {key: value})
    assert place == key
    assert text.startswith(f"found {value!r}"[:50])
    assert f"; expected {expected}" in text
