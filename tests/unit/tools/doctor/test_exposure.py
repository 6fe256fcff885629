"""What ``doctor --exposure`` makes of ports: findings, their results, and JSON."""

import json
import re
from pathlib import Path
from typing import Any, Final

import pytest

from gateway.config.settings import MetricsSettings, SourceSettings
from gateway.outputs.adapters.vrpn.settings import VrpnSettings
from gateway.outputs.findings import Finding, Result
from gateway.outputs.open_ports import Access, OpenPort
from gateway.tools.doctor.exposure import ExposedPort, exposed_ports, exposure_findings, exposure_json
from gateway.tools.doctor.reach import Reach
from tests.support.configurations import make_settings
from tests.support.findings import is_finding

ROOT: Final = Path(__file__).parents[4]
PORT: Final = OpenPort("tcp", "::", 7447, Access.CONTROL, "peers publish", "Do this.")
EVERYBODY: Final = ExposedPort("zenoh", PORT, Reach.EVERY_NETWORK, "every network", True)
SOURCE: Final = SourceSettings(name="lab", host="192.0.2.20", remote_control=True)


def settings(**sections: Any) -> Any:
    off = {name: {"enabled": False} for name in ("zenoh", "lcm")}
    return make_settings(sources=(SOURCE,), **(off | sections))


@pytest.mark.parametrize(
    ("access", "authentication", "reach", "result"),
    [
        (Access.CONTROL, "", Reach.EVERY_NETWORK, Result.FAILING),
        (Access.CONTROL, "", Reach.ONE_NETWORK, Result.FAILING),
        (Access.CONTROL, "", Reach.THIS_COMPUTER, Result.PASSING),
        (Access.CONTROL, "password", Reach.EVERY_NETWORK, Result.PASSING),
        (Access.PUBLISH, "", Reach.ONE_NETWORK, Result.WARNING),
        (Access.READ, "", Reach.ONE_NETWORK, Result.WARNING),
        (Access.NOTHING, "", Reach.EVERY_NETWORK, Result.PASSING),
    ],
)
def test_only_control_for_strangers_fails(
    access: Access, authentication: str, reach: Reach, result: Result
) -> None:
    """Encryption alone keeps nobody out."""
    port = PORT._replace(access=access, authentication=authentication, encryption="TLS")
    assert EVERYBODY._replace(port=port, reach=reach).result is result


def test_a_finding_says_who_reaches_a_port_what_for_and_what_to_do() -> None:
    assert EVERYBODY.finding == Finding(
        "zenoh",
        "tcp 7447",
        Result.FAILING,
        ":: (open now): every network; peers publish; they can start and stop recordings and takes; "
        "no encryption, no password",
        "Do this.",
    )
    port = PORT._replace(port=0, access=Access.READ, encryption="TLS", authentication="password")
    finding = EVERYBODY._replace(port=port, is_in_use=None).finding
    assert finding[1:] == (
        "tcp any",
        Result.PASSING,
        ":: (a new port at each start): every network; peers publish; TLS, password",
        "",
        "",
    )


def test_the_ports_are_those_of_the_metrics_of_enabled_outputs_and_of_the_view() -> None:
    ports = [*exposed_ports(settings(takes={"enabled": True}, vrpn=VrpnSettings(enabled=True)), ("::", 8080))]
    assert [(port.subject, port.port.protocol, port.port.port) for port in ports] == [
        ("metrics", "tcp", 9464),
        ("vrpn", "tcp", 3883),
        ("vrpn", "udp", 3883),
        ("view", "tcp", 8080),
    ]
    without_metrics = settings(takes={"enabled": True}, metrics=MetricsSettings(enabled=False))
    assert [*exposed_ports(without_metrics)] == []
    [finding] = exposure_findings(without_metrics, [])
    assert is_finding(finding, "takes", "ports", Result.PASSING)


def test_the_json_has_each_port_with_its_result() -> None:
    assert json.loads(exposure_json([EVERYBODY])) == {
        "ok": False,
        "ports": [
            {
                "output": "zenoh",
                "protocol": "tcp",
                "host": "::",
                "port": 7447,
                "access": "control",
                "purpose": "peers publish",
                "remedy": "Do this.",
                "interface": "",
                "encryption": "",
                "authentication": "",
                "reach": "every network",
                "is_open": True,
                "result": "red",
            }
        ],
    }
    assert json.loads(exposure_json([]))["ok"]


def test_remedies_lead_to_sections_of_the_documents() -> None:
    """Every output is on, so that each remedy appears."""
    outputs = {
        name: {"enabled": True} for name in ("zenoh", "lcm", "vrpn", "lsl", "foxglove", "ros2", "takes")
    }
    everything = settings(**outputs, rtc3d={"enabled": True, "ports": {"lab": 3120}})
    remedies = {port.port.remedy for port in exposed_ports(everything, ("::", 8080))} - {""}
    assert len(remedies) > 5
    for remedy in remedies:
        [(document, anchor)] = re.findall(r"(docs/\S+)#([\w-]+)", remedy)
        headings = re.findall("^#+ (.+)", (ROOT / document).read_text(encoding="utf-8"), re.MULTILINE)
        assert anchor in {re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in headings}, remedy
