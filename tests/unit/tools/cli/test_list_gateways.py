"""What ``list`` prints about the sources that were found, and what it makes of hostile statuses."""

import io
import math
from typing import Any

import pytest
import rtc3d
from rich.cells import cell_len
from rich.console import Console

from gateway.client.transport import MAX_LISTED_SOURCES, MAX_STATUS_BYTES, FoundSources
from gateway.messages.decode import decode
from gateway.messages.source_report import source_report
from gateway.tools.cli.list_gateways import found_json, notes, write_sources
from tests.support.errors import names
from tests.unit.messages.samples import status_of

COLUMNS = ("source", "state", "components", "server", "host", "version")


def status(**fields: Any) -> rtc3d.status_t:
    """Return the status of a gateway that streams, with these fields."""
    message: rtc3d.status_t = decode(status_of())
    for name, value in {"host": "mocap-pc", "gateway_version": "1.2.3", **fields}.items():
        setattr(message, name, value)
    [stream] = message.streams
    stream.state, stream.frame_rate_hz = "streaming", 200.0
    return message


def found_of(*messages: rtc3d.status_t) -> FoundSources:
    found = FoundSources()
    for message in messages:
        found.add_status(message.encode())
    return found


def printed(found: FoundSources, *, columns: int = 80, is_terminal: bool = True) -> str:
    out = io.StringIO()
    write_sources(found, Console(file=out, force_terminal=is_terminal, color_system=None, width=columns))
    return out.getvalue()


def two_streams(**fields: Any) -> rtc3d.status_t:
    message = status(**fields)
    second = status().streams[0]
    second.components, second.state, second.frame_rate_hz = "analog force", "waiting to reconnect", 0.0
    second.tries = 3
    message.streams, message.num_streams = [*message.streams, second], 2
    return message


def test_a_table_has_a_line_for_each_stream() -> None:
    lines = printed(found_of(two_streams()), columns=120).splitlines()
    assert tuple(lines[0].split()) == COLUMNS
    assert lines[1].split("  ")[0] == "lab"
    assert "streaming 200.0 Hz" in lines[1]
    assert "192.0.2.20:3020" in lines[1]
    waiting = source_report(two_streams()).streams[1].text
    assert " ".join(lines[2].split()) == f"{waiting} analog force"


@pytest.mark.parametrize("columns", [40, 80, 200])
def test_a_table_fits_the_terminal_and_loses_nothing(columns: int) -> None:
    message = two_streams(host="撮影室のコンピューター", server="[2001:db8::1234:5678:9abc:def0]:3020")
    text = printed(found_of(message), columns=columns)
    assert max(map(cell_len, text.splitlines())) <= columns
    if columns == 200:
        assert "撮影室のコンピューター" in text
    assert set("撮影室のコンピューター[2001:db8::1234:5678:9abc:def0]:3020") <= set(text)


def test_on_80_columns_each_stream_that_streams_has_one_line() -> None:
    message = two_streams()
    message.streams[1].state, message.streams[1].frame_rate_hz = "streaming", 2000.0
    lines = printed(found_of(message)).splitlines()
    assert [line.split("  ")[0].strip() for line in lines] == ["source", "lab", ""]
    assert lines[1].rstrip().endswith("192.0.2.20:3020  mocap-pc  1.2.3")


def test_without_a_terminal_there_is_one_line_for_each_source() -> None:
    found = found_of(two_streams(source="b"), status(source="a"))
    assert found.readable_names == ["a", "b"]
    assert printed(found, columns=10, is_terminal=False).splitlines() == [
        "a\tstreaming 200.0 Hz\t3d 6d\t192.0.2.20:3020\tmocap-pc\t1.2.3\t",
        f"b\t{source_report(two_streams()).text}\t3d 6d, analog force\t192.0.2.20:3020\tmocap-pc\t1.2.3\t",
    ]


def test_json_has_the_fields_of_the_reference() -> None:
    found = found_of(status())
    found.add_silent(["hall"])
    stream: dict[str, Any] = {
        "components": ["3d", "6d"],
        "text": "streaming 200.0 Hz",
        "state": "streaming",
        "problem": "",
    }
    stream |= {"rate_hz": 200.0, "tries": 0}
    silent = {"source": "hall", "gateway": None, "problem": "its gateway does not answer", "server": None}
    lab = {"source": "lab", "gateway": None, "problem": "", "server": "192.0.2.20:3020", "host": "mocap-pc"}
    assert found_json(found) == {
        "sources": [
            silent | {"host": None, "version": None, "routers": None, "streams": []},
            lab | {"version": "1.2.3", "routers": None, "streams": [stream]},
        ],
        "num_left_out": 0,
    }


def test_the_routers_between_are_a_column_if_there_are_any() -> None:
    found = FoundSources()
    for gateway, host in (("a1", "a"), ("b2", "b")):
        found.add_status(status(host=host).encode(), "lab", gateway)
    assert tuple(printed(found, columns=120).splitlines()[0].split()) == COLUMNS
    found.add_routers({"a1": ["site-a", "site-b"], "b2": []}.get)
    lines = printed(found, columns=120).splitlines()
    assert tuple(lines[0].split()) == (*COLUMNS, "routers")
    assert lines[1].endswith("site-a → site-b")
    assert [each["routers"] for each in found_json(found)["sources"]] == [["site-a", "site-b"], []]
    assert printed(found, is_terminal=False).splitlines()[0].endswith("\tsite-a → site-b")


def test_two_gateways_with_the_same_source_are_listed_and_the_newest_status_of_each_counts() -> None:
    found = found_of(status(host="a"), status(host="b"), status(host="b", gateway_version="2"))
    assert [(source.host, source.version) for source in found.sources] == [("a", "1.2.3"), ("b", "2")]
    [note] = notes(found)
    assert names(note, "2 gateways", "'lab'", "rename")


OTHER_VERSION = "version"


@pytest.mark.parametrize(
    ("message", "word"),
    [
        (b"", OTHER_VERSION),
        (b"x" * 100, OTHER_VERSION),
        (rtc3d.take_t().encode(), OTHER_VERSION),
        (status_of()[:-7], "read"),
        (status_of() + bytes(MAX_STATUS_BYTES), "long"),
    ],
    ids=["empty", "other program", "other type", "truncated", "too long"],
)
def test_a_status_that_cannot_be_read_is_said(message: bytes, word: str) -> None:
    found = FoundSources()
    found.add_status(message, "lab", "abc")
    [source] = found.sources
    assert (source.name, source.gateway) == ("lab", "abc")
    assert names(source.problem, word)
    assert found.readable_names == []  # nobody waits for its reply to a query
    assert source.problem in printed(found, columns=300)


def test_hostile_texts_do_not_reach_the_terminal() -> None:
    evil = "\x1b[2J\r\n\t" + "x" * 10_000
    message = two_streams(source=evil, server=evil, host=evil, gateway_version=evil)
    message.streams[0].components = message.streams[1].state = evil
    message.streams[0].frame_rate_hz = math.nan
    found = found_of(message)
    line = printed(found, is_terminal=False)
    assert not {"\x1b", "\r"} & set(line + printed(found))
    assert (line.count("\n"), line.count("\t")) == (1, len(COLUMNS))  # and the routers
    assert found_json(found)["sources"][0]["streams"][0]["rate_hz"] is None


def test_thousands_of_sources_are_bounded_and_said() -> None:
    found = found_of(*(status(source=f"lab-{number}") for number in range(MAX_LISTED_SOURCES + 7)))
    assert len(found.sources) == MAX_LISTED_SOURCES
    [note] = notes(found)
    assert names(note, 7)


def test_the_bytes_of_all_statuses_are_bounded() -> None:
    message = status()
    message.streams, message.num_streams = message.streams * 1000, 1000
    data = message.encode()
    found = FoundSources()
    for number in range(1000):
        found.add_status(data, f"lab-{number}")
    assert len(found.sources) * len(data) <= 4 * 1024 * 1024
    assert found.num_left_out == 1000 - len(found.sources)
