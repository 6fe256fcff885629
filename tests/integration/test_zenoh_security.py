"""The router and client files in config/, with certificates made by config/certificates.sh."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
import zenoh
import zenoh.ext

from gateway.config.document import variable_name
from gateway.outputs.zenoh.output import TEXTS
from tests.support.networks import free_port
from tests.support.secure_zenoh import (
    GUIDE,
    Change,
    SecureRouter,
    client_file,
    make_certificates,
    open_session,
    run_gateway_with_simulator,
    shipped_file,
)
from tests.support.waiting import wait_until

FAKE: Final = b"fake"
PASSWORD: Final = variable_name(("zenoh", "config", "transport", "auth", "usrpwd", "password"))


class Samples:
    """The samples that a session receives on ``keys``."""

    def __init__(self, session: zenoh.Session, keys: str) -> None:
        self.samples: list[tuple[str, bytes]] = []
        session.declare_subscriber(
            keys, lambda sample: self.samples.append((str(sample.key_expr), sample.payload.to_bytes()))
        )

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, payload in self.samples]

    def wait_for_more(self, count: int = 3) -> None:
        """Wait for ``count`` more samples."""
        before = len(self.samples)
        wait_until(lambda: len(self.samples) >= before + count)


def query(session: zenoh.Session, selector: str) -> list[bytes]:
    """Return the replies to a query without errors; [] if access control blocks it."""
    replies = session.get(selector, timeout=5)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


def alive_tokens(session: zenoh.Session) -> list[str]:
    replies = session.liveliness().get("mocap/*/alive", timeout=5)
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


@pytest.fixture(scope="module")
def strange_certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates with the same names, from another authority."""
    return make_certificates(tmp_path_factory.mktemp("strange") / "tls")


@pytest.fixture
def viewer(secured: SecureRouter) -> Iterator[zenoh.Session]:
    with open_session(secured.client("viewer")) as opened:
        yield opened


@pytest.fixture
def viewers(secured: SecureRouter) -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    with (
        open_session(secured.client("viewer")) as first,
        open_session(secured.client("viewer")) as second,
    ):
        yield first, second


def test_a_viewer_receives_data_and_answers_but_controls_nothing(viewer: zenoh.Session) -> None:
    Samples(viewer, "mocap/lab/3d").wait_for_more()
    Samples(viewer, "mocap/**").wait_for_more()
    assert len(query(viewer, "mocap/lab/status")) == 1
    assert query(viewer, "mocap/lab/parameters")[0].startswith(b"<")
    assert len(query(viewer, "mocap/lab/*")) > 1
    assert alive_tokens(viewer) == ["mocap/lab/alive"]
    [reply] = viewer.get("mocap/lab/no-such-thing", timeout=5)
    assert reply.err is not None
    for key in ("lab/recording?set=start", "*/recording?set=start", "lab/take?set=start", "lab/take"):
        assert list(viewer.get(f"mocap/{key}", timeout=5)) == [], key


def test_a_late_viewer_receives_the_parameters(secured: SecureRouter, viewer: zenoh.Session) -> None:
    key = "mocap/other/parameters"
    late: list[bytes] = []
    # Publish parameters as the gateway does, but only once.
    with open_session(secured.client("gateway")) as second_gateway:
        publisher = zenoh.ext.declare_advanced_publisher(
            second_gateway, key, cache=zenoh.ext.CacheConfig(max_samples=1), publisher_detection=True
        )
        publisher.put(b"<xml>")
        zenoh.ext.declare_advanced_subscriber(
            viewer,
            key,
            lambda sample: late.append(sample.payload.to_bytes()),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
        )
        wait_until(lambda: late == [b"<xml>"])


def test_a_viewer_cannot_publish_or_answer_as_a_gateway_can(
    secured: SecureRouter, viewers: tuple[zenoh.Session, zenoh.Session]
) -> None:
    def reply_with_fake(received: zenoh.Query) -> None:
        with received:
            received.reply(str(received.key_expr), FAKE)

    viewer, other = viewers
    received = Samples(other, "mocap/**")
    received.wait_for_more()
    for key in ("mocap/lab/3d", "mocap/other"):
        viewer.put(key, FAKE)
        viewer.delete(key)
    viewer.declare_queryable("mocap/lab/status", reply_with_fake, complete=True)
    viewer.declare_queryable("mocap/other/status", reply_with_fake, complete=True)
    token = viewer.liveliness().declare_token("mocap/other/alive")
    # The router processes messages in order, so it has processed all of the above before this query.
    assert query(viewer, "mocap/lab/parameters")
    received.wait_for_more()
    assert not {FAKE, b""} & set(received.payloads)
    assert FAKE not in query(other, "mocap/lab/status")
    assert query(other, "mocap/other/status") == []
    assert alive_tokens(other) == ["mocap/lab/alive"]
    token.undeclare()
    with open_session(secured.client("gateway")) as second_gateway:
        of_gateways = Samples(second_gateway, "mocap/**")
        second_gateway.put("mocap/lab/3d", FAKE)
        wait_until(lambda: FAKE in received.payloads)
        second_gateway.declare_queryable("mocap/other/status", reply_with_fake)
        wait_until(lambda: query(other, "mocap/other/status") == [FAKE])
        assert query(second_gateway, "mocap/lab/status") == []
        assert set(of_gateways.payloads) <= {FAKE}  # its own; it receives nothing from another gateway


STRANGERS: Final = {
    "a certificate of another authority": (),
    "no certificate": (
        ('connect_private_key: "{folder}/viewer.key",', ""),
        ('connect_certificate: "{folder}/viewer.crt",', ""),
        ("enable_mtls: true", "enable_mtls: false"),
    ),
    "no encryption": (("tls/", "tcp/"), ('protocols: ["tls"]', 'protocols: ["tcp"]')),
}


def stranger_file(secured: SecureRouter, certificates: Path, who: str, *changes: Change) -> str:
    """Return the configuration of a stranger that knows the address and the authority of the router."""
    own_changes = tuple((before.format(folder=certificates), after) for before, after in STRANGERS[who])
    authority = (f"{certificates}/ca.crt", f"{secured.certificates}/ca.crt")
    return client_file(secured.port, certificates, "viewer", authority, *own_changes, *changes)


def test_strangers_cannot_connect_and_clients_reject_a_strange_router(
    secured: SecureRouter, strange_certificates: Path
) -> None:
    for text in (
        *(stranger_file(secured, strange_certificates, who) for who in STRANGERS),
        secured.client("viewer", (f"{secured.certificates}/ca.crt", f"{strange_certificates}/ca.crt")),
        secured.client("viewer", (f"tls/127.0.0.1:{secured.port}", f"tls/127.0.0.2:{secured.port}")),
    ):
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            zenoh.open(zenoh.Config.from_json5(text))


@pytest.mark.parametrize("who", [*STRANGERS, "a valid certificate with an unknown name"])
def test_a_stranger_receives_no_data_or_answers_and_cannot_publish(
    secured: SecureRouter, viewer: zenoh.Session, strange_certificates: Path, who: str
) -> None:
    # The session of a peer opens without a link and keeps trying to connect.
    peer: tuple[Change, ...] = (
        ('mode: "client"', 'mode: "peer", listen: { endpoints: [] }'),
        ("period_init_ms: 200, period_max_ms: 500", "period_init_ms: 20, period_max_ms: 20"),
    )
    is_known = who not in STRANGERS
    text = secured.client("router") if is_known else stranger_file(secured, strange_certificates, who, *peer)
    viewer_samples = Samples(viewer, "mocap/**")
    with open_session(text) as stranger:
        stranger_samples = Samples(stranger, "**")
        viewer_samples.wait_for_more(25)  # for half a second, in which the stranger retries
        stranger.put("mocap/lab/3d", FAKE)
        assert query(stranger, "mocap/lab/status") == []
        assert alive_tokens(stranger) == []
        viewer_samples.wait_for_more(25)
        own = [("mocap/lab/3d", FAKE)]  # its own message, which the session delivers to itself
        assert stranger_samples.samples == own
    assert FAKE not in viewer_samples.payloads


def test_the_plain_router_serves_everybody(tmp_path: Path) -> None:
    port = free_port()
    router = shipped_file(
        "zenoh-router.json5",
        ("tcp/[::]:7447", f"tcp/127.0.0.1:{port}"),
        ("enabled: true, auto", "enabled: false, auto"),
    )
    keys = f"{{mode: client, connect: {{endpoints: [tcp/127.0.0.1:{port}]}}}}"
    with open_session(router), run_gateway_with_simulator(tmp_path, keys):
        client = f'{{mode: "client", connect: {{endpoints: ["tcp/127.0.0.1:{port}"]}}}}'
        with open_session(client) as viewer, open_session(client) as other:
            received = Samples(viewer, "mocap/**")
            received.wait_for_more()
            wait_until(lambda: query(viewer, "mocap/lab/status"))
            other.put("mocap/lab/3d", FAKE)
            wait_until(lambda: FAKE in received.payloads)


def test_a_password_from_the_environment_is_used_and_never_shown(tmp_path: Path) -> None:
    assert f"{PASSWORD}=" in GUIDE
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
    with open_session(router):
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            zenoh.open(zenoh.Config.from_json5(client % "wrong"))
        with run_gateway_with_simulator(tmp_path, keys, {PASSWORD: "geheim7"}) as log:
            with open_session(client % "geheim7") as viewer:
                received = Samples(viewer, "mocap/lab/status")
                received.wait_for_more(1)
            assert TEXTS.opened in log.read_text()
            assert "geheim7" not in log.read_text()
            assert b"geheim7" not in b"".join(received.payloads)
