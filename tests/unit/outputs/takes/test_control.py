"""The command take: what it asks of the takes, and what peers get."""

import json
from collections.abc import Callable, Coroutine
from typing import Any, cast

import pytest

from gateway.errors import QueryError
from gateway.outputs.takes.control import MAX_LISTED, TakeCommand
from gateway.outputs.takes.folder import StoredTake, TakePiece
from gateway.outputs.takes.source_takes import MAX_SAVED_S, TakeList
from gateway.takes.files.description import NO_DETAILS, TakeDetails
from tests.support.clocks import Clock
from tests.support.errors import raises

ABOUT = TakeDetails("S01", note="left knee")
WALK = StoredTake("walk-1", 4096, 1_700_000_000_000_000, 12.34567, True, 2, details=ABOUT)
WALK_FIELDS = {
    "name": "walk-1",
    "bytes": 4096,
    "begin_utime": 1_700_000_000_000_000,
    "seconds": 12.346,
    "is_running": True,
    "lost": 2,
    "is_cut_off": False,
    "subject": "S01",
    "session": "",
    "note": "left knee",
}


class FakeTakes:
    """Records the calls, and returns ``walk-1``."""

    def __init__(self, num_takes: int = 1) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self._num_takes = num_takes

    def __getattr__(self, name: str) -> Callable[..., Coroutine[Any, Any, Any]]:
        async def call(*arguments: Any) -> Any:
            self.calls.append((name, *arguments))
            if name == "list":
                return TakeList(WALK, [WALK] * self._num_takes, 59.9999)
            return TakePiece("walk-1", 4096, arguments[1], b"\xed\xa1") if name == "read" else WALK

        return call


def command_of(takes: FakeTakes, clock: Clock | None = None) -> TakeCommand:
    return TakeCommand(lambda _source: cast(Any, takes), clock or Clock())


@pytest.mark.parametrize(
    ("options", "call"),
    [
        ({"set": "start"}, ("start", "", NO_DETAILS)),
        ({"set": "start", "name": "walk-1"}, ("start", "walk-1", NO_DETAILS)),
        (
            {"set": "start", "subject": "S01", "session": " pre ", "note": "50 %25%3B s=1 动作"},
            ("start", "", TakeDetails("S01", "pre", "50 %; s=1 动作")),
        ),
        ({"set": "stop"}, ("stop",)),
        ({"set": "save"}, ("save", MAX_SAVED_S, 0.0, "", NO_DETAILS)),
        (
            {"set": "save", "last": "120", "after": "1.5", "name": "fall", "subject": "S" * 64},
            ("save", 120.0, 1.5, "fall", TakeDetails("S" * 64)),
        ),
    ],
)
async def test_takes_are_started_stopped_and_saved(options: dict[str, str], call: tuple[Any, ...]) -> None:
    """Each option arrives where it belongs, and the answer describes the take."""
    takes = FakeTakes()
    answer = await command_of(takes)("lab", options)
    assert takes.calls == [call]
    assert answer.encoding == "application/json"
    assert json.loads(answer.payload) == {"source": "lab"} | WALK_FIELDS


async def test_without_options_the_takes_are_listed_up_to_a_limit() -> None:
    """The fields are those of the reference; an answer of any length would not fit into a message."""
    takes = FakeTakes()
    listed = json.loads((await command_of(takes)("lab", {})).payload)
    assert takes.calls == [("list",)]
    counted = {"source": "lab", "num_takes": 1, "kept_s": 60.0}
    assert listed == counted | {"running": WALK_FIELDS, "takes": [WALK_FIELDS]}
    listed = json.loads((await command_of(FakeTakes(MAX_LISTED + 5))("lab", {})).payload)
    assert (len(listed["takes"]), listed["num_takes"]) == (MAX_LISTED, MAX_LISTED + 5)


@pytest.mark.parametrize(
    ("options", "offset"), [({}, 0), ({"offset": "0"}, 0), ({"offset": "9" * 18}, 10**18 - 1)]
)
async def test_a_piece_is_read_with_its_place_in_the_attachment(options: dict[str, str], offset: int) -> None:
    """With it, a peer knows when it has all."""
    takes = FakeTakes()
    answer = await command_of(takes)("lab", {"read": "walk-1"} | options)
    assert takes.calls == [("read", "walk-1", offset)]
    assert answer.payload == b"\xed\xa1"
    assert answer.attachment == {"name": "walk-1", "bytes": 4096, "offset": offset}


ACCEPTED = "accepted"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"set": "pause"}, "start, stop, save"),
        ({"set": ""}, "set=''"),
        ({"set": "s" * 1_000_000}, "…'"),
        ({"set": "stop", "name": "w"}, "'name' of take with set=stop"),
        ({"set": "start", "last": "5"}, "'last' of take with set=start"),
        ({"set": "start", "read": "w"}, "'read' of take with set=start"),
        ({"name": "w"}, "'name' of take"),
        ({"x" * 1_000_000: ""}, "'xxx"),
        ({"offset": "0"}, "'offset' of take"),
        ({"read": "w", "offset": "-1"}, "offset='-1'"),
        *(({"read": "w", "offset": offset}, ACCEPTED) for offset in ("nan", "", "9" * 19, "٣", "1\n")),
        ({"set": "stop", "note": "w"}, "'note' of take with set=stop"),
        *(({"set": "start", "note": note}, ACCEPTED) for note in ("two%0Alines", "%1B[2J", "n" * 501, "%FF")),
        *(({"set": "save", name: "s" * 65}, "64 characters") for name in ("subject", "session")),
        ({"set": "save", "last": "nan"}, "last='nan'"),
        *(({"set": "save", "last": last}, f"last='{last}'") for last in ("inf", "-1", "3601")),
        *(({"set": "save", "after": after}, ACCEPTED) for after in ("1e3", "9" * 1_000_000)),
    ],
)
async def test_a_wrong_option_is_an_error_with_what_is_accepted(options: dict[str, str], text: str) -> None:
    """Nothing is done by mistake, and a long option is not sent back."""
    takes = FakeTakes()
    with pytest.raises(QueryError) as caught:
        await command_of(takes)("lab", options)
    assert text in str(caught.value)
    assert caught.value.code == "bad-request"
    assert len(str(caught.value)) < 400
    assert takes.calls == []


async def test_a_flood_of_reads_is_refused() -> None:
    """100 pieces a second are enough for a copy; more would keep the disk from recording."""
    takes, clock = FakeTakes(), Clock()
    command = command_of(takes, clock)
    for after_s, expected in ((0.0, 100), (0.25, 125), (3600.0, 225)):
        clock.now_s += after_s
        while len(takes.calls) < expected:
            await command("lab", {"read": "walk-1"})
        with raises(QueryError, 100, code="rate"):
            await command("lab", {"read": "walk-1"})
        assert len(takes.calls) == expected
    await command("lab", {})
