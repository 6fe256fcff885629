"""A router that requires certificates, with certificates made by the recipe in docs/how-to/secure.md."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import zenoh

from tests.networks import free_port
from tests.waiting import wait_until

ROOT: Final = Path(__file__).parents[1]
CONFIG: Final = ROOT / "config"
FOLDER: Final = "/etc/rtc3d-gateway/tls"
GUIDE: Final = (ROOT / "docs/how-to/secure.md").read_text(encoding="utf-8")

Change = tuple[str, str]


def make_certificates(folder: Path) -> Path:
    """Run the recipe of the guide in a new folder; the router gets the names of this host."""
    folder.mkdir()
    [recipe] = [block for block in re.findall(r"```sh\n(.*?)```", GUIDE, re.DOTALL) if "openssl" in block]
    recipe, count = re.subn(r'ROUTER=".*"', 'ROUTER="DNS:localhost,IP:127.0.0.1"', recipe)
    assert count == 1
    subprocess.run(["sh", "-euc", recipe], cwd=folder, check=True, capture_output=True, timeout=60)
    return folder


def replace_all(text: str, *changes: Change) -> str:
    """Return ``text`` with all changes; it must contain each part that is replaced."""
    for before, after in changes:
        assert before in text, before
        text = text.replace(before, after)
    return text


def shipped_file(name: str, *changes: Change) -> str:
    """Return a file of config/ with changes."""
    return replace_all((CONFIG / name).read_text(encoding="utf-8"), *changes)


def client_file(port: int, certificates: Path, name: str, *changes: Change) -> str:
    """Return zenoh-mtls.json5 with the certificate ``name``."""
    return shipped_file(
        "zenoh-mtls.json5",
        ("192.0.2.10:7447", f"127.0.0.1:{port}"),
        (f"{FOLDER}/gateway.", f"{FOLDER}/{name}."),
        (FOLDER, str(certificates)),
        *changes,
    )


@contextmanager
def open_session(text: str) -> Iterator[zenoh.Session]:
    """Open a session. It must be closed, because a process with an open session does not exit."""
    opened = zenoh.open(zenoh.Config.from_json5(text))
    try:
        yield opened
    finally:
        opened.close()


@contextmanager
def run_program(*arguments: str, log: Path, environ: Mapping[str, str] | None = None) -> Iterator[None]:
    """Run rtc3d-gateway until the end of the block, with its output in ``log``."""
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "gateway", *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            env={**os.environ, **(environ or {})},
        )
        try:
            yield
        finally:
            process.terminate()
            process.wait(timeout=20)


@contextmanager
def run_gateway_with_simulator(
    folder: Path, zenoh_config: str, environ: Mapping[str, str] | None = None
) -> Iterator[Path]:
    """Run a simulator and a gateway with ``zenoh_config``, as YAML; yield its log file once frames arrive."""
    with ExitStack() as stack:
        simulator_log, log = folder / "simulator.log", folder / "gateway.log"
        stack.enter_context(run_program("simulate", "--port", "0", "--rate", "50", log=simulator_log))
        wait_until(lambda: "127.0.0.1:" in simulator_log.read_text())
        [port] = re.findall(r"127\.0\.0\.1:(\d+)", simulator_log.read_text())
        (folder / "gateway.yaml").write_text(
            f"sources: [{{name: lab, host: 127.0.0.1, port: {port}}}]\n"
            f"zenoh: {{config: {zenoh_config}}}\n"
            "lcm: {enabled: false}\n"
            f"spool: {{directory: {folder}/spool}}\n"
            "metrics: {enabled: false}\n",
            encoding="utf-8",
        )
        stack.enter_context(
            run_program(
                *("run", "--config", str(folder / "gateway.yaml"), "--log-level", "debug"),
                log=log,
                environ=environ,
            )
        )
        wait_until(lambda: "→ streaming" in log.read_text())
        yield log


class SecureRouter(NamedTuple):
    """The port of the router with access control, and the folder of the certificates that it trusts."""

    port: int
    certificates: Path

    def client(self, name: str, *changes: Change) -> str:
        return client_file(self.port, self.certificates, name, *changes)


@contextmanager
def run_secure_router(folder: Path, certificates: Path) -> Iterator[SecureRouter]:
    """Run a router with access control, and a gateway that connects to it."""
    port = free_port()
    router_file = shipped_file(
        "zenoh-acl.json5", ("tls/[::]:7447", f"tls/127.0.0.1:{port}"), (FOLDER, str(certificates))
    )
    (folder / "zenoh-mtls.json5").write_text(client_file(port, certificates, "gateway"), encoding="utf-8")
    with open_session(router_file), run_gateway_with_simulator(folder, "zenoh-mtls.json5"):
        yield SecureRouter(port, certificates)
