"""A resolver of names that a test controls."""

import socket
import threading
from typing import Any


class Resolver:
    """Stands for socket.getaddrinfo.

    It waits for ``answers``, and then raises ``error`` or returns ``addresses``. ``names`` are those that
    were looked up.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.addresses = ["127.0.0.1"]
        self.error: BaseException | None = None
        self.answers = threading.Event()
        self.answers.set()

    def __call__(self, host: str, _port: object, **_options: object) -> list[tuple[Any, ...]]:
        self.names.append(host)
        self.answers.wait(60)
        if self.error is not None:
            raise self.error
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in self.addresses]
