"""What ``echo`` prints for a message; tests/integration/commands/test_params_command.py runs the command."""

import io
import json
from contextlib import nullcontext

import pytest
import rtc3d

from gateway.cli.echo_messages import MAX_WAITING, Limits, print_messages
from gateway.cli.echo_sources import Silence, Units
from gateway.outputs.kind import Receive, SubscriptionRequest
from tests.spec_parameters import in_root, spec_xml

MARKERS_BYTES = len(spec_xml("3d"))


REQUEST = SubscriptionRequest()
UNITS = Units("example", REQUEST)


class Published:
    """A subscription that has received these messages at once."""

    def __init__(self, *messages: tuple[str, bytes]) -> None:
        self._messages = messages

    def __call__(self, _request: SubscriptionRequest, receive: Receive) -> "Published":
        for name, message in self._messages:
            receive(name, message)
        return self

    def close(self) -> None:
        """Do nothing."""


def printed(name: str, message: bytes, *, as_json: bool = False) -> str:
    out = io.StringIO()
    published = Published((name, message))
    silence = Silence("example", REQUEST)
    assert print_messages(published, REQUEST, Limits(1, 10), silence, UNITS, out, as_json=as_json) == 1
    return out.getvalue().removesuffix("\n")


def parameters() -> bytes:
    message = rtc3d.parameters_t()
    message.sequence, message.session, message.xml = 4, 2, spec_xml("3d").decode()
    message.parameters_version = 3
    return bytes(message.encode())


def request() -> bytes:
    message = rtc3d.parameters_request_t()
    message.request_id, message.requester, message.fresh = 7, "viewer", True
    message.sections, message.num_sections = ["3d", "6d"], 2
    return bytes(message.encode())


def reply(error: str = "") -> bytes:
    message = rtc3d.parameters_reply_t()
    message.request_id, message.requester, message.age_s, message.error = 7, "viewer", 1.25, error
    message.xml = "" if error else in_root("<General/>").decode()
    return bytes(message.encode())


NO_ITEMS = in_root("<The_6D/>", "<Analog/>", "<Force/>", "<Events/>")
FILE = b'{"name":"lab-1.c3d","bytes":123}'
PARAMETERS = "MOCAP_LAB_PARAMETERS"


@pytest.mark.parametrize(
    ("name", "message", "text"),
    [
        ("mocap/lab/parameters", spec_xml("3d"), f"{MARKERS_BYTES} bytes of XML: 1 marker"),
        ("m", NO_ITEMS, "82 bytes of XML: 0 tools, 0 analog channels, 0 force plates, 0 events"),
        ("mocap/lab/parameters", b"<!-- -->", "8 bytes of XML that cannot be read as parameters"),
        ("mocap/lab/c3d", FILE, "name lab-1.c3d, bytes 123"),
        (PARAMETERS, parameters(), f"#4 session 2, version 3: {MARKERS_BYTES} bytes of XML: 1 marker"),
        (f"{PARAMETERS}_REQUEST", request(), "request 7 from 'viewer': 3d 6d, fresh"),
        (
            f"{PARAMETERS}_REPLY",
            reply(),
            "reply 7 to 'viewer': 54 bytes of XML: no markers, tools, channels, plates or events, 1.2 s old",
        ),
        (f"{PARAMETERS}_REPLY", reply("it is \x1b[31maway"), "reply 7 to 'viewer': it is \\x1b[31maway"),
    ],
    ids=range(8),
)
def test_a_line_summarises_a_message(name: str, message: bytes, text: str) -> None:
    assert printed(name, message) == f"{name} {text}"


@pytest.mark.parametrize(
    "message", [b"", b"12345678 of something else", b"[1]", b"[" * 100_000, b"{", b"\xff{"]
)
def test_a_message_of_another_program_is_printed_as_an_error(message: bytes) -> None:
    assert "are not a message of this gateway" in printed("mocap/lab/parameters", message)
    assert "are not a message" in json.loads(printed("mocap/lab/parameters", message, as_json=True))["error"]


def test_json_has_xml_as_text_and_the_fields_of_other_messages() -> None:
    value = json.loads(printed("mocap/lab/parameters", spec_xml("force"), as_json=True))
    assert value == {"key": "mocap/lab/parameters", "xml": spec_xml("force").decode()}
    value = json.loads(printed("mocap/lab/c3d", FILE, as_json=True))
    assert value == {"key": "mocap/lab/c3d", "name": "lab-1.c3d", "bytes": 123}
    value = json.loads(printed("MOCAP_LAB_PARAMETERS_REQUEST", request(), as_json=True))
    assert (value["request_id"], value["requester"], value["sections"]) == (7, "viewer", ["3d", "6d"])


class Interrupted(io.StringIO):
    def write(self, _text: str) -> int:
        raise KeyboardInterrupt


@pytest.mark.parametrize("is_interrupted", [False, True])
def test_messages_that_come_faster_than_they_are_printed_are_counted(
    is_interrupted: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    printed("mocap/lab/c3d", b'{"n": 1}')
    assert capsys.readouterr().err == ""
    published = Published(*[("mocap/lab/c3d", b'{"n": 1}')] * (MAX_WAITING + 5))
    out = Interrupted() if is_interrupted else io.StringIO()
    with pytest.raises(KeyboardInterrupt) if is_interrupted else nullcontext():
        silence = Silence("example", REQUEST)
        assert print_messages(published, REQUEST, Limits(7, 10), silence, UNITS, out, as_json=False) == 7
        assert out.getvalue().count("\n") == 7
    assert capsys.readouterr().err.startswith("5 messages were not printed, because they came faster than")
