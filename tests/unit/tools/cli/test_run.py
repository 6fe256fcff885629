import signal
import subprocess
import sys

COMMAND = """
import os, signal, sys, time
from gateway.tools.cli.run import StopSignals
stop = StopSignals(lambda number: os._exit(number))
print("ready", flush=True)
while not stop.wait(0):  # as often as possible: the signal comes at any place in it
    pass
print("stopped", flush=True)
while True:  # signal.pause() would miss a signal that comes just before it
    time.sleep(0.01)
"""


def test_the_first_signal_stops_and_the_second_ends_at_once() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) * 3:
        with subprocess.Popen([sys.executable, "-c", COMMAND], stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            process.send_signal(number)
            assert process.stdout.readline() == b"stopped\n"
            process.send_signal(number)
            assert process.wait(10) == number


def test_a_signal_that_is_ignored_stays_ignored() -> None:
    code = COMMAND.replace('print("ready"', 'os.kill(os.getpid(), signal.SIGHUP); print("ready"')
    with subprocess.Popen(["nohup", sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGTERM)
        assert process.stdout.readline() == b"stopped\n"
        process.kill()
