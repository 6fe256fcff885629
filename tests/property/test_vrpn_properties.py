from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import PeerError
from gateway.outputs.adapters.vrpn.protocol import (
    COOKIE,
    MAX_BODY_BYTES,
    MAX_NAME_BYTES,
    ClientReader,
    callback_port,
    describe_tracker,
    encode_pose,
)
from gateway.outputs.adapters.vrpn.trackers import MAX_TRACKERS, TrackerNames, Trackers
from tests.support.strategies import damaged, pieces_of

PING_TYPE = 7


def message(number: int, message_type: int, body: bytes = b"") -> bytes:
    """Return the bytes of a message, made without the encoder under test."""
    header = b"".join(
        value.to_bytes(4, "big", signed=True) for value in (24 + len(body), 0, 0, number, message_type, 0)
    )
    return header + body + bytes(-len(body) % 8)


def description(number: int, message_type: int, name: bytes) -> bytes:
    return message(number, message_type, (len(name) + 1).to_bytes(4, "big") + name + b"\0")


PING_DESCRIPTION = description(PING_TYPE, -2, b"vrpn_Base ping_message")

numbers = st.integers(0, 5)
names = st.text(min_size=1, max_size=23).filter(lambda name: "\0" not in name)
senders = st.builds(lambda number, name: ("sender", number, name), numbers, names)
pings = st.builds(lambda number: ("ping", number, ""), numbers)
others = st.builds(lambda number, size: ("other", number, "x" * size), numbers, st.integers(0, 70))
conversations = st.lists(senders | pings | others, max_size=12)


def stream_of(conversation: list[tuple[str, int, str]]) -> bytes:
    encoded = [COOKIE, PING_DESCRIPTION]
    for what, number, text in conversation:
        if what == "sender":
            encoded.append(description(number, -1, text.encode(errors="replace")))
        elif what == "ping":
            encoded.append(message(number, PING_TYPE))
        else:
            encoded.append(message(number, 9, text.encode()))
    return b"".join(encoded)


def pinged_in(conversation: list[tuple[str, int, str]]) -> list[str]:
    known: dict[int, str] = {}
    pinged = []
    for what, number, text in conversation:
        if what == "sender":
            known[number] = text.encode(errors="replace").decode()
        elif what == "ping" and number in known:
            pinged.append(known[number])
    return pinged


def read(pieces: list[bytes]) -> tuple[list[str], str]:
    """Return the pings in ``pieces``, and the error that ended reading."""
    reader = ClientReader()
    pinged = []
    for piece in pieces:
        try:
            pinged += reader.receive(piece)
        except PeerError as error:
            return pinged, str(error)
        assert reader.num_waiting_bytes < 24 + 104
    return pinged, ""


@given(conversations, st.data())
def test_pings_are_read_however_the_stream_is_split(
    conversation: list[tuple[str, int, str]], data: st.DataObject
) -> None:
    pieces = data.draw(pieces_of(stream_of(conversation)))
    assert read(pieces) == (pinged_in(conversation), "")


@given(conversations, st.data())
def test_damaged_stream_gives_pings_or_an_error_and_keeps_little(
    conversation: list[tuple[str, int, str]], data: st.DataObject
) -> None:
    stream = data.draw(damaged(st.just(stream_of(conversation))))
    _, error = read(data.draw(pieces_of(stream)))
    _, error_of_bytes = read([stream[at : at + 1] for at in range(len(stream))])
    assert error.partition(";")[0] == error_of_bytes.partition(";")[0]


@given(st.binary(max_size=300))
def test_any_bytes_after_the_cookie_are_read_or_refused(data: bytes) -> None:
    read([COOKIE, data])


@given(st.integers(24, 24 + MAX_BODY_BYTES))
def test_any_length_that_libvrpn_accepts_is_skipped(length: int) -> None:
    body = bytes(length - 24)
    stream = COOKIE + PING_DESCRIPTION + description(1, -1, b"wand")
    assert read([stream + message(1, 9, body) + message(1, PING_TYPE)]) == (["wand"], "")


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, MAX_TRACKERS - 1))
def test_any_time_and_number_can_be_encoded(utime: int, number: int) -> None:
    assert len(encode_pose(number, utime, (0.0,) * 8)) == 88


@given(st.binary(max_size=300))
def test_callback_port_is_none_or_a_user_port(datagram: bytes) -> None:
    port = callback_port(datagram)
    assert port is None or 1024 <= port <= 65535


sources = st.sampled_from(["lab", "stage", "hall-2"])
tool_lists = st.lists(
    st.text(max_size=120) | st.sampled_from(["wand", "w nd", "w@nd"]), max_size=5, unique=True
)
changes = st.lists(st.tuples(sources, st.none() | tool_lists), max_size=12)


@given(st.sampled_from(["auto", "tool", "source/tool"]), changes)
def test_trackers_have_different_names_that_vrpn_accepts(
    style: TrackerNames, change_list: list[tuple[str, list[str] | None]]
) -> None:
    trackers = Trackers(style)
    present: dict[str, list[str]] = {}
    for source, tools in change_list:
        if tools is None:
            trackers.remove(source)
            present.pop(source, None)
        else:
            trackers.set_tools(source, tools)
            present[source] = tools
        current = list(trackers.by_name.values())
        assert len(current) == sum(map(len, present.values()))
        assert len({tracker.name for tracker in current}) == len(current)
        assert len({tracker.number for tracker in current}) == len(current)
        for tracker in current:
            assert len(tracker.name.encode()) <= MAX_NAME_BYTES
            assert "@" not in tracker.name
            assert not any(character.isspace() for character in tracker.name)
            assert len(describe_tracker(tracker.number, tracker.name)) <= 24 + 104
        for source_name, tool_list in present.items():
            assert list(trackers.of_source(source_name)) == tool_list
