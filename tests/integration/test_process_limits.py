"""A gateway process at the limits of the system: it says what is missing, and recovers."""

import json
import resource
import socket
from contextlib import ExitStack
from http.client import HTTPConnection
from pathlib import Path
from typing import Any, Final

import pytest

from tests.configurations import write_config
from tests.gateway_process import program
from tests.networks import free_port
from tests.waiting import wait_until

pytestmark = pytest.mark.netns

NUM_FILES: Final = 60
_TEXT: Final = (
    f"all {NUM_FILES} file descriptors of the gateway are in use, so nobody can connect, and no file"
)


class Lab:
    """A gateway whose RTC3D clients can use up its file descriptors."""

    def __init__(self, folder: Path) -> None:
        self.port, self.metrics_port = free_port(), free_port()
        self.file, self.log = folder / "gateway.yaml", folder / "log"
        rtc3d = {"enabled": True, "ports": {"lab": self.port}}
        write_config(self.file, free_port(), rtc3d=rtc3d, metrics={"port": self.metrics_port})

    def reasons(self) -> list[str]:
        """Return the reasons on /healthz, each on a connection of its own."""
        connection = HTTPConnection("127.0.0.1", self.metrics_port, timeout=20)
        try:
            connection.request("GET", "/healthz")
            body: dict[str, Any] = json.loads(connection.getresponse().read())
        except ConnectionRefusedError:
            return ["it does not listen yet"]
        finally:
            connection.close()
        return list(body["reasons"])

    def lacks_files(self) -> bool:
        return any(reason.startswith(f"gateway: {_TEXT}") for reason in self.reasons())

    def occurrences(self, text: str) -> int:
        return self.log.read_text().count(text)


def _limit_files() -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (NUM_FILES // 2, NUM_FILES))


def test_without_file_descriptors_the_gateway_says_so_and_recovers(tmp_path: Path) -> None:
    """/healthz is wanted most then. The soft limit, which programs start with, is raised to the hard one."""
    lab = Lab(tmp_path)
    with (
        lab.log.open("wb") as log,
        program("run", "--config", str(lab.file), stderr=log, preexec_fn=_limit_files),
        ExitStack() as clients,
    ):
        wait_until(lambda: lab.occurrences("clients can connect to") == 1 and not lab.lacks_files())
        for port in [lab.port] * NUM_FILES + [lab.metrics_port] * 10:
            clients.enter_context(socket.create_connection(("127.0.0.1", port)))
        wait_until(lab.lacks_files)
        assert all(lab.lacks_files() for _ in range(10))
        assert lab.occurrences(_TEXT) == 1
        clients.close()
        wait_until(lambda: not lab.lacks_files())
        with socket.create_connection(("127.0.0.1", lab.port)) as client:
            client.sendall(bytes([0, 0, 0, 11, 0, 0, 0, 1]) + b"Bye")
            assert client.recv(100).endswith(b"bye")
