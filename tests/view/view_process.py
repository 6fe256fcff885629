"""``rtc3d-gateway view`` as a process of its own."""

import re
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import msgspec
import viser
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from tests.gateway_process import program
from tests.waiting import wait_until

_ADDRESS: Final = re.compile(r"http://[\w.:]+")
_PROTOCOL: Final = Subprotocol(f"viser-v{viser.__version__}")
_REQUEST: Final = (
    "GET / HTTP/1.1\r\nHost: {address}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Protocol: "
    f"{_PROTOCOL}\r\n\r\n"
)


class ViewProcess:
    """A running view, its address for browsers, and what it has printed so far."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.output = ""
        assert process.stdout is not None
        while not (found := _ADDRESS.search(self.output)):
            line = process.stdout.readline()
            assert line, f"view ended: {self.output}"
            self.output += line
        self.address = found[0]

    @property
    def memory_mb(self) -> float:
        """Its memory that is not shared with files, in MB."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        [anonymous_kb] = re.findall(r"RssAnon:\s+(\d+) kB", status)
        return int(anonymous_kb) / 1000

    def end(self, number: signal.Signals = signal.SIGINT) -> int:
        """Stop it; return its exit status. ``output`` is complete then."""
        self.process.send_signal(number)
        rest, _ = self.process.communicate(timeout=60)
        self.output += rest
        return self.process.returncode


@contextmanager
def view_process(*arguments: str) -> Iterator[ViewProcess]:
    """Run ``view`` with these arguments, on a free port, until the end of the block."""
    options = ("--port", "0", "--no-browser", *arguments)
    with program("view", *options, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        yield ViewProcess(process)


_CAMERA: Final = msgspec.msgpack.encode(
    {
        "type": "ViewerCameraMessage",
        "wxyz": (1.0, 0.0, 0.0, 0.0),
        "position": (3.0, 3.0, 3.0),
        "fov": 1.3,
        "near": 0.01,
        "far": 1000.0,
        "image_height": 320,
        "image_width": 480,
        "look_at": (0.0, 0.0, 0.0),
        "up_direction": (0.0, 0.0, 1.0),
    }
)
"""What a page sends first: where its camera stands."""

_FRAME: Final = b"\x82\xfe" + len(_CAMERA).to_bytes(2) + bytes(4) + _CAMERA  # masked with zeros (RFC 6455)


class Viewer:
    """A viewer without a browser: it reads what a page would get, and counts the packages."""

    def __init__(self, view: ViewProcess) -> None:
        address = view.address.replace("http:", "ws:")
        self._connection = connect(address, subprotocols=[_PROTOCOL], compression=None, max_size=None)
        self._connection.send(_CAMERA)
        self.num_received = 0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for _ in self._connection:
            self.num_received += 1

    def wait_for_updates(self, count: int) -> None:
        """Wait for ``count`` further packages."""
        goal = self.num_received + count
        wait_until(lambda: self.num_received >= goal)

    def leave(self) -> None:
        """Disconnect."""
        self._connection.close()
        self._thread.join()


@contextmanager
def viewer_that_does_not_read(view: ViewProcess) -> Iterator[None]:
    """Connect as a page does during the block, and read nothing but the first answer."""
    host, port = view.address.removeprefix("http://").split(":")
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect((host, int(port)))
        connection.sendall(_REQUEST.format(address=f"{host}:{port}").encode())
        assert connection.recv(64).startswith(b"HTTP/1.1 101")
        connection.sendall(_FRAME)
        yield
