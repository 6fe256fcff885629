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
    ("given", "used"),
    [
        ("mocap", "mocap"),
        ("/mocap", "mocap"),
        ("site/hall_2", "site/hall_2"),
        ("", ""),
        ("/", ""),
        ("a" * 100, "a" * 100),
    ],
)
def test_namespaces(given: str, used: str) -> None:
    assert Ros2Settings(namespace=given).namespace == used


@pytest.mark.parametrize(
    "namespace", ["2nd", "a b", "a__b", "_a", "a_", "a//b", "a/", "a/2b", "ä", "a" * 101, "~a", "{x}", "a/*"]
)
def test_namespaces_that_ros_refuses(namespace: str) -> None:
    [(place, text)] = mistakes(Ros2Settings, {"namespace": namespace})
    assert place == "namespace"
    assert "expected a ROS namespace such as mocap or site/mocap" in text


@pytest.mark.parametrize(
    "connect", ["tcp/[::1]:7447", "tcp/robot.example.org:1", "tls/a:65535", "udp/192.0.2.5:7447"]
)
def test_endpoints(connect: str) -> None:
    assert Ros2Settings(connect=connect).connect == connect


@pytest.mark.parametrize(
    "connect", ["", "192.0.2.5:7447", "tcp/192.0.2.5", "tcp/:7447", "tcp/a:0", "tcp/a:65536", "tcp/a b:1"]
)
def test_endpoints_that_are_none(connect: str) -> None:
    assert mistakes(Ros2Settings, {"connect": connect}) == [
        (
            "connect",
            f"found {connect!r}; expected the endpoint of a Zenoh router, such as tcp/127.0.0.1:7447",
        )
    ]


@pytest.mark.parametrize("name", ["humble", "jazzy", "kilted", "lyrical", "rolling"])
def test_distributions(name: str) -> None:
    assert Ros2Settings(distribution=name).distribution == name  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("distribution", "jazy"),
        ("domain_id", -1),
        ("domain_id", 233),
        ("reliability", "best effort"),
        ("durability", "transient_local"),
        ("depth", 0),
    ],
)
def test_other_mistakes(key: str, value: object) -> None:
    [(place, text)] = mistakes(Ros2Settings, {key: value})
    assert place == key
    assert text.startswith(f"found {value!r}; expected ")
