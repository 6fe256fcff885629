"""The doctor on the Zenoh side, LCM and this computer, and its command; each remedy is what it should be."""

import asyncio
import json
import os
import re
import socket
import sys
from pathlib import Path
from typing import Any

import pytest

from gateway.config.settings import LcmSettings, ZenohSettings
from gateway.doctor import host_checks
from gateway.doctor.finding import Finding, Result
from gateway.doctor.observation import ComponentSeen
from gateway.rtc3d_server.server import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests import networks
from tests.findings import Findings, found, lab

# Zenoh.

NOBODY = (
    "no gateway is seen that serves lab; if one runs, its zenoh.prefix or the router's access rules are "
    "others"
)
NO_ROUTER_REMEDY = (
    "Start zenohd there, or correct connect/endpoints in zenoh.config; with TLS, certificates must be by "
    "one authority, not have ended, and name the address."
)


async def linked(**keys: Any) -> Findings:
    """Return what is found with these Zenoh settings, and a source that is not there."""
    return await found(lab(networks.free_port()), zenoh_settings=ZenohSettings(**keys))


async def test_zenoh_switched_off_is_not_tested() -> None:
    assert (await linked(enabled=False)).reasons("link", "gateway", subject="zenoh") == {
        "zenoh.enabled is false"
    }


async def test_a_client_without_its_router_is_red() -> None:
    endpoint = networks.free_endpoint()
    findings = await linked(config=networks.zenoh_keys("client", connect=endpoint))
    assert findings.of("link", "zenoh").found.startswith(
        f"the session does not open: Unable to connect to any of [{endpoint}]"
    )
    assert findings.of("link", "zenoh").remedy == NO_ROUTER_REMEDY
    assert findings.reasons("gateway", subject="zenoh") == {"it needs link, which failed"}


async def test_a_client_with_its_router_sees_the_gateway_there() -> None:
    endpoint = networks.free_endpoint()
    router = networks.open_zenoh("router", listen=endpoint)
    try:
        findings = await linked(config=networks.zenoh_keys("client", connect=endpoint))
        assert findings.of("link", "zenoh") == Finding(
            "zenoh", "link", Result.GREEN, "the session is open, with a router"
        )
        assert findings.reasons("gateway", subject="zenoh") == {NOBODY}
        token = router.liveliness().declare_token("mocap/lab/alive")
        findings = await linked(config=networks.zenoh_keys("client", connect=endpoint))
        assert findings.of("gateway", "zenoh").found == "a gateway serves lab"
        assert findings.of("gateway", "zenoh").result is Result.GREEN
        findings = await linked(config=networks.zenoh_keys("client", connect=endpoint), prefix="hall2")
        assert findings.reasons("gateway", subject="zenoh") == {NOBODY}
        token.undeclare()
    finally:
        router.close()


async def test_a_gateway_that_listens_is_seen_where_it_listens() -> None:
    endpoint = networks.free_endpoint()
    gateway = networks.open_zenoh("peer", listen=endpoint)
    try:
        token = gateway.liveliness().declare_token("mocap/lab/alive")
        everywhere = endpoint.replace("127.0.0.1", "[::]")
        findings = await linked(config=networks.zenoh_keys("peer", listen=everywhere))
        assert findings.of("link", "zenoh").found == (
            "the session is open; 0 router(s) and 1 peer(s) are reached"
        )
        assert findings.of("gateway", "zenoh").found == "a gateway serves lab"
        token.undeclare()
    finally:
        gateway.close()


async def test_an_address_that_another_program_has_is_red() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        findings = await linked(config=networks.zenoh_keys("peer", listen=endpoint))
    assert findings.of("link", "zenoh").found.startswith(f"nobody can listen on {endpoint}: ")
    assert findings.of("link", "zenoh").remedy == (
        "Another program has the address: `ss -ltnp` shows which. End it, or change listen/endpoints in "
        "zenoh.config."
    )


async def test_a_peer_that_reaches_nobody_it_should_is_red() -> None:
    endpoint = networks.free_endpoint()
    findings = await linked(config=networks.zenoh_keys("peer", connect=endpoint))
    assert findings.of("link", "zenoh").found == f"nobody is reached at {endpoint}, so nothing leaves"
    assert findings.of("link", "zenoh").remedy == NO_ROUTER_REMEDY


async def test_a_peer_that_is_free_to_listen_and_alone_is_green() -> None:
    keys: dict[str, Any] = networks.zenoh_keys("peer")
    keys["listen"] = {"endpoints": {"peer": [networks.free_endpoint()]}}
    findings = await linked(config=keys)
    assert findings.of("link", "zenoh").result is Result.GREEN
    assert findings.reasons("gateway", subject="zenoh") == {NOBODY}


# LCM and this computer.


async def host_of(url: str, *sizes: int, rate_hz: float = 200.0) -> Findings:
    """Return what is found of LCM, frames with messages of these sizes being seen."""

    class Seen(ComponentSeen):
        @property
        def rate_hz(self) -> float:
            return rate_hz

    seen = []
    for size in sizes:
        component = Seen()
        component.message_bytes = size
        seen.append(component)
    return Findings(host_checks.examine_lcm(LcmSettings(url=url), seen))


async def test_lcm_switched_off_is_not_tested() -> None:
    async with Simulator(SyntheticScene(markers=1)) as simulator:
        endpoint = networks.free_endpoint()
        findings = await found(
            lab(simulator.port),
            zenoh_settings=ZenohSettings(config=networks.zenoh_keys("peer", listen=endpoint)),
            lcm=LcmSettings(enabled=False),
        )
    assert findings.reasons("route", "buffers", subject="lcm") == {"lcm.enabled is false"}


async def test_lcm_in_memory_needs_no_multicast() -> None:
    findings = await host_of("memq://", 500)
    assert findings.of("route", "lcm").found == "memq:// needs no multicast"
    assert findings.reasons("buffers", subject="lcm") == {"memq needs none"}


async def test_a_relay_that_is_not_there_is_red() -> None:
    findings = await host_of(f"tcpq://127.0.0.1:{networks.free_port()}")
    assert findings.of("route", "lcm").remedy == "Start LCM's TCP relay, or correct lcm.url."


@pytest.mark.netns
async def test_multicast_that_leaves_is_green_and_says_how_far() -> None:
    findings = await host_of(networks.lcm_url(), 500)
    assert findings.of("route", "lcm").result is Result.GREEN
    assert findings.of("route", "lcm").found.endswith("which stays on this computer (ttl=0)")
    findings = await host_of(networks.lcm_url().replace("ttl=0", "ttl=1"), 500)
    assert findings.of("route", "lcm").found.endswith("with ttl=1")


@pytest.mark.netns
async def test_no_multicast_route_is_red() -> None:
    url = networks.lcm_url()
    networks.remove_multicast_route()
    try:
        findings = await host_of(url, 500)
    finally:
        networks.add_multicast_route()
    assert findings.of("route", "lcm").found.startswith(f"no multicast to {url}: ")
    assert findings.of("route", "lcm").remedy == (
        "Bring a network interface up, or give it a multicast route: ip route add 224.0.0.0/4 dev INTERFACE."
    )


@pytest.mark.netns
async def test_buffers_that_hold_the_messages_are_green() -> None:
    assert (await host_of(networks.lcm_url(), 500, 400)).of("buffers", "lcm").result is Result.GREEN
    no_frames = await host_of(networks.lcm_url())
    assert no_frames.reasons("buffers", subject="lcm") == {
        "no frames came, so the messages' sizes are not known"
    }


@pytest.mark.netns
async def test_buffers_that_do_not_hold_the_messages_are_red() -> None:
    """So many large messages as fit the kernel's limit once the URL asks for enough, and more."""
    maximum = host_checks.receive_buffer_bytes(2**30)
    url = networks.lcm_url()
    largest = 65_000  # charged twice that
    rate_hz = 0.9 * maximum / host_checks.PAUSE_S / host_checks.charged_bytes(largest)
    finding = (await host_of(url, largest, rate_hz=rate_hz)).of("buffers", "lcm")
    [size] = re.findall(r"^Add recv_buf_size=(\d+) to the LCM URL of every subscriber\.$", finding.remedy)
    good = await host_of(f"{url}&recv_buf_size={size}", largest, rate_hz=rate_hz)
    assert good.of("buffers", "lcm").result is Result.GREEN
    finding = (await host_of(url, largest, rate_hz=2 * rate_hz)).of("buffers", "lcm")
    assert re.search(
        r"^Add recv_buf_size=(\d+) to .*, and allow it on their computers: "
        r"sysctl -w net\.core\.rmem_max=\1\.$",
        finding.remedy,
    )


@pytest.mark.parametrize("size", [200, 1500, 3000, 8000, 20_000, 60_000])
def test_the_kernel_charges_no_more_for_a_datagram_than_is_reckoned(size: int) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 150_000)
        count = receiver.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // host_checks.charged_bytes(size)
        assert count >= 1
        for _ in range(count):
            sender.sendto(bytes(size), receiver.getsockname())
        receiver.setblocking(False)
        assert [len(receiver.recv(size)) for _ in range(count)] == [size] * count


def test_large_messages_are_charged_by_their_pieces() -> None:
    assert host_checks.charged_bytes(3 * 65_499) == 3 * host_checks.charged_bytes(65_499)
    assert host_checks.charged_bytes(200) == 1280
    assert host_checks.charged_bytes(1500) == 2304


def test_the_clock_is_read() -> None:
    synchronised, off_us = host_checks.read_clock()
    assert isinstance(synchronised, bool)
    assert off_us >= 0


def test_a_synchronised_clock_is_green(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_checks, "read_clock", lambda: (True, 1234))
    assert host_checks.examine_clock().found == "synchronised, off by at most 1.2 ms"
    assert host_checks.examine_clock().result is Result.GREEN


def test_a_clock_of_its_own_is_red(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_checks, "read_clock", lambda: (False, 16_000_000))
    assert host_checks.examine_clock().found == (
        "this computer's clock is not synchronised, so times of other computers do not compare with utime"
    )
    assert host_checks.examine_clock().remedy == (
        "Set up chrony or systemd-timesyncd against the lab's time server (`chronyc tracking` or "
        "`timedatectl` shows it); in a container, on its host."
    )


def test_a_clock_that_is_not_told_is_not_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> tuple[bool, int]:
        raise OSError(1, "adjtimex is not allowed")

    monkeypatch.setattr(host_checks, "read_clock", refuse)
    assert host_checks.examine_clock() == Finding(
        "this computer", "clock", Result.NOT_TESTED, "the kernel does not say: adjtimex is not allowed"
    )


# The command.


async def command(*arguments: str) -> tuple[int, str]:
    """Return exit status and output of rtc3d-gateway doctor, with Zenoh and LCM that stay in it."""
    keys = json.dumps(networks.zenoh_keys("peer"))
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "gateway", "doctor", "--seconds", "0.3", *arguments),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env={**os.environ, "RTC3D_GATEWAY__ZENOH__CONFIG": keys, "RTC3D_GATEWAY__LCM__URL": "memq://"},
    )
    out, err = await process.communicate()
    assert err == b""
    assert process.returncode is not None
    return process.returncode, out.decode()


async def test_the_exit_status_says_whether_anything_is_red() -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=0, plates=0)
    async with Simulator(scene) as simulator:
        status, out = await command("--server", f"127.0.0.1:{simulator.port}", "--json")
    report = json.loads(out)
    red = [each["check"] for each in report["findings"] if each["result"] == "red"]
    assert set(red) <= {"clock"}  # the one thing that this machine may not have
    assert (status, report["ok"]) == ((1, False) if red else (0, True))
    assert report["findings"][1] == {
        "subject": "lab",
        "check": "name",
        "result": "green",
        "found": "127.0.0.1 is an address",
        "remedy": "",
    }


async def test_red_is_exit_status_1_with_its_remedy_on_the_screen() -> None:
    status, out = await command("--server", f"127.0.0.1:{networks.free_port()}")
    assert status == 1
    assert "FAIL  TCP         connection refused by" in out
    assert "→ Is the RT server running, and is this its port?" in out
    assert max(map(len, out.splitlines())) <= 80
    assert all(line == line.rstrip() for line in out.splitlines())
    assert re.search(r"^\d+ ok, \d+ to put right, \d+ not tested$", out.splitlines()[-1])


async def test_a_configuration_that_cannot_be_used_is_red(tmp_path: Path) -> None:
    file = tmp_path / "lab.yaml"
    file.write_text("sources: [{name: lab, host: lab, prot: 1}]\nspool: 1\n")
    status, out = await command("--config", str(file), "--json")
    findings = {(each["subject"], each["check"]): each for each in json.loads(out)["findings"]}
    assert status == 1
    wrong = findings["configuration", "file"]
    assert [line.split(":")[1] for line in wrong["found"].splitlines()] == ["1", "2"]
    assert wrong["remedy"] == "Correct these lines; config/gateway.yaml explains every key."
    assert findings["source", "TCP"]["found"] == "it needs the configuration, which failed"
    assert findings["this computer", "clock"]["result"] in {"green", "red", "not tested"}
