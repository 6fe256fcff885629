"""Parameters of servers as outputs get them."""

from gateway.config.settings import SourceSettings
from gateway.descriptions.source_frame import source_frame
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.parameters import Parameters


def in_metres(parameters: Parameters, source: str = "lab") -> ServerParameters:
    """Return parameters of a source without a transform: poses are in metres, in the server's axes."""
    frame = source_frame(SourceSettings(name=source, host="192.0.2.20"), parameters)
    return ServerParameters(b"", 1, 1, parsed=parameters, frame=frame)
