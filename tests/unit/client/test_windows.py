"""The Python interface without the modules that Windows lacks."""

import subprocess
import sys
from pathlib import Path

PROGRAM = """
import sys
for name in ("fcntl", "grp", "pwd", "resource", "termios", "uvloop"):
    sys.modules[name] = None  # importing it raises ImportError
from gateway.client import GatewayClient, live
from gateway.takes import open_take
import gateway.client.lcm_transport, gateway.client.zenoh_transport
print(open_take(sys.argv[1]).sources["lab"].markers)
"""


def test_live_data_and_takes_need_nothing_that_only_unix_has() -> None:
    take = Path(__file__).parents[3] / "examples/walk.lcmlog"
    run = subprocess.run((sys.executable, "-c", PROGRAM, take), capture_output=True, text=True, check=True)
    assert run.stdout == "<Series 3d: 250 rows, 34 labels>\n"
