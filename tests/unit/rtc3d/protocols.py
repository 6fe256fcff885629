"""Client protocols in a given state, and packets for them to receive."""

from gateway.rtc3d.client_protocol import ClientProtocol
from gateway.rtc3d.commands import AllFrames, Command, StreamFrames
from gateway.rtc3d.components import ComponentType
from tests.servers import ok, packet
from tests.vectors import FULL_FRAME

STREAM = StreamFrames(AllFrames(), (ComponentType.MARKERS,))
FRAME = packet(3, FULL_FRAME["big"])
NO_DATA = packet(4)


def xml(*sections: str) -> bytes:
    """Return an XML packet with these elements of §6, all empty."""
    inside = "".join(f"<{section}/>" for section in sections)
    return packet(2, f"<RT_Parameters Ver='1.00'>{inside}</RT_Parameters>")


def protocol_after(*commands: Command) -> ClientProtocol:
    """Return a protocol that has sent the commands and received acknowledgements of all but the last."""
    protocol = ClientProtocol()
    for command in commands[:-1]:
        protocol.send(command)
        protocol.receive(ok(f"OK-{command}"))
    protocol.send(commands[-1])
    protocol.bytes_to_send()
    return protocol
