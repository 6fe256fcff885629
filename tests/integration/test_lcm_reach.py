"""What reaches a gateway with ttl=0 from another computer on its LAN, and what keeps it out."""

import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.configurations import write_config
from tests.support.gateway_process import PROGRAM
from tests.support.needs import need_programs
from tests.support.networks import free_port, lan_interface
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns

ROOT = Path(__file__).parents[2]
REQUESTS_URL = "udpm://239.255.76.67:7668"

SEND_REQUESTS = """
import sys, time, lcm, rtc3d
connection = lcm.LCM(sys.argv[1])
request = rtc3d.parameters_request_t()
request.requester = "other"
for request.request_id in range(20):
    connection.publish("MOCAP_LAB_PARAMETERS_REQUEST", request.encode())
    time.sleep(0.02)
"""


class Gateway:
    """A gateway with LCM at ttl=0 on a computer with a LAN."""

    def __init__(self, folder: Path, other_computer: int) -> None:
        self._other_computer = other_computer
        self._config = folder / "gateway.yaml"
        self._log = folder / "gateway.log"
        self._metrics_port = free_port()
        lcm = {"url": "udpm://239.255.76.67:7667?ttl=0"}
        write_config(self._config, free_port(), lcm=lcm, metrics={"port": self._metrics_port})
        with self._log.open("wb") as log:
            self.process = subprocess.Popen([*PROGRAM, "run", "--config", str(self._config)], stderr=log)
        wait_until(lambda: self.requests_received() is not None)

    def requests_received(self) -> int | None:
        """Return the number of requests, with or without an answer; None before the start."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._metrics_port}/metrics") as page:
                lines = page.read().decode().splitlines()
        except OSError:
            return None
        counts = [line for line in lines if line.startswith('rtc3d_gateway_queries_total{output="lcm"')]
        return sum(int(float(line.split()[-1])) for line in counts)

    def send_requests(self, ttl: int, from_other: bool) -> int:
        """Send 20 requests, and return how many of them arrived at the gateway within a moment."""
        before = self.requests_received()
        place = ("nsenter", "--net", "--target", str(self._other_computer)) if from_other else ()
        subprocess.run(
            [*place, sys.executable, "-c", SEND_REQUESTS, f"{REQUESTS_URL}?ttl={ttl}"],
            check=True,
            timeout=120,
        )
        after = self.requests_received()
        assert before is not None
        assert after is not None
        return after - before


@pytest.fixture
def gateway(tmp_path: Path) -> Iterator[Gateway]:
    with lan_interface("192.0.2.1") as other_computer:
        gateway = Gateway(tmp_path, other_computer)
        wait_until(lambda: gateway.send_requests(0, from_other=False))  # it receives by now
        yield gateway
        gateway.process.terminate()
        assert gateway.process.wait(10) == 0


def test_requests_of_another_computer_arrive_until_a_firewall_drops_them(gateway: Gateway) -> None:
    need_programs("nft", packages="nftables")
    assert gateway.send_requests(1, from_other=True) > 0
    assert gateway.send_requests(0, from_other=True) == 0
    try:
        for _ in range(2):  # loading the file again changes nothing
            subprocess.run(["nft", "-f", ROOT / "config/lcm-local.nft"], check=True)
        assert gateway.send_requests(1, from_other=True) == 0
        assert gateway.send_requests(0, from_other=False) > 0
        rules = subprocess.check_output(["nft", "list", "table", "inet", "rtc3d_lcm"], text=True)
        assert rules.count("drop") == 1
        assert "counter packets 0 " not in rules
    finally:
        subprocess.run(["nft", "delete", "table", "inet", "rtc3d_lcm"], check=True)
    assert gateway.send_requests(1, from_other=True) > 0


def test_the_page_has_the_shipped_rule() -> None:
    page = (ROOT / "docs/how-to/secure.md").read_text()
    assert (ROOT / "config/lcm-local.nft").read_text() in page
