"""Which packets of clients control recordings, and which names they give them."""

import struct

import pytest

from gateway.outputs.rtc3d.client_filter import asks_for_parameters, recording_control, recording_name
from gateway.rtc3d.commands import ControlRecording
from gateway.rtc3d.packets import Packet
from tests.unit.rtc3d_server.wire import COMMAND, DATA, EVENT


def switch(event_id: int, sign: str = ">", number: int = -1) -> bytes:
    """Return the recording packet of WaveFront's clients (field note 16)."""
    return struct.pack(sign + "IIIiqI", 1, 48, EVENT, number, 0, 1) + struct.pack(
        sign + "iqiii", event_id, 0, -1, -1, -1
    )


@pytest.mark.parametrize("sign", [">", "<"])
@pytest.mark.parametrize("ending", [b"", b"\n"])
def test_the_recording_packet_starts_and_stops(sign: str, ending: bytes) -> None:
    assert recording_control(Packet(DATA, switch(1, sign) + ending)) == ControlRecording(True)
    assert recording_control(Packet(DATA, switch(0, sign) + ending)) == ControlRecording(False)


def test_the_recording_commands_start_and_stop() -> None:
    start = recording_control(Packet(COMMAND, b"Recording Start,file=walk 1.c3d\n"))
    assert start == ControlRecording(True, ",file=walk 1.c3d")
    assert recording_control(Packet(COMMAND, b"recording stop\0")) == ControlRecording(False)


@pytest.mark.parametrize(
    "packet",
    [
        Packet(COMMAND, b"Version 1.0"),
        Packet(COMMAND, b"Recording"),
        Packet(COMMAND, b""),
        Packet(DATA, b"\0\0\0\1"),
        Packet(DATA, switch(2)),
        Packet(DATA, switch(1, number=7)),
        Packet(77, switch(1)),
    ],
)
def test_other_packets_do_not(packet: Packet) -> None:
    assert recording_control(packet) is None


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ("", ""),
        (",file=walk.c3d", "walk"),
        (", File = walk 1.c3d ", "walk 1"),
        (" file=walk", "walk"),
        (",rate=200", ""),
        (r",file=C:\data\walk.c3d", r"C:\data\walk"),
    ],
)
def test_the_name_of_a_recording(options: str, name: str) -> None:
    assert recording_name(options) == name


def test_requests_for_parameters_are_recognised() -> None:
    assert asks_for_parameters(Packet(COMMAND, b"sendparameters 3D\n"))
    assert not asks_for_parameters(Packet(COMMAND, b"SendCurrentFrame"))
    assert not asks_for_parameters(Packet(COMMAND, b""))
    assert not asks_for_parameters(Packet(DATA, b"SendParameters"))
