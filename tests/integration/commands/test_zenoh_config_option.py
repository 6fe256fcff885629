"""--zenoh-config of ``echo``, ``params`` and ``doctor``: certificates of viewers and of the gateway."""

import json
import re
from pathlib import Path

import pytest

from gateway.outputs.zenoh.output import TEXTS
from tests.support.commands import run_command
from tests.support.configurations import write_config
from tests.support.errors import names
from tests.support.networks import free_port
from tests.support.secure_zenoh import SecureRouter, run_gateway_with_simulator
from tests.support.waiting import wait_until


def test_connect_replaces_the_address_in_the_file(secured: SecureRouter, tmp_path: Path) -> None:
    """With a viewer's certificate, every command works."""
    file = tmp_path / "viewer.json5"
    file.write_text(secured.client("viewer", (f"tls/127.0.0.1:{secured.port}", "tls/127.0.0.1:9")))
    config, connect = ("--zenoh-config", str(file)), ("--connect", f"tls/127.0.0.1:{secured.port}")
    assert run_command("params", *config, "--timeout", "2").status == 3
    params = run_command("params", "3d", *config, *connect, "--json")
    assert (params.status, params.stderr) == (0, "")
    assert '"lab"' in params.stdout
    assert run_command("list", *config, *connect).stdout.startswith("lab\t")
    echo = ("echo", *config, *connect, "--component", "3d", "--count", "2", "--seconds", "20")
    printed = run_command(*echo)
    assert (printed.status, printed.stderr, len(printed.stdout.splitlines())) == (0, "", 2)
    unknown = run_command(*echo, "--source", "hall")
    assert unknown[:2] == (3, "")
    assert names(unknown[2], "'hall'", "lab")


def test_a_file_that_zenoh_rejects_is_named(tmp_path: Path) -> None:
    file = tmp_path / "viewer.json5"
    file.write_text("{ mode: 7 }")
    for command in ("echo", "params", "list"):
        result = run_command(command, "--zenoh-config", str(file))
        assert result.status == 2
        assert names(result.stderr, file)
        assert "Traceback" not in result.stderr
    config = write_config(tmp_path / "gateway.yaml", 9, zenoh={}, lcm={})
    link = doctor(config, "--zenoh-config", str(file))["link"]
    assert link["result"] == "red"
    assert names(link["found"], file)


@pytest.mark.parametrize("command", ["echo", "params", "list"])
def test_a_zenoh_file_is_not_for_lcm(command: str, tmp_path: Path) -> None:
    result = run_command(command, "--lcm", "--zenoh-config", str(tmp_path))
    assert result.status == 2
    assert re.search("--zenoh-config (is|are) for", result.stderr)


def doctor(config: Path, *arguments: str) -> dict[str, dict[str, str]]:
    """Return the doctor's findings about Zenoh, by check."""
    result = run_command("doctor", "--config", str(config), "--no-connect", "--json", *arguments)
    assert result.stderr == ""
    findings = json.loads(result.stdout)["findings"]
    return {each["check"]: each for each in findings if each["subject"] == "zenoh"}


def test_the_doctor_works_with_the_gateways_and_with_a_viewers_certificate(
    secured: SecureRouter, tmp_path: Path
) -> None:
    """The gateway's certificate may publish only: a viewer's is needed to see the gateway."""
    (tmp_path / "gateway.json5").write_text(secured.client("gateway"), encoding="utf-8")
    (tmp_path / "viewer.json5").write_text(secured.client("viewer"), encoding="utf-8")
    config = write_config(tmp_path / "gateway.yaml", 9, zenoh={"config": "gateway.json5"})
    findings = doctor(config)
    assert names(findings["link"]["found"], "a router")
    assert findings["gateway"]["result"] == "not tested"
    findings = doctor(config, "--zenoh-config", str(tmp_path / "viewer.json5"))
    assert names(findings["link"]["found"], "a router")
    assert names(findings["gateway"]["found"], "lab")


@pytest.mark.parametrize(("host", "name"), [("127.0.0.1", "router"), ("[::]", "gateway")])
def test_the_commands_show_the_certificate_of_a_gateway_that_listens(
    certificates: Path, tmp_path: Path, host: str, name: str
) -> None:
    """The gateway itself requires certificates and has rules; it has none for connections that it opens.

    If it listens on all addresses, its certificate need not contain that of this computer.
    """
    port = free_port()
    file = tmp_path / "zenoh.json5"
    common = 'permission: "allow", key_exprs: ["mocap/**"]'
    asked = '"declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"'
    said = '"put", "declare_queryable", "reply", "liveliness_token"'
    file.write_text(
        f"""{{
          mode: "peer", id: "abc1", listen: {{ endpoints: ["tls/{host}:{port}"] }},
          scouting: {{ multicast: {{ enabled: false }} }},
          transport: {{ link: {{ tls: {{
            root_ca_certificate: "{certificates}/ca.crt", enable_mtls: true,
            listen_private_key: "{certificates}/{name}.key", listen_certificate: "{certificates}/{name}.crt",
          }} }} }},
          access_control: {{ enabled: true, default_permission: "deny",
            rules: [
              {{ id: "asked", flows: ["ingress"], messages: [{asked}], {common} }},
              {{ id: "said", flows: ["egress"], messages: [{said}], {common} }},
            ],
            subjects: [{{ id: "lab", cert_common_names: ["{name}"] }}],
            policies: [{{ subjects: ["lab"], rules: ["asked", "said"] }}],
          }},
        }}""",
        encoding="utf-8",
    )
    with run_gateway_with_simulator(tmp_path, "zenoh.json5") as log:
        wait_until(lambda: TEXTS.opened in log.read_text())
        findings = doctor(tmp_path / "gateway.yaml")
        assert names(findings["link"]["found"], "0 routers and 1 peer")
        assert names(findings["gateway"]["found"], "lab")
        params = run_command("params", "3d", "--zenoh-config", str(file), "--json")
        assert (params.status, params.stderr) == (0, "")
