"""What both transports make of the answers of gateways."""

from typing import Any

import pytest

from gateway.client.transport import recent_keys
from gateway.errors import QueryError
from tests.support.errors import raises


def test_of_the_history_the_wanted_keys_with_recent_messages_are_used() -> None:
    """The newest message of all is from now; poses belong to 6d. Keys that no gateway has are left out."""
    ages_s = {"3d": 20, "6d/Tool 1": 3, "analog": 0.5, "event": 8, "status": 0, "4d": 0, "3d/x": 0}
    ages_s["6d/" + 600 * "x"] = 0
    overview = {"keys": {key: {"newest_utime": round(1e9 - 1e6 * age_s)} for key, age_s in ages_s.items()}}
    assert recent_keys(overview, None, 10) == ["6d/Tool 1", "analog", "event", "status"]
    assert recent_keys(overview, ["3d", "6d", "event"], 10) == ["6d/Tool 1", "event", "status"]
    assert recent_keys({"keys": {}}, None, 10) == []


@pytest.mark.parametrize("keys", [None, [], {"3d": None}, {"3d": {}}, {"3d": {"newest_utime": "x"}}])
def test_an_overview_that_cannot_be_read_is_an_error(keys: Any) -> None:
    with raises(QueryError, code="unreadable"):
        recent_keys({"keys": keys}, None, 10)
