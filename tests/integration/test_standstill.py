"""Stops of the gateway's process: what waits in the sockets is read, and the server is not blamed."""

import os
import signal
import subprocess
import sys
import time
from typing import Final

ROUNDS: Final = 5

WAITER: Final = """
import asyncio, contextlib, os, uvloop
from gateway.stream.running_time import running_timeout

async def wait_for_bytes():
    loop = asyncio.get_running_loop()
    while True:
        answer = loop.create_future()
        loop.add_reader(0, lambda: answer.done() or answer.set_result(os.read(0, 1)))
        try:
            async with running_timeout(0.1):  # less than a stop counts at most
                print("read", await answer, flush=True)
        except TimeoutError:
            with contextlib.suppress(BlockingIOError):
                print("too late:", os.read(0, 1), flush=True)

os.set_blocking(0, False)
print("ready", flush=True)
uvloop.run(wait_for_bytes())
"""


def test_what_arrives_during_a_stop_is_read_before_a_timeout_ends() -> None:
    """After a stop, the event loop calls its timers before it reads the sockets."""
    with subprocess.Popen(
        [sys.executable, "-c", WAITER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=0
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        for number in range(ROUNDS):
            process.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, process.pid, os.WSTOPPED)
            os.write(process.stdin.fileno(), b"%d" % number)
            time.sleep(0.3)  # the length of the stop, three times the time-out
            process.send_signal(signal.SIGCONT)
            assert process.stdout.readline() == f"read b'{number}'\n"
        process.kill()
