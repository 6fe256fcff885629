"""The router and client files that config/ ships, with certificates made as docs/how-to/secure.md says."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import pytest
import zenoh
import zenoh.ext

from gateway.config.environment import variable_name
from tests.configurations import load
from tests.networks import free_port
from tests.waiting import wait_until

ROOT: Final = Path(__file__).parents[2]
CONFIG: Final = ROOT / "config"
FOLDER: Final = "/etc/rtc3d-gateway/tls"
GUIDE: Final = (ROOT / "docs/how-to/secure.md").read_text(encoding="utf-8")
FAKE: Final = b"fake"
PASSWORD: Final = variable_name(("zenoh", "config", "transport", "auth", "usrpwd", "password"))

Change = tuple[str, str]


def make_certificates(folder: Path) -> Path:
    """Run the guide's recipe in a new folder, with this machine's names for the router's."""
    folder.mkdir()
    [recipe] = [block for block in re.findall(r"```sh\n(.*?)```", GUIDE, re.DOTALL) if "openssl" in block]
    recipe, count = re.subn(r'ROUTER=".*"', 'ROUTER="DNS:localhost,IP:127.0.0.1"', recipe)
    assert count == 1
    subprocess.run(["sh", "-euc", recipe], cwd=folder, check=True, capture_output=True, timeout=60)
    return folder


def changed(text: str, *changes: Change) -> str:
    """Return ``text`` with parts of it changed, each of which it must have."""
    for before, after in changes:
        assert before in text, before
        text = text.replace(before, after)
    return text


def shipped(name: str, *changes: Change) -> str:
    return changed((CONFIG / name).read_text(encoding="utf-8"), *changes)


def client_file(port: int, certificates: Path, name: str, *changes: Change) -> str:
    """Return zenoh-mtls.json5 for the owner of the certificate ``name``."""
    return shipped(
        "zenoh-mtls.json5",
        ("192.0.2.10:7447", f"127.0.0.1:{port}"),
        (f"{FOLDER}/gateway.", f"{FOLDER}/{name}."),
        (FOLDER, str(certificates)),
        *changes,
    )


@contextmanager
def session(text: str) -> Iterator[zenoh.Session]:
    """Give an open session; a process that leaves one open never ends."""
    opened = zenoh.open(zenoh.Config.from_json5(text))
    try:
        yield opened
    finally:
        opened.close()


@contextmanager
def program(*arguments: str, log: Path, environ: Mapping[str, str] | None = None) -> Iterator[None]:
    """Run rtc3d-gateway, its output in ``log``, until the end of the block."""
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
def gateway_of_a_simulator(
    folder: Path, zenoh_config: str, environ: Mapping[str, str] | None = None
) -> Iterator[Path]:
    """Run a simulator and a gateway with ``zenoh_config``, in YAML's words; give the gateway's log."""
    with ExitStack() as stack:
        simulator_log, log = folder / "simulator.log", folder / "gateway.log"
        stack.enter_context(program("simulate", "--port", "0", "--rate", "50", log=simulator_log))
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
            program(
                *("run", "--config", str(folder / "gateway.yaml"), "--log-level", "debug"),
                log=log,
                environ=environ,
            )
        )
        yield log


class Heard:
    """What comes on ``keys``."""

    def __init__(self, listener: zenoh.Session, keys: str) -> None:
        self.samples: list[tuple[str, bytes]] = []
        self._subscriber = listener.declare_subscriber(
            keys, lambda sample: self.samples.append((str(sample.key_expr), sample.payload.to_bytes()))
        )

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, payload in self.samples]

    def more(self, count: int = 3) -> None:
        """Wait for so many more samples."""
        before = len(self.samples)
        wait_until(lambda: len(self.samples) >= before + count)


def asked(asker: zenoh.Session, selector: str) -> list[bytes]:
    """Return the good answers to a query; Zenoh ends it with none where nobody may answer."""
    replies = asker.get(selector, timeout=5)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


def alive(asker: zenoh.Session) -> list[str]:
    replies = asker.liveliness().get("mocap/*/alive", timeout=5)
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


@pytest.mark.parametrize("block", re.findall(r"```yaml\n(.*?)```", GUIDE, re.DOTALL))
def test_the_configurations_of_the_guide_are_valid(block: str, tmp_path: Path) -> None:
    (tmp_path / "zenoh-mtls.json5").write_text(shipped("zenoh-mtls.json5"), encoding="utf-8")
    (tmp_path / "gateway.yaml").write_text(block, encoding="utf-8")
    environ = {PASSWORD: "geheim7"} if "usrpwd" in block else {}
    assert load(tmp_path / "gateway.yaml", environ).sources


def test_the_guide_names_the_password_variable() -> None:
    assert f"{PASSWORD}=" in GUIDE


class Lab(NamedTuple):
    """Where the router with access control is, and whose certificates it believes."""

    port: int
    certificates: Path

    def client(self, name: str, *changes: Change) -> str:
        return client_file(self.port, self.certificates, name, *changes)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificates(tmp_path_factory.mktemp("ours") / "tls")


@pytest.fixture(scope="module")
def strange_certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same names, signed by somebody else."""
    return make_certificates(tmp_path_factory.mktemp("strange") / "tls")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory, certificates: Path) -> Iterator[Lab]:
    """A router with access control, a gateway that streams through it, and one viewer who saw that."""
    folder = tmp_path_factory.mktemp("lab")
    port = free_port()
    router = shipped(
        "zenoh-acl.json5", ("tls/[::]:7447", f"tls/127.0.0.1:{port}"), (FOLDER, str(certificates))
    )
    (folder / "zenoh-mtls.json5").write_text(client_file(port, certificates, "gateway"), encoding="utf-8")
    lab = Lab(port, certificates)
    with session(router), gateway_of_a_simulator(folder, "zenoh-mtls.json5"):
        with session(lab.client("viewer")) as viewer:
            Heard(viewer, "mocap/lab/3d").more()
        yield lab


@pytest.fixture
def viewer(lab: Lab) -> Iterator[zenoh.Session]:
    with session(lab.client("viewer")) as opened:
        yield opened


@pytest.fixture
def other_viewer(lab: Lab) -> Iterator[zenoh.Session]:
    with session(lab.client("viewer")) as opened:
        yield opened


def test_a_viewer_receives_data_and_answers(viewer: zenoh.Session) -> None:
    Heard(viewer, "mocap/lab/3d").more()
    Heard(viewer, "mocap/**").more()
    assert len(asked(viewer, "mocap/lab/status")) == 1
    assert asked(viewer, "mocap/lab/parameters")[0].startswith(b"<")
    assert len(asked(viewer, "mocap/lab/*")) > 1
    assert alive(viewer) == ["mocap/lab/alive"]


def test_a_late_viewer_receives_the_parameters(lab: Lab, viewer: zenoh.Session) -> None:
    key = "mocap/other/parameters"
    with session(lab.client("gateway")) as second_gateway:  # as the gateway publishes them, but once only
        publisher = zenoh.ext.declare_advanced_publisher(
            second_gateway, key, cache=zenoh.ext.CacheConfig(max_samples=1), publisher_detection=True
        )
        publisher.put(b"<xml>")
        late: list[bytes] = []
        zenoh.ext.declare_advanced_subscriber(
            viewer,
            key,
            lambda sample: late.append(sample.payload.to_bytes()),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
        )
        wait_until(lambda: late == [b"<xml>"])


def test_a_viewer_receives_error_replies(viewer: zenoh.Session) -> None:
    [reply] = viewer.get("mocap/lab/no-such-thing", timeout=5)
    assert reply.err is not None


def test_a_viewer_cannot_publish(lab: Lab, viewer: zenoh.Session, other_viewer: zenoh.Session) -> None:
    heard = Heard(other_viewer, "mocap/**")
    heard.more()
    for key in ("mocap/lab/3d", "mocap/other"):
        viewer.put(key, FAKE)
        viewer.delete(key)
    assert asked(viewer, "mocap/lab/status")  # the router has taken what came before, in order
    heard.more()
    assert FAKE not in heard.payloads
    assert b"" not in heard.payloads
    with session(lab.client("gateway")) as second_gateway:  # who may, can
        second_gateway.put("mocap/lab/3d", FAKE)
        wait_until(lambda: FAKE in heard.payloads)


def test_a_viewer_cannot_answer_queries(lab: Lab, viewer: zenoh.Session, other_viewer: zenoh.Session) -> None:
    def lie(query: zenoh.Query) -> None:
        with query:
            query.reply(str(query.key_expr), FAKE)

    viewer.declare_queryable("mocap/lab/status", lie, complete=True)
    viewer.declare_queryable("mocap/other/status", lie, complete=True)
    assert asked(viewer, "mocap/lab/parameters")
    assert FAKE not in asked(other_viewer, "mocap/lab/status")
    assert asked(other_viewer, "mocap/other/status") == []
    with session(lab.client("gateway")) as second_gateway:
        second_gateway.declare_queryable("mocap/other/status", lie)
        wait_until(lambda: asked(other_viewer, "mocap/other/status") == [FAKE])


def test_a_viewer_cannot_declare_a_liveliness_token(
    viewer: zenoh.Session, other_viewer: zenoh.Session
) -> None:
    token = viewer.liveliness().declare_token("mocap/other/alive")
    assert asked(viewer, "mocap/lab/status")
    assert alive(other_viewer) == ["mocap/lab/alive"]
    token.undeclare()


@pytest.mark.parametrize("selector", ["mocap/lab/recording?set=start", "mocap/*/recording?set=start"])
def test_a_viewer_cannot_control_a_recording(viewer: zenoh.Session, selector: str) -> None:
    assert list(viewer.get(selector, timeout=5)) == []


def test_a_gateway_receives_nothing_from_another_gateway(lab: Lab, viewer: zenoh.Session) -> None:
    with session(lab.client("gateway")) as second_gateway:
        overheard = Heard(second_gateway, "mocap/**")
        Heard(viewer, "mocap/**").more()
        assert overheard.samples == []
        assert asked(second_gateway, "mocap/lab/status") == []


STRANGERS: Final = {
    "a certificate by somebody else": (),
    "no certificate": (
        ('connect_private_key: "{folder}/viewer.key",', ""),
        ('connect_certificate: "{folder}/viewer.crt",', ""),
        ("enable_mtls: true", "enable_mtls: false"),
    ),
    "no encryption": (("tls/", "tcp/"), ('protocols: ["tls"]', 'protocols: ["tcp"]')),
}


def stranger_file(lab: Lab, certificates: Path, who: str, *changes: Change) -> str:
    """Return the configuration of a stranger, who knows address and authority of the lab's router."""
    named = tuple((before.format(folder=certificates), after) for before, after in STRANGERS[who])
    authority = (f"{certificates}/ca.crt", f"{lab.certificates}/ca.crt")
    return client_file(lab.port, certificates, "viewer", authority, *named, *changes)


@pytest.mark.parametrize("who", STRANGERS)
def test_a_stranger_cannot_connect(lab: Lab, strange_certificates: Path, who: str) -> None:
    text = stranger_file(lab, strange_certificates, who)
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        zenoh.open(zenoh.Config.from_json5(text))


@pytest.mark.parametrize("who", STRANGERS)
def test_a_stranger_receives_no_data_or_answers_and_cannot_publish(
    lab: Lab, viewer: zenoh.Session, strange_certificates: Path, who: str
) -> None:
    # A peer's session opens without any link, and goes on trying: it can be used as if it had one.
    peer: tuple[Change, ...] = (
        ('mode: "client"', 'mode: "peer", listen: { endpoints: [] }'),
        ("period_init_ms: 200, period_max_ms: 500", "period_init_ms: 20, period_max_ms: 20"),
    )
    heard = Heard(viewer, "mocap/**")
    with session(stranger_file(lab, strange_certificates, who, *peer)) as stranger:
        overheard = Heard(stranger, "**")
        heard.more(25)  # half a second, in which the stranger tries again and again
        stranger.put("mocap/lab/3d", FAKE)
        assert asked(stranger, "mocap/lab/status") == []
        assert alive(stranger) == []
        heard.more(25)
        assert {key for key, _ in overheard.samples} == {"mocap/lab/3d"}
        assert overheard.payloads == [FAKE]  # its own, which never left it
    assert FAKE not in heard.payloads


def test_a_valid_certificate_with_an_unknown_name_has_no_access(lab: Lab, viewer: zenoh.Session) -> None:
    heard = Heard(viewer, "mocap/**")
    with session(lab.client("router")) as nobody:
        overheard = Heard(nobody, "mocap/**")
        assert asked(nobody, "mocap/lab/status") == []
        heard.more()
        assert overheard.samples == []
        nobody.put("mocap/lab/3d", FAKE)
        assert asked(nobody, "mocap/lab/status") == []
        heard.more()
    assert FAKE not in heard.payloads


@pytest.mark.parametrize("change", ["ca", "name"])
def test_a_client_rejects_a_router_with_the_wrong_authority_or_name(
    lab: Lab, strange_certificates: Path, change: str
) -> None:
    text = {
        "ca": lab.client("viewer", (f"{lab.certificates}/ca.crt", f"{strange_certificates}/ca.crt")),
        "name": lab.client("viewer", (f"tls/127.0.0.1:{lab.port}", f"tls/127.0.0.2:{lab.port}")),
    }[change]
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        zenoh.open(zenoh.Config.from_json5(text))


def test_the_plain_router_serves_everybody(tmp_path: Path) -> None:
    port = free_port()
    router = shipped(
        "zenoh-router.json5",
        ("tcp/[::]:7447", f"tcp/127.0.0.1:{port}"),
        ("enabled: true, auto", "enabled: false, auto"),
    )
    keys = f"{{mode: client, connect: {{endpoints: [tcp/127.0.0.1:{port}]}}}}"
    with session(router), gateway_of_a_simulator(tmp_path, keys):
        client = f'{{mode: "client", connect: {{endpoints: ["tcp/127.0.0.1:{port}"]}}}}'
        with session(client) as viewer, session(client) as other:
            heard = Heard(viewer, "mocap/**")
            heard.more()
            wait_until(lambda: asked(viewer, "mocap/lab/status"))
            other.put("mocap/lab/3d", FAKE)
            wait_until(lambda: FAKE in heard.payloads)


def test_a_password_from_the_environment_is_used_and_never_shown(tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "users").write_text("gateway:geheim7\n")
    router = (
        f'{{mode: "router", listen: {{endpoints: ["tcp/127.0.0.1:{port}"]}}, '
        "scouting: {multicast: {enabled: false}}, "
        f'transport: {{auth: {{usrpwd: {{dictionary_file: "{tmp_path}/users"}}}}}}}}'
    )
    keys = (
        f"{{mode: client, connect: {{endpoints: [tcp/127.0.0.1:{port}]}}, "
        "transport: {auth: {usrpwd: {user: gateway}}}}"
    )
    client = (
        f'{{mode: "client", connect: {{endpoints: ["tcp/127.0.0.1:{port}"]}}, '
        'transport: {auth: {usrpwd: {user: "gateway", password: "%s"}}}}'
    )
    with session(router):
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            zenoh.open(zenoh.Config.from_json5(client % "wrong"))
        with gateway_of_a_simulator(tmp_path, keys, {PASSWORD: "geheim7"}) as log:
            with session(client % "geheim7") as viewer:
                heard = Heard(viewer, "mocap/lab/status")
                heard.more(1)
            assert "the session is open" in log.read_text()
            assert "geheim7" not in log.read_text()
            assert b"geheim7" not in b"".join(heard.payloads)
