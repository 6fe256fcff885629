"""Why a TLS connection fails, with real routers and certificates of the recipe in docs/how-to/secure.md."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from gateway.outputs.zenoh.tls_checks import tls_problem
from tests.support.errors import names
from tests.support.networks import free_endpoint, free_port, open_zenoh
from tests.support.secure_zenoh import FOLDER, SecureRouter, make_certificates, open_session, shipped_file


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return two folders with certificates of different authorities."""
    base = tmp_path_factory.mktemp("certificates")
    return [make_certificates(base / name) for name in ("ours", "other")]


def problem(router: SecureRouter, certificates: Path) -> str:
    """Return the problem of a viewer with the certificates of this folder."""
    text = router.client("viewer", (str(router.certificates), str(certificates)))
    return tls_problem(f"tls/127.0.0.1:{router.port}", zenoh.Config.from_json5(text))


@contextmanager
def run_router(certificates: Path) -> Iterator[SecureRouter]:
    port = free_port()
    changes = (("tls/[::]:7447", f"tls/127.0.0.1:{port}"), (FOLDER, str(certificates)))
    with open_session(shipped_file("zenoh-acl.json5", *changes)):
        yield SecureRouter(port, certificates)


def test_each_problem_of_a_certificate_is_named(folders: list[Path]) -> None:
    ours, other = folders
    with run_router(ours) as router:
        port = router.port
        assert problem(router, ours) == ""
        assert names(problem(router, other), f"127.0.0.1:{port}", "root_ca_certificate")
        assert "root_ca_certificate" in problem(router, ours / "missing")
        mixed = router.client("viewer", (f"{ours}/viewer.", f"{other}/viewer."))
        found = tls_problem(f"tls/127.0.0.1:{port}", zenoh.Config.from_json5(mixed))
        assert names(found, f"127.0.0.1:{port}", "connect_certificate")
    assert names(problem(router, ours), f"127.0.0.1:{port}", os.strerror(errno.ECONNREFUSED))


def test_a_certificate_for_another_name_is_not_accepted(tmp_path: Path) -> None:
    folder = make_certificates(tmp_path / "tls", "router=DNS:elsewhere.example", "viewer")
    with run_router(folder) as router:
        assert "not valid for '127.0.0.1'" in problem(router, folder)


def test_an_endpoint_without_tls_is_not_tried() -> None:
    assert tls_problem("tcp/127.0.0.1:1", zenoh.Config()) == ""


def test_a_port_that_does_not_speak_tls_is_named(folders: list[Path]) -> None:
    endpoint = free_endpoint()
    port = int(endpoint.rpartition(":")[2])
    with open_zenoh("router", listen=endpoint):
        assert names(problem(SecureRouter(port, folders[0]), folders[0]), f"127.0.0.1:{port}", "TLS")
