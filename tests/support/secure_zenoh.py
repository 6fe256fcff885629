"""A router that requires certificates, with certificates of an authority of its own."""

import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import yaml
import zenoh

from gateway.outputs.zenoh.output import TEXTS
from tests.support.configurations import write_config
from tests.support.gateway_process import program, simulator
from tests.support.networks import free_port
from tests.support.waiting import wait_until

ROOT: Final = Path(__file__).parents[2]
CONFIG: Final = ROOT / "config"
FOLDER: Final = "/etc/rtc3d-gateway/tls"
GUIDE: Final = (ROOT / "docs/how-to/secure.md").read_text(encoding="utf-8")

Change = tuple[str, str]


def make_certificates(folder: Path, *certificates: str) -> Path:
    """Make certificates in a new folder; the default is that of docs/how-to/secure.md, for this host."""
    names = certificates or ("router=DNS:localhost,IP:127.0.0.1", "gateway", "viewer")
    command = ("sh", str(CONFIG / "certificates.sh"), str(folder), *names)
    subprocess.run(command, check=True, capture_output=True, timeout=60)
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
def run_gateway_with_simulator(
    folder: Path, zenoh_config: str, environ: Mapping[str, str] | None = None
) -> Iterator[Path]:
    """Run a simulator and a gateway with ``zenoh_config``, as YAML; yield its log file once frames arrive."""
    log = folder / "gateway.log"
    with simulator("--rate", "50", "--analog-rate", "50") as (port, _), log.open("wb") as output:
        zenoh = {"config": yaml.safe_load(zenoh_config)}
        spool = {"directory": str(folder / "spool")}
        config = write_config(folder / "gateway.yaml", port, zenoh=zenoh, spool=spool)
        arguments = ("run", "--config", str(config), "--log-level", "debug")
        with program(*arguments, environ=environ, stdout=output, stderr=output):
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
    with open_session(router_file), run_gateway_with_simulator(folder, "zenoh-mtls.json5") as log:
        wait_until(lambda: TEXTS.opened in log.read_text())
        yield SecureRouter(port, certificates)
