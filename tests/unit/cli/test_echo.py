"""What ``echo`` prints for a message; tests/integration/commands/test_params_command.py runs the command."""

import io
import json

import pytest
import rtc3d

from gateway.cli.echo_messages import MAX_WAITING, Limits, print_messages
from gateway.cli.silence import Silence
from gateway.outputs.kind import Receive, SubscriptionRequest
from tests.spec_parameters import in_root, spec_xml

MARKERS_BYTES = len(spec_xml("3d"))


REQUEST = SubscriptionRequest()


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
    silence = Silence("example", REQUEST)
    published = Published((name, message))
    assert print_messages(published, REQUEST, Limits(1, 10), silence, out, as_json=as_json) == 1
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


@pytest.mark.parametrize(
    ("name", "message", "line"),
    [
        (
            "mocap/lab/parameters",
            spec_xml("3d"),
            f"mocap/lab/parameters {MARKERS_BYTES} bytes of XML: 1 marker",
        ),
        (
            "mocap/lab/parameters",
            in_root("<The_6D/>", "<Analog/>", "<Force/>", "<Events/>"),
            "mocap/lab/parameters 82 bytes of XML: 0 tools, 0 analog channels, 0 force plates, 0 events",
        ),
        (
            "mocap/lab/parameters",
            b"<!-- -->",
            "mocap/lab/parameters 8 bytes of XML that cannot be read as parameters",
        ),
        (
            "mocap/lab/c3d",
            b'{"name":"lab-20260102T030405.678901Z.c3d","bytes":123}',
            "mocap/lab/c3d name lab-20260102T030405.678901Z.c3d, bytes 123",
        ),
        (
            "MOCAP_LAB_PARAMETERS",
            parameters(),
            f"MOCAP_LAB_PARAMETERS #4 session 2, version 3: {MARKERS_BYTES} bytes of XML: 1 marker",
        ),
        (
            "MOCAP_LAB_PARAMETERS_REQUEST",
            request(),
            "MOCAP_LAB_PARAMETERS_REQUEST request 7 from 'viewer': 3d 6d, fresh",
        ),
        (
            "MOCAP_LAB_PARAMETERS_REPLY",
            reply(),
            "MOCAP_LAB_PARAMETERS_REPLY reply 7 to 'viewer': 54 bytes of XML: "
            "no markers, tools, channels, plates or events, 1.2 s old",
        ),
        (
            "MOCAP_LAB_PARAMETERS_REPLY",
            reply("the server is \x1b[31maway"),
            "MOCAP_LAB_PARAMETERS_REPLY reply 7 to 'viewer': the server is \\x1b[31maway",
        ),
    ],
)
def test_a_line_summarises_a_message(name: str, message: bytes, line: str) -> None:
    assert printed(name, message) == line


@pytest.mark.parametrize(
    "message", [b"", b"12345678 of something else", b"[1]", b"[" * 100_000, b"{", b"\xff{"]
)
def test_a_message_of_another_program_is_printed_as_an_error(message: bytes) -> None:
    assert "are not a message of this gateway" in printed("mocap/lab/parameters", message)
    assert "are not a message" in json.loads(printed("mocap/lab/parameters", message, as_json=True))["error"]


def test_json_has_xml_as_text() -> None:
    value = json.loads(printed("mocap/lab/parameters", spec_xml("force"), as_json=True))
    assert value == {"key": "mocap/lab/parameters", "xml": spec_xml("force").decode()}


def test_json_has_the_fields_of_a_json_message() -> None:
    value = json.loads(printed("mocap/lab/c3d", b'{"name":"a.c3d","bytes":1}', as_json=True))
    assert value == {"key": "mocap/lab/c3d", "name": "a.c3d", "bytes": 1}


def test_json_has_the_fields_of_a_request() -> None:
    value = json.loads(printed("MOCAP_LAB_PARAMETERS_REQUEST", request(), as_json=True))
    assert (value["request_id"], value["requester"], value["sections"]) == (7, "viewer", ["3d", "6d"])


def test_messages_that_come_faster_than_they_are_printed_are_counted(
    capsys: pytest.CaptureFixture[str],
) -> None:
    messages = [("mocap/lab/c3d", b'{"n": 1}')] * (MAX_WAITING + 5)
    out = io.StringIO()
    silence = Silence("example", REQUEST)
    assert print_messages(Published(*messages), REQUEST, Limits(7, 10), silence, out, as_json=False) == 7
    assert out.getvalue().count("\n") == 7
    assert capsys.readouterr().err.startswith("5 messages were not printed, because they came faster than")


def test_nothing_is_said_if_everything_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    printed("mocap/lab/c3d", b'{"n": 1}')
    assert capsys.readouterr().err == ""


def test_what_was_not_printed_is_said_at_ctrl_c_too(capsys: pytest.CaptureFixture[str]) -> None:
    class Interrupted(io.StringIO):
        def write(self, _text: str) -> int:
            raise KeyboardInterrupt

    messages = [("mocap/lab/c3d", b'{"n": 1}')] * (MAX_WAITING + 5)
    with pytest.raises(KeyboardInterrupt):
        print_messages(
            Published(*messages),
            REQUEST,
            Limits(None, None),
            Silence("example", REQUEST),
            Interrupted(),
            as_json=False,
        )
    assert capsys.readouterr().err.startswith("5 messages were not printed")
