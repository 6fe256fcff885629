"""A TCP relay for LCM (``tcpq://``), as LCM's own lcm-tcpq-server: passes messages on to subscribers."""

import contextlib
import re
import socket
import struct
import threading
from typing import BinaryIO, Final

_HELLO: Final = struct.pack(">II", 0x287617FB, 0x0100)
"""What a client sends first: a magic number and the version of the protocol."""
_WELCOME: Final = struct.pack(">II", 0x287617FA, 0x0100)
_PUBLISH, _SUBSCRIBE = 1, 2
_RECEIVE_BUFFER_BYTES: Final = 4096
"""Small, so that a relay that does not read blocks its client soon."""


class LcmRelay:
    """Relays between all clients of one port, which stays the same over ``close`` and ``open``.

    ``stop_reading`` leaves the connections open and reads nothing more until ``read_again``.
    """

    def __init__(self) -> None:
        self._port = 0
        self.num_published = 0
        self._reads = threading.Event()
        self._reads.set()
        self._lock = threading.Lock()  # of the clients and their sockets
        self._clients: dict[socket.socket, list[re.Pattern[str]]] = {}
        self.open()

    @property
    def url(self) -> str:
        """The LCM URL of this relay."""
        return f"tcpq://127.0.0.1:{self._port}"

    @property
    def subscribed(self) -> list[str]:
        """The channels, as regular expressions, of all open connections' subscriptions."""
        with self._lock:
            return [pattern.pattern for patterns in self._clients.values() for pattern in patterns]

    def open(self) -> None:
        """Accept connections."""
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        self._listener.bind(("127.0.0.1", self._port))
        self._listener.listen()
        self._port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def close(self) -> None:
        """Close all connections and accept no more."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes the thread in accept
        self._listener.close()
        with self._lock:
            for client in self._clients:
                with contextlib.suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)
        self._reads.set()

    def stop_reading(self) -> None:
        """Read nothing from the clients."""
        self._reads.clear()

    def read_again(self) -> None:
        """Read from the clients again."""
        self._reads.set()

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                with self._lock:
                    self._clients[client] = []
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        try:
            with client, client.makefile("rb") as stream:
                assert stream.read(len(_HELLO)) in (_HELLO, b"")
                client.sendall(_WELCOME)
                while header := stream.read(4):
                    self._reads.wait()
                    self._handle(client, int.from_bytes(header), _text(stream), stream)
        except OSError:
            pass
        finally:
            with self._lock:
                del self._clients[client]

    def _handle(self, client: socket.socket, kind: int, channel: bytes, stream: BinaryIO) -> None:
        if kind == _SUBSCRIBE:
            with self._lock:
                self._clients[client].append(re.compile(channel.decode()))
        elif kind == _PUBLISH:
            self._pass_on(channel, _text(stream))
            self.num_published += 1

    def _pass_on(self, channel: bytes, message: bytes) -> None:
        packet = struct.pack(">II", _PUBLISH, len(channel)) + channel
        packet += struct.pack(">I", len(message)) + message
        with self._lock:
            for client, patterns in self._clients.items():
                if any(pattern.fullmatch(channel.decode()) for pattern in patterns):
                    client.sendall(packet)


def _text(stream: BinaryIO) -> bytes:
    return stream.read(int.from_bytes(stream.read(4)))
