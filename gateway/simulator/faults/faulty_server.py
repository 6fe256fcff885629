"""What faults may do to the server and its connections."""

from collections.abc import Callable, Sequence
from typing import Protocol

from gateway.simulator.scene_settings import SceneSettings


class FaultyConnection(Protocol):
    """What a momentary fault may do to a connection."""

    @property
    def number(self) -> int:
        """The connection's number since the server's start, from 1."""
        ...

    def send_unchanged(self, data: bytes) -> None:
        """Send bytes that no fault changes, after all bytes that are waiting."""
        ...

    def disconnect(self, last_data: bytes, *, reset: bool) -> None:
        """Write ``last_data`` before all bytes that are waiting, and end the connection with FIN or RST."""
        ...


class FaultyServer(Protocol):
    """What a fault may do to the server."""

    @property
    def connections(self) -> Sequence[FaultyConnection]:
        """The clients' connections."""
        ...

    def stop_measurement(self) -> None:
        """Stop the measurement, if one is running."""
        ...

    def start_measurement(self) -> None:
        """Start a measurement, unless another fault prevents it."""
        ...

    def change_scene(self, changes: SceneSettings) -> Callable[[], None]:
        """Serve the scenario's scene with changes; return a function that restores the previous scene."""
        ...

    def rename_items(self, prefix: str) -> Callable[[], None]:
        """Put ``prefix`` before the names of markers and tools; return a function that restores the scene."""
        ...

    def crash(self) -> None:
        """End as if the process died."""
        ...

    def restart(self) -> None:
        """Listen again after a crash, unless another fault prevents it."""
        ...
