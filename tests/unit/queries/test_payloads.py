import json
import threading
from pathlib import Path

import pytest

from gateway.errors import QueryError
from gateway.messages.json_text import MAX_JSON_SOURCE_BYTES
from gateway.queries import payloads
from gateway.queries.payloads import FilePayload, JsonPayload, NewestJson
from tests.unit.messages.samples import component_message
from tests.vectors import MARKERS

FIRST = component_message(MARKERS)
SECOND = FIRST[:8] + bytes(8) + FIRST[16:]  # another utime


def test_a_payload_is_made_once_for_all_threads() -> None:
    made: list[int] = []

    def make() -> bytes:
        made.append(1)
        return b"{}"

    payload = JsonPayload(make, 2)
    assert not payload.is_made
    threads = [threading.Thread(target=payload.make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (made, payload.is_made, payload.make()) == ([1], True, b"{}")


def test_the_json_of_a_message_is_made_once() -> None:
    newest = NewestJson()
    _, first = newest.of("3d", FIRST)
    assert json.loads(first.make())["num_markers"] > 0
    assert newest.of("3d", bytes(FIRST))[1] is first
    message, second = newest.of("3d", SECOND)
    assert message == SECOND
    assert json.loads(second.make())["utime"] == 0


def test_while_the_json_of_a_message_waits_to_be_made_later_peers_share_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    newest = NewestJson()
    _, first = newest.of("3d", FIRST)
    assert newest.of("3d", SECOND) == (FIRST, first)
    assert newest.of("6d", SECOND)[0] == SECOND
    monkeypatch.setattr(payloads, "_UNMADE_S", 0.0)  # nobody makes it
    assert newest.of("3d", SECOND)[0] == SECOND


def test_a_message_that_is_too_long_is_not_converted() -> None:
    with pytest.raises(QueryError, match="too long for JSON; ask without format=json") as caught:
        NewestJson().of("3d", bytes(MAX_JSON_SOURCE_BYTES + 1))
    assert caught.value.code == "refused"


def test_a_file_is_read_when_it_is_sent(tmp_path: Path) -> None:
    path = tmp_path / "a.c3d"
    path.write_bytes(b"content")
    payload = FilePayload(path)
    assert (payload.num_bytes, payload.make()) == (7, b"content")
    path.unlink()
    with pytest.raises(QueryError, match=r"C3D file a\.c3d cannot be read: No such file") as caught:
        payload.make()
    assert caught.value.code == "nothing-yet"
