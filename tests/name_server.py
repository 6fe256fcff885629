"""A name server that never answers, for one program in a network namespace (marker netns)."""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

_ADDRESS: Final = ("127.0.0.53", 53)
_TIMEOUT_S: Final = 30
"""How long a program waits for an answer: longer than a busy computer delays what does not wait for it."""

_USE_FILE: Final = 'mount --bind "$1" /etc/resolv.conf && shift && exec "$@"'


@contextlib.contextmanager
def dead_name_server(
    folder: Path,
    options: str = f"timeout:{_TIMEOUT_S}",
    serve: Callable[[socket.socket], None] | None = None,
) -> Iterator[tuple[str, ...]]:
    """Run the server; yield what to put before a command whose names it should resolve.

    The command gets a file /etc/resolv.conf of its own, in a mount namespace. ``serve`` may answer after all,
    in a thread.
    """
    file = folder / "resolv.conf"
    file.write_text(f"nameserver {_ADDRESS[0]}\noptions {options}\n")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(_ADDRESS)
        if serve is not None:
            threading.Thread(target=serve, args=(server,), daemon=True).start()
        yield ("unshare", "--mount", "sh", "-c", _USE_FILE, "with-resolv-conf", str(file))
