"""config/nginx/rtc3d-gateway.conf in the real nginx, in front of a gateway and a view.

With the password, pages, metrics and viewers work as without nginx. Without it, nothing does.
"""

import base64
import http.client
import json
import socket
import ssl
import subprocess
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from gateway.outputs.zenoh.output import TEXTS
from tests.support.browser import NewPage, chromium, new_page
from tests.support.configurations import write_config
from tests.support.documents import blocks
from tests.support.gateway_process import program
from tests.support.needs import need_programs
from tests.support.networks import free_endpoint, free_port, zenoh_keys
from tests.support.secure_zenoh import Change, make_certificates, replace_all, shipped_file
from tests.support.waiting import wait_until
from tests.view.view_process import view_process

pytestmark = [pytest.mark.netns, pytest.mark.timeout(300)]

__all__ = ["chromium", "new_page"]

NAME: Final = "127.0.0.1"
USER: Final = "viewer"
PASSWORD: Final = "not:simple"  # noqa: S105 - of this test
EVIL: Final = "evil.example"
UPGRADE: Final = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": base64.b64encode(bytes(16)).decode(),
}


class Servers(NamedTuple):
    """The ports on which the view, viewers and the metrics are served on loopback."""

    view: int
    foxglove: int
    metrics: int


def basic(user: str, password: str) -> dict[str, str]:
    return {"Authorization": "Basic " + base64.b64encode(f"{user}:{password}".encode()).decode()}


LOGIN: Final = basic(USER, PASSWORD)


class Proxy(NamedTuple):
    """A running nginx: its ports for the three servers, and its folder."""

    ports: Servers
    folder: Path
    tls: ssl.SSLContext

    @property
    def log(self) -> str:
        return (self.folder / "error.log").read_text() + (self.folder / "access.log").read_text()

    def get(self, port: int, path: str = "/", headers: Mapping[str, str] = LOGIN) -> tuple[int, bytes]:
        """Return status and body; of a WebSocket, the first message."""
        connection = http.client.HTTPSConnection(NAME, port, context=self.tls, timeout=60)
        try:
            connection.request("GET", path, headers=dict(headers))
            response = connection.getresponse()
            if response.status != http.HTTPStatus.SWITCHING_PROTOCOLS:
                return response.status, response.read()
            _, size = response.fp.read(2)
            extended = {126: 2, 127: 8}.get(size, 0)  # RFC 6455, 5.2
            if extended:
                size = int.from_bytes(response.fp.read(extended))
            return response.status, response.fp.read(size)
        finally:
            connection.close()

    def web_socket(self, port: int, headers: Mapping[str, str] = LOGIN) -> tuple[int, bytes]:
        """Ask for a WebSocket; return status and first message. (websockets would use TLS in two threads.)"""
        return self.get(port, "/", {**headers, **UPGRADE, "Sec-WebSocket-Protocol": self.subprotocols[port]})

    @property
    def subprotocols(self) -> dict[int, str]:
        """The subprotocol of each port; no WebSocket is served at that of the metrics."""
        return dict(zip(self.ports, (f"viser-v{version('viser')}", "foxglove.sdk.v1", "none"), strict=True))


@contextmanager
def run_nginx(folder: Path, servers: Servers, *changes: Change) -> Iterator[Proxy]:
    """Run nginx with the shipped file, on free ports of loopback and with a certificate of its own."""
    need_programs("nginx", "openssl", packages="nginx openssl")
    certificates = make_certificates(folder / "tls", f"capture=IP:{NAME}")
    command = ["openssl", "passwd", "-6", "-stdin"]
    hashed = subprocess.run(command, input=PASSWORD, capture_output=True, text=True, check=True).stdout
    (folder / "tls/passwords").write_text(f"{USER}:{hashed}")
    ports = Servers(free_port(), free_port(), free_port())
    text = shipped_file(
        "nginx/rtc3d-gateway.conf",
        *(
            (f"    {shipped} 127.0.0.1:{behind};", f"    {port} 127.0.0.1:{server};")
            for shipped, behind, port, server in zip(
                (8443, 8766, 9465), (8080, 8765, 9464), ports, servers, strict=True
            )
        ),
        *(
            (f"listen {shipped} ssl", f"listen {NAME}:{port} ssl")
            for shipped, port in zip((8443, 8766, 9465), ports, strict=True)
        ),
        *((f"    listen [::]:{shipped} ssl;\n", "") for shipped in (8443, 8766, 9465)),
        ("server_name capture.lab", f"server_name {NAME}"),
        ("/etc/nginx/rtc3d-gateway", certificates.name),  # relative: the folder may have a space
        *changes,
    )
    (folder / "rtc3d-gateway.conf").write_text(text)
    (folder / "nginx.conf").write_text(f"""
        user root; daemon off; worker_processes 1; pid "{folder}/pid";
        error_log "{folder}/error.log" info;
        events {{ }}
        http {{
            access_log "{folder}/access.log";
            client_body_temp_path "{folder}/body"; proxy_temp_path "{folder}/proxy";
            fastcgi_temp_path "{folder}/fastcgi"; scgi_temp_path "{folder}/scgi";
            uwsgi_temp_path "{folder}/uwsgi";
            include "{folder}/rtc3d-gateway.conf";
        }}""")
    with subprocess.Popen(["nginx", "-p", folder, "-e", "error.log", "-c", "nginx.conf"]) as nginx:
        try:
            wait_until(lambda: (folder / "pid").exists() or nginx.poll() is not None)
            assert nginx.poll() is None, (folder / "error.log").read_text()
            yield Proxy(ports, folder, ssl.create_default_context(cafile=certificates / "ca.crt"))
        finally:
            nginx.terminate()


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory, healthy_server: int) -> Iterator[Servers]:
    folder = tmp_path_factory.mktemp("gateway")
    endpoint, foxglove, metrics = free_endpoint(), free_port(), free_port()
    config = write_config(
        folder / "gateway.yaml",
        healthy_server,
        zenoh={"config": zenoh_keys("peer", listen=endpoint)},
        foxglove={"enabled": True, "port": foxglove},
        metrics={"enabled": True, "port": metrics},
    )
    log = folder / "gateway.log"
    with ExitStack() as stack:
        stderr = stack.enter_context(log.open("wb"))
        stack.enter_context(program("run", "--config", str(config), stderr=stderr))
        ready = (TEXTS.opened, "viewers can connect", "→ streaming")
        wait_until(lambda: all(text in log.read_text() for text in ready))
        view = stack.enter_context(view_process("--connect", endpoint))
        yield Servers(int(view.address.rpartition(":")[2]), foxglove, metrics)


# A browser loads more than one page, and all tests come from one address.
_UNLIMITED: Final = ("rate=5r/s", "rate=10000r/s"), ("burst=50", "burst=10000")


@pytest.fixture(scope="module")
def proxy(tmp_path_factory: pytest.TempPathFactory, servers: Servers) -> Iterator[Proxy]:
    with run_nginx(tmp_path_factory.mktemp("nginx"), servers, *_UNLIMITED) as running:
        yield running


def test_with_the_password_all_three_servers_work(proxy: Proxy) -> None:
    status, page = proxy.get(proxy.ports.view)
    assert (status, b"<html" in page) == (200, True)
    status, metrics = proxy.get(proxy.ports.metrics, "/metrics")
    assert (status, b"rtc3d_gateway_" in metrics) == (200, True)
    status, message = proxy.web_socket(proxy.ports.foxglove)
    assert (status, json.loads(message)["op"]) == (101, "serverInfo")
    own_page = {"Origin": f"https://{NAME}:{proxy.ports.view}"}
    status, message = proxy.web_socket(proxy.ports.view, LOGIN | own_page)
    assert (status, bool(message)) == (101, True)


@pytest.mark.parametrize(
    "headers",
    [
        {},
        basic(USER, "wrong"),
        basic(USER, ""),
        basic("nobody", PASSWORD),
        {"Authorization": "Basic !"},
        {"Authorization": f"Bearer {PASSWORD}"},
    ],
    ids=lambda headers: headers.get("Authorization", "none"),
)
def test_without_the_password_nothing_is_served_and_nothing_reaches_a_server(
    proxy: Proxy, headers: dict[str, str]
) -> None:
    for port in proxy.ports:
        assert proxy.get(port, "/metrics", headers)[0] == 401
        assert proxy.web_socket(port, headers)[0] == 401


def test_the_servers_never_see_the_password_and_no_log_has_it(proxy: Proxy, tmp_path: Path) -> None:
    head = f"GET / HTTP/1.1\r\nHost: {NAME}\r\nAuthorization: {LOGIN['Authorization']}\r\n\r\n"
    with socket.create_server((NAME, free_port())) as server:
        behind = Servers(*[server.getsockname()[1]] * 3)
        with run_nginx(tmp_path, behind, *_UNLIMITED) as eavesdropped:
            context = eavesdropped.tls
            with context.wrap_socket(
                socket.create_connection((NAME, eavesdropped.ports.view)), server_hostname=NAME
            ) as client:
                client.sendall(head.encode())
                accepted, _ = server.accept()
                with accepted:
                    request = accepted.recv(65536)
    assert b"Host: 127.0.0.1:" in request
    assert b"Authorization" not in request
    proxy.get(proxy.ports.view, "/", basic(USER, "a guess"))
    wait_until(lambda: "password mismatch" in proxy.log)
    for secret in (PASSWORD, "a guess", LOGIN["Authorization"].removeprefix("Basic ")):
        assert secret not in proxy.log


def test_pages_of_other_sites_are_refused_although_the_browser_sends_the_password(proxy: Proxy) -> None:
    """A browser adds the password to what any page asks of this server."""
    view, foxglove, metrics = proxy.ports
    own = f"https://{NAME}:{view}"
    for origin in (
        f"https://{EVIL}",
        f"https://{EVIL}:{view}",
        f"{own[:-1]}",
        f"https://{EVIL} {own}",
        "null",
    ):
        foreign = LOGIN | {"Origin": origin}
        assert proxy.web_socket(view, foreign)[0] == 403, origin
        assert proxy.web_socket(foxglove, foreign)[0] == (101 if origin.startswith(own[:-1]) else 403), origin
        assert proxy.get(metrics, "/metrics", foreign)[0] == 403, origin
    assert proxy.web_socket(foxglove, LOGIN | {"Origin": "https://app.foxglove.dev"})[0] == 101


def test_a_name_that_leads_to_this_address_is_refused(proxy: Proxy) -> None:
    """With DNS rebinding, Host and Origin are those of the other site, and agree."""
    for port in proxy.ports:
        rebound = {"Host": f"{EVIL}:{port}", "Origin": f"https://{EVIL}:{port}"}
        assert proxy.get(port, "/", LOGIN | rebound)[0] == 421


def test_neither_plain_http_nor_old_tls_gets_an_answer(proxy: Proxy) -> None:
    for port in proxy.ports:
        with socket.create_connection((NAME, port)) as plain:
            plain.sendall(f"GET /metrics HTTP/1.1\r\nHost: {NAME}\r\n\r\n".encode())
            assert plain.recv(65536).startswith(b"HTTP/1.1 400 ")
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    old.check_hostname, old.verify_mode = False, ssl.CERT_NONE
    old.set_ciphers("ALL:@SECLEVEL=0")
    with pytest.deprecated_call():
        old.minimum_version = old.maximum_version = ssl.TLSVersion.TLSv1_1
    with (
        socket.create_connection((NAME, proxy.ports.view)) as connection,
        pytest.raises(ssl.SSLError, match="ALERT_PROTOCOL_VERSION"),
    ):
        old.wrap_socket(connection)


def test_guesses_are_limited_and_each_failed_one_is_logged(tmp_path: Path, servers: Servers) -> None:
    """Beyond the limit, not even the right password is looked at. Here, nothing is added to it meanwhile."""
    with run_nginx(tmp_path, servers, ("rate=5r/s", "rate=1r/m")) as limited:
        guesses = [basic(USER, str(number)) for number in range(60)]
        statuses = [limited.get(limited.ports.metrics, "/metrics", guess)[0] for guess in guesses]
        assert statuses == [401] * 51 + [429] * 9
        assert limited.get(limited.ports.metrics, "/metrics")[0] == 429
        wait_until(lambda: limited.log.count("password mismatch") == 51)


def test_a_slow_handshake_and_a_slow_request_end(tmp_path: Path, servers: Servers) -> None:
    with run_nginx(tmp_path, servers, ("client_header_timeout 10s", "client_header_timeout 1s")) as impatient:
        with socket.create_connection((NAME, impatient.ports.view), timeout=60) as silent:
            assert silent.recv(1) == b""
        connection = socket.create_connection((NAME, impatient.ports.view), timeout=60)
        with impatient.tls.wrap_socket(connection, server_hostname=NAME) as slow:
            slow.sendall(b"GET / HTTP/1.1\r\nHost:")
            assert slow.recv(1) == b""


def test_prometheus_scrapes_with_the_job_of_the_guide(proxy: Proxy, tmp_path: Path) -> None:
    need_programs("prometheus", packages="prometheus")
    [job] = [
        block.text for block in blocks("docs/how-to/secure.md", "yaml") if "scrape_configs" in block.text
    ]
    (tmp_path / "password").write_text(PASSWORD)
    changes = (
        ("/etc/prometheus/rtc3d-gateway.password", str(tmp_path / "password")),
        ("/etc/prometheus/lab-ca.crt", str(proxy.folder / "tls/ca.crt")),
        ("capture.lab:9465", f"{NAME}:{proxy.ports.metrics}"),
    )
    (tmp_path / "prometheus.yml").write_text(f"global: {{scrape_interval: 1s}}\n{replace_all(job, *changes)}")
    address = f"{NAME}:{free_port()}"
    options = ("--config.file=prometheus.yml", "--storage.tsdb.path=data", f"--web.listen-address={address}")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(["prometheus", *options], cwd=tmp_path, **quiet) as prometheus:  # type: ignore[call-overload]

        def is_up() -> bool:
            try:
                with urllib.request.urlopen(f"http://{address}/api/v1/query?query=up") as reply:
                    results = json.load(reply)["data"]["result"]
            except OSError:  # it does not listen yet, or is not ready
                return False
            return [result["value"][1] for result in results] == ["1"]

        try:
            wait_until(is_up)
        finally:
            prometheus.terminate()


@pytest.mark.chromium
def test_a_browser_shows_the_view_and_a_page_can_watch_as_foxglove_does(
    tmp_path: Path, servers: Servers, new_page: NewPage
) -> None:
    """The shipped limits are enough. A viewer that has no field for a password takes it in the address."""
    with run_nginx(tmp_path, servers) as proxy:
        page = new_page(ignore_https_errors=True, http_credentials={"username": USER, "password": PASSWORD})
        page.goto(f"https://{NAME}:{proxy.ports.view}")
        page.get_by_text("live", exact=False).first.wait_for(timeout=60_000)
        address = f"wss://{USER}:{PASSWORD.replace(':', '%3A')}@{NAME}:{proxy.ports.foxglove}"
        script = """address => new Promise((resolve, reject) => {
            const socket = new WebSocket(address, ["foxglove.sdk.v1"]);
            socket.onmessage = event => resolve(event.data);
            socket.onerror = () => reject("refused");
        })"""
        assert json.loads(page.evaluate(script, address))["op"] == "serverInfo"
