"""The section ``rtc3d`` of the configuration."""

from typing import Any

import pytest
from pydantic import ValidationError

from gateway.outputs.rtc3d.kind import RTC3D
from gateway.outputs.rtc3d.settings import Rtc3dSettings


def mistake(**values: Any) -> str:
    with pytest.raises(ValidationError) as caught:
        Rtc3dSettings(**values)
    [error] = caught.value.errors(include_url=False)
    return f"{'.'.join(map(str, error['loc']))}: {error['msg']}"


def test_by_default_it_is_off_and_listens_on_this_computer_only() -> None:
    settings = Rtc3dSettings()
    assert not settings.enabled
    assert not RTC3D.leaves_host(settings)
    assert Rtc3dSettings(enabled=True, ports={"lab": 3120, "hall-2": 3121}).ports["hall-2"] == 3121


@pytest.mark.parametrize(
    ("host", "leaves"),
    [("127.0.0.1", False), ("::1", False), ("localhost", False), ("::", True), ("lab-pc", True)],
)
def test_frames_leave_this_computer_if_others_can_connect(host: str, leaves: bool) -> None:
    assert RTC3D.leaves_host(Rtc3dSettings(host=host)) is leaves


def test_a_port_for_at_least_one_source_is_needed() -> None:
    assert mistake(enabled=True) == (
        "ports: found nothing; expected a port for each source that is served, as in {lab: 3120}"
    )


def test_two_sources_cannot_have_one_port() -> None:
    assert mistake(ports={"lab": 3120, "hall": 3120}) == (
        "ports.hall: found 3120, which lab has too; expected another port for each source"
    )


@pytest.mark.parametrize(
    ("values", "place"),
    [
        ({"ports": {"lab": 0}}, "ports.lab"),
        ({"ports": {"a lab": 3120}}, "ports.a lab"),
        ({"ports": 3120}, "ports"),
        ({"max_clients": 0}, "max_clients"),
    ],
)
def test_mistakes_have_their_place(values: dict[str, Any], place: str) -> None:
    assert mistake(**values).startswith(place)
