"""The configuration of a command's session beside a gateway."""

import json

from gateway.outputs.zenoh.command_session import command_config


def test_a_configured_id_is_replaced_by_another_valid_one() -> None:
    given = {"mode": "peer", "id": "abc1"}
    ids = {json.loads(command_config(given).get_json("id")) for _ in range(100)}  # raises if one is invalid
    assert len(ids) == 100
    assert "abc1" not in ids
