"""Gateways on LCM in memory that notice each other."""

import pytest

from gateway.outputs import other_gateways
from gateway.outputs.lcm.receiver import MAX_REQUEST_BYTES
from tests.unit.outputs.lcm.peer import Lab, command_request, with_settings


async def test_gateways_with_a_source_of_one_name_notice_each_other(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway shows itself on the URL of requests. It receives that, too, and is no other one."""
    monkeypatch.setattr(other_gateways, "HOLD_S", 0.0)
    shown: list[bytes] = []
    lab.lcm.subscribe("MOCAP_LAB_GATEWAY", lambda _, data: shown.append(data))
    for _ in range(3):
        lab.output.maintain()
    lab.deliver()
    assert len(shown) == 1
    assert lab.output.warnings() == []
    for data in (b"", bytes(8), shown[0][:-1], shown[0] + bytes(MAX_REQUEST_BYTES)):
        lab.lcm.publish("MOCAP_LAB_GATEWAY", data)
    lab.lcm.publish("MOCAP_HALL_GATEWAY", command_request(0, "", requester="another"))
    lab.deliver()
    assert lab.output.warnings() == []
    lab.lcm.publish("MOCAP_LAB_GATEWAY", command_request(0, "", requester="another"))
    lab.deliver()
    assert len(lab.output.warnings()) == 1
    lab.output.withdraw("lab")
    assert lab.output.warnings() == []


async def test_of_a_source_that_is_not_served_nobody_is_another_gateway(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Requests about it get one answer, so a warning here or there would be about nothing."""
    monkeypatch.setattr(other_gateways, "HOLD_S", 0.0)
    lab.service.sources.remove("lab")
    shown: list[bytes] = []
    lab.lcm.subscribe("MOCAP_LAB_GATEWAY", lambda _, data: shown.append(data))
    lab.output.maintain()
    lab.deliver()
    assert shown == []
    lab.lcm.publish("MOCAP_LAB_GATEWAY", command_request(0, "", requester="another"))
    lab.deliver()
    assert lab.output.warnings() == []


@with_settings(queries=False)
async def test_a_gateway_that_receives_nothing_shows_itself_to_nobody(lab: Lab) -> None:
    """Its messages would be the only ones on the URL of requests."""
    shown: list[bytes] = []
    lab.lcm.subscribe("MOCAP_LAB_GATEWAY", lambda _, data: shown.append(data))
    lab.output.maintain()
    lab.deliver()
    assert shown == []
