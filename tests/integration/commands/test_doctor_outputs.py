"""The doctor's findings and remedies for Zenoh, LCM and this computer, and the command ``doctor``."""

import json
import re
import socket
from pathlib import Path
from typing import Any

import pytest

from gateway.findings import Finding, MessageLoad, Result
from gateway.outputs.lcm import checks as lcm_checks
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.registry import OUTPUTS
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests import networks
from tests.command_process import run
from tests.findings import Findings, lab, run_doctor

# Zenoh.

NO_GATEWAY = (
    "found no gateway that serves lab; if one is running, check its zenoh.prefix and the router's access "
    "rules"
)
NO_ROUTER_REMEDY = (
    "Start zenohd at that address, or correct connect/endpoints in zenoh.config. With TLS, check that all "
    "certificates come from one authority, have not expired and contain the address."
)


async def check_zenoh(**keys: Any) -> Findings:
    """Return the findings with these Zenoh settings and a source whose server is off."""
    return await run_doctor(lab(networks.free_port()), zenoh_settings=ZenohSettings(**keys))


async def test_disabled_zenoh_is_not_tested() -> None:
    assert (await check_zenoh(enabled=False)).not_tested("link", "gateway", subject="zenoh") == {
        "zenoh.enabled is false"
    }


async def test_a_client_without_its_router_fails() -> None:
    endpoint = networks.free_endpoint()
    findings = await check_zenoh(config=networks.zenoh_keys("client", connect=endpoint))
    assert findings.of("link", "zenoh").found.startswith(
        f"the session does not open: Unable to connect to any of [{endpoint}]"
    )
    assert findings.of("link", "zenoh").remedy == NO_ROUTER_REMEDY
    assert findings.not_tested("gateway", subject="zenoh") == {"it needs link, which failed"}


async def test_a_client_finds_the_gateway_at_its_router() -> None:
    endpoint = networks.free_endpoint()
    router = networks.open_zenoh("router", listen=endpoint)
    try:
        findings = await check_zenoh(config=networks.zenoh_keys("client", connect=endpoint))
        assert findings.of("link", "zenoh") == Finding(
            "zenoh", "link", Result.PASSING, "the session is open and connected to a router"
        )
        assert findings.not_tested("gateway", subject="zenoh") == {NO_GATEWAY}
        token = router.liveliness().declare_token("mocap/lab/alive")
        findings = await check_zenoh(config=networks.zenoh_keys("client", connect=endpoint))
        assert findings.of("gateway", "zenoh").found == "a gateway serves lab"
        assert findings.of("gateway", "zenoh").result is Result.PASSING
        findings = await check_zenoh(config=networks.zenoh_keys("client", connect=endpoint), prefix="hall2")
        assert findings.not_tested("gateway", subject="zenoh") == {NO_GATEWAY}
        token.undeclare()
    finally:
        router.close()


async def test_a_gateway_is_found_where_it_listens() -> None:
    endpoint = networks.free_endpoint()
    gateway = networks.open_zenoh("peer", listen=endpoint)
    try:
        token = gateway.liveliness().declare_token("mocap/lab/alive")
        everywhere = endpoint.replace("127.0.0.1", "[::]")
        findings = await check_zenoh(config=networks.zenoh_keys("peer", listen=everywhere))
        assert findings.of("link", "zenoh").found == (
            "the session is open and connected to 0 routers and 1 peer"
        )
        assert findings.of("gateway", "zenoh").found == "a gateway serves lab"
        token.undeclare()
    finally:
        gateway.close()


async def test_an_address_that_another_program_uses_fails() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        findings = await check_zenoh(config=networks.zenoh_keys("peer", listen=endpoint))
    assert findings.of("link", "zenoh").found.startswith(f"a gateway cannot listen on {endpoint}: ")
    assert findings.of("link", "zenoh").remedy == (
        "Another program uses the address; `ss -ltnp` shows which one. Stop it, or change listen/endpoints "
        "in zenoh.config."
    )


async def test_a_peer_that_cannot_connect_fails() -> None:
    endpoint = networks.free_endpoint()
    findings = await check_zenoh(config=networks.zenoh_keys("peer", connect=endpoint))
    assert findings.of("link", "zenoh").found == (
        f"no router or peer can be reached at {endpoint}, so no data leaves this computer"
    )
    assert findings.of("link", "zenoh").remedy == NO_ROUTER_REMEDY


async def test_a_peer_that_can_listen_and_is_alone_passes() -> None:
    keys: dict[str, Any] = networks.zenoh_keys("peer")
    keys["listen"] = {"endpoints": {"peer": [networks.free_endpoint()]}}
    findings = await check_zenoh(config=keys)
    assert findings.of("link", "zenoh").result is Result.PASSING
    assert findings.not_tested("gateway", subject="zenoh") == {NO_GATEWAY}


# LCM and this computer.


def check_lcm(url: str, *sizes: int, rate_hz: float = 200.0) -> Findings:
    """Return the findings for this LCM URL and messages of these sizes."""
    loads = [MessageLoad(rate_hz, size) for size in sizes]
    return Findings(lcm_checks.check_lcm(LcmSettings(url=url), (), loads, 0.0))


async def test_disabled_lcm_is_not_tested() -> None:
    async with Simulator(SyntheticScene(markers=1)) as simulator:
        endpoint = networks.free_endpoint()
        findings = await run_doctor(
            lab(simulator.port),
            zenoh_settings=ZenohSettings(config=networks.zenoh_keys("peer", listen=endpoint)),
            lcm=LcmSettings(enabled=False),
        )
    assert findings.not_tested("route", "buffers", subject="lcm") == {"lcm.enabled is false"}


def test_lcm_in_memory_does_not_need_multicast() -> None:
    findings = check_lcm("memq://", 500)
    assert findings.of("route", "lcm").found == "memq:// does not need multicast"
    assert findings.not_tested("buffers", subject="lcm") == {"memq does not need a receive buffer"}


def test_a_missing_relay_fails() -> None:
    findings = check_lcm(f"tcpq://127.0.0.1:{networks.free_port()}")
    assert findings.of("route", "lcm").remedy == "Start LCM's TCP relay, or correct lcm.url."


@pytest.mark.netns
def test_working_multicast_passes_and_the_ttl_is_shown() -> None:
    findings = check_lcm(networks.lcm_url(), 500)
    assert findings.of("route", "lcm").result is Result.PASSING
    assert findings.of("route", "lcm").found.endswith("works and stays on this computer (ttl=0)")
    findings = check_lcm(networks.lcm_url().replace("ttl=0", "ttl=1"), 500)
    assert findings.of("route", "lcm").found.endswith("with ttl=1")


@pytest.mark.netns
def test_a_missing_multicast_route_fails() -> None:
    url = networks.lcm_url()
    networks.remove_multicast_route()
    try:
        findings = check_lcm(url, 500)
    finally:
        networks.add_multicast_route()
    assert findings.of("route", "lcm").found.startswith(f"no multicast to {url}: ")
    assert findings.of("route", "lcm").remedy == (
        "Bring a network interface up, or give it a multicast route: ip route add 224.0.0.0/4 dev INTERFACE."
    )


@pytest.mark.netns
def test_large_enough_buffers_pass() -> None:
    assert check_lcm(networks.lcm_url(), 500, 400).of("buffers", "lcm").result is Result.PASSING
    no_frames = check_lcm(networks.lcm_url())
    assert no_frames.not_tested("buffers", subject="lcm") == {
        "no frames arrived, so the sizes of messages are unknown"
    }


@pytest.mark.netns
def test_too_small_buffers_fail() -> None:
    """The messages just fit into the largest buffer that a URL can request. Then there are twice as many."""
    maximum = lcm_checks.receive_buffer_bytes(2**30)
    url = networks.lcm_url()
    largest = 65_000  # charged twice that
    rate_hz = 0.9 * maximum / lcm_checks.PAUSE_S / lcm_checks.charged_bytes(largest)
    finding = check_lcm(url, largest, rate_hz=rate_hz).of("buffers", "lcm")
    [size] = re.findall(r"^Add recv_buf_size=(\d+) to the LCM URL of every subscriber\.$", finding.remedy)
    good = check_lcm(f"{url}&recv_buf_size={size}", largest, rate_hz=rate_hz)
    assert good.of("buffers", "lcm").result is Result.PASSING
    finding = check_lcm(url, largest, rate_hz=2 * rate_hz).of("buffers", "lcm")
    assert re.search(
        r"^Add recv_buf_size=(\d+) to .*, and allow it on their computers: "
        r"sysctl -w net\.core\.rmem_max=\1\.$",
        finding.remedy,
    )


@pytest.mark.parametrize("size", [200, 1500, 3000, 8000, 20_000, 60_000])
def test_the_kernel_charges_at_most_charged_bytes_for_a_datagram(size: int) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 150_000)
        count = receiver.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // lcm_checks.charged_bytes(size)
        assert count >= 1
        for _ in range(count):
            sender.sendto(bytes(size), receiver.getsockname())
        receiver.setblocking(False)
        assert [len(receiver.recv(size)) for _ in range(count)] == [size] * count


def test_large_messages_are_charged_per_datagram() -> None:
    assert lcm_checks.charged_bytes(3 * 65_499) == 3 * lcm_checks.charged_bytes(65_499)
    assert lcm_checks.charged_bytes(200) == 1280
    assert lcm_checks.charged_bytes(1500) == 2304


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({}, True),
        ({"scouting": {"multicast": {"enabled": False}}}, True),  # a peer listens on all addresses
        (networks.zenoh_keys("peer"), False),
        (networks.zenoh_keys("peer", listen="tcp/127.0.0.1:7447"), False),
        (networks.zenoh_keys("peer", listen="tcp/[::]:7447"), True),
        (networks.zenoh_keys("client", connect="tls/localhost:7447"), False),
        (networks.zenoh_keys("client", connect="tcp/192.0.2.10:7447"), True),
    ],
)
def test_whether_zenoh_leaves_this_computer(keys: dict[str, Any], expected: bool) -> None:
    assert OUTPUTS["zenoh"].leaves_host(ZenohSettings(config=keys)) is expected


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("udpm://239.255.76.67:7667?ttl=0", False),
        ("udpm://239.255.76.67:7667?ttl=1", True),
        ("udpm://239.255.76.67:7667", False),
        ("memq://", False),
        ("tcpq://127.0.0.1:7700", False),
        ("tcpq://192.0.2.10:7700", True),
    ],
)
def test_whether_lcm_leaves_this_computer(url: str, expected: bool) -> None:
    assert OUTPUTS["lcm"].leaves_host(LcmSettings(url=url)) is expected


# The command.


async def command(*arguments: str) -> tuple[int, str]:
    """Return exit status and stdout of rtc3d-gateway doctor; its Zenoh and LCM stay on this machine."""
    done = await run(
        *("doctor", "--seconds", "0.3", *arguments),
        environ={
            "RTC3D_GATEWAY__ZENOH__CONFIG": json.dumps(networks.zenoh_keys("peer")),
            "RTC3D_GATEWAY__LCM__URL": "memq://",
            "RTC3D_GATEWAY__METRICS__PORT": str(networks.free_port()),
            "COLUMNS": "80",
        },
    )
    assert done.stderr == ""
    return done.status, done.stdout


async def test_the_exit_status_shows_whether_a_check_failed() -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=0, plates=0)
    async with Simulator(scene) as simulator:
        status, out = await command("--server", f"127.0.0.1:{simulator.port}", "--json")
    report = json.loads(out)
    assert [each["check"] for each in report["findings"] if each["result"] == "red"] == []
    assert (status, report["ok"]) == (0, True)
    assert next(each for each in report["findings"] if each["subject"] == "lab") == {
        "subject": "lab",
        "check": "name",
        "result": "green",
        "found": "127.0.0.1 is an IP address",
        "remedy": "",
    }


async def test_a_failed_check_prints_its_remedy_and_exits_with_status_1() -> None:
    status, out = await command("--server", f"127.0.0.1:{networks.free_port()}")
    assert status == 1
    assert "FAIL  TCP         connection refused by" in out
    assert "→ Is the RT server running, and is this its port?" in out
    assert max(map(len, out.splitlines())) <= 80
    assert all(line == line.rstrip() for line in out.splitlines())
    assert re.search(
        r"^\d+ ok, \d+ failed, \d+ not tested(, \d+ warnings?)?(, \d+ notes?)?$", out.splitlines()[-1]
    )


async def test_an_invalid_configuration_fails(tmp_path: Path) -> None:
    file = tmp_path / "lab.yaml"
    file.write_text("sources: [{name: lab, host: lab, prot: 1}]\nspool: 1\n")
    status, out = await command("--config", str(file), "--json")
    findings = {(each["subject"], each["check"]): each for each in json.loads(out)["findings"]}
    assert status == 1
    wrong = findings["configuration", "file"]
    assert [line.split(":")[1] for line in wrong["found"].splitlines()] == ["1", "2"]
    assert wrong["remedy"] == "Correct these lines; config/gateway.yaml explains every key."
    assert findings["source", "TCP"]["found"] == "it needs the configuration, which failed"
    assert findings["this computer", "clock"]["result"] in {"green", "warning", "not tested"}
