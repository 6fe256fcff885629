"""Programs that use ``gateway.client`` as processes of their own: each ends, whatever ends it.

Zenoh calls back in threads for which Python waits at its end, and the most natural programs close nothing.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
import yaml

from tests.support.gateway_process import program, simulator
from tests.support.networks import free_endpoint, lcm_url, zenoh_keys
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns

TIMEOUT_S: Final = 60
"""Much more than any program needs: only one that hangs takes so long."""

HEAD: Final = """
import asyncio, atexit, json, os, sys, threading, time

@atexit.register
def check():
    if daemons := [each for each in threading.enumerate() if each.daemon and "pyo3" in each.name]:
        print("Fatal: Zenoh would abort the process:", daemons, file=sys.stderr)

from gateway.client import GatewayAddress, GatewayClient, Messages, live

lcm = sys.argv[1] == "lcm"
where = {"url" if lcm else "connect": sys.argv[2]}
address = GatewayAddress(lcm, **where)

def ready():
    print("ready", flush=True)

def wait():
    while True:
        time.sleep(0.01)
"""

RECEIVES: Final = """
        data = live("lab", **where)
        def receive():
            for frame in data:
                has_come.set()
                if is_over:
                    break
        has_come, is_over = threading.Event(), False
"""
"""What two of the programs have in common: a function for another thread, which ends when ``is_over``."""

USES: Final = {
    "iterate": """
        for frame in live("lab", components=["3d"], **where):
            ready()
            END
    """,
    "iterate in a function": """
        def main():
            for frame in live("lab", complete=True, **where):
                ready()
                END
        main()
    """,
    "a block": """
        with live("lab", **where) as data:
            for frame in data:
                ready()
                END
    """,
    "a generator in a global": """
        frames = iter(live("lab", components="3d", join=True, **where))
        next(frames)
        ready()
        for _ in range(1):
            END
    """,
    "the newest": """
        data = live("lab", **where)
        while data.latest() is None:
            time.sleep(0.01)
        ready()
        for _ in range(1):
            END
    """,
    "collect": """
        data = live("lab", **where)
        while not data.collect(0.05).sources:
            pass
        ready()
        for _ in range(1):
            END
    """,
    "a callback": """
        has_come = threading.Event()
        data = live("lab", **where).on_frame(lambda frame: has_come.set())
        has_come.wait()
        ready()
        for _ in range(1):
            END
    """,
    "two sessions": """
        first, second = live("lab", **where), live("lab", last_s=1, **where)
        for _ in zip(first, second):
            ready()
            END
    """,
    "asyncio": """
        async def main():
            async for frame in live("lab", **where):
                ready()
                if WAITS:
                    continue
                END
        asyncio.run(main())
    """,
    "asyncio with a block": """
        async def main():
            async with live("lab", **where) as data:
                async for frame in data:
                    ready()
                    if WAITS:
                        continue
                    END
        asyncio.run(main())
    """,
    "a client": """
        client = GatewayClient(address)
        assert client.sources().sources
        ready()
        for _ in range(1):
            END
    """,
    "messages": """
        has_come = threading.Event()
        client = GatewayClient(address)
        subscriber = client.subscribe("lab", "3d", Messages(lambda *_: has_come.set()))
        has_come.wait()
        ready()
        for _ in range(1):
            END
    """,
    "a thread that is joined": f"""{RECEIVES}        thread = threading.Thread(target=receive)
        thread.start()
        has_come.wait()
        ready()
        for _ in range(1):
            is_over = ENDS_BY_ITSELF
            END
        thread.join()
    """,
    "a daemon": """
        has_come = threading.Event()
        def receive(*_):
            has_come.set()
            time.sleep(0.1)
        def subscribe():
            global client, subscriber
            client = GatewayClient(address)
            subscriber = client.subscribe("lab", "3d", Messages(receive))
        threading.Thread(target=subscribe, daemon=True).start()
        has_come.wait()
        ready()
        for _ in range(1):
            END
    """,
    "a thread of a pool": f"""
        from concurrent.futures import ThreadPoolExecutor{RECEIVES}        pool = ThreadPoolExecutor()
        future = pool.submit(receive)
        has_come.wait()
        ready()
        for _ in range(1):
            is_over = ENDS_BY_ITSELF
            END
        future.result()
    """,
}
"""Programs, by the way in which they receive. END is a statement in a loop, after the first frame."""


class End(NamedTuple):
    """A way to end: the statement, the exit status, and the exception that is shown."""

    statement: str
    status: int
    exception: str = ""
    is_interrupted: bool = False


ENDS: Final = {
    "its last line": End("break", 0),
    "an exception": End("raise LookupError", 1, "LookupError"),
    "sys.exit": End("sys.exit(3)", 3),
    "Ctrl-C": End("wait()", -signal.SIGINT, "KeyboardInterrupt", is_interrupted=True),
}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Where a gateway with the source lab publishes: on Zenoh and on LCM."""
    folder = tmp_path_factory.mktemp("gateway")
    places = {"zenoh": free_endpoint(), "lcm": lcm_url()}
    with simulator("--markers", "2", "--rate", "10", "--analog-rate", "10") as (port, _):
        settings = {
            "sources": [{"name": "lab", "host": "127.0.0.1", "port": port}],
            "zenoh": {"config": zenoh_keys("peer", listen=places["zenoh"])},
            "lcm": {"url": places["lcm"]},
            "metrics": {"enabled": False},
        }
        config, log = folder / "gateway.yaml", folder / "gateway.log"
        config.write_text(yaml.safe_dump(settings))
        with log.open("wb") as stderr, program("run", "--config", str(config), stderr=stderr):
            wait_until(lambda: ": a frame arrived" in log.read_text())
            yield places


def started(
    folder: Path,
    text: str,
    transport: str,
    places: dict[str, str],
    *options: str,
    arguments: Sequence[str] = (),
    **streams: Any,
) -> "subprocess.Popen[str]":
    """Start a program, written to a file as a user would."""
    file = folder / "program.py"
    file.write_text(HEAD + textwrap.dedent(text))
    command = [sys.executable, *options, str(file), transport, places[transport], *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL, **streams}
    return subprocess.Popen(command, text=True, start_new_session=True, **pipes)


def ended(process: "subprocess.Popen[str]", *, interrupt: bool = False) -> tuple[int, str, str]:
    """Return the exit status, stdout and stderr of a program; send one Ctrl-C when it is ready."""
    with process:
        try:
            assert process.stdout is not None
            first = process.stdout.readline()
            if interrupt and first == "ready\n":
                process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            pytest.fail("the program hangs")
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, first + output, errors


def exceptions(errors: str) -> list[str]:
    """Return the exceptions that are shown, and that show that something went wrong at the end."""
    signs = ("Exception ignored", "Fatal", "fatal", "panicked", "FATAL")
    names = ("LookupError", "KeyboardInterrupt")
    return [
        line for line in errors.splitlines() if line.startswith(names) or any(each in line for each in signs)
    ]


FORKS: Final = """
folders = sys.argv[3:]
children = {}
for folder in folders:
    if (pid := os.fork()) == 0:
        for descriptor, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(f"{folder}/{name}", os.O_CREAT | os.O_WRONLY), descriptor)
        break
    children[folder] = pid
else:
    print(json.dumps(children), flush=True)
    statuses = {folder: os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for folder, pid in children.items()}
    print(json.dumps(statuses), flush=True)
    os._exit(0)
with open(f"{folder}/program.py") as program:
    code = compile(program.read(), program.name, "exec")
exec(code)
"""
"""Runs the program in each folder in a process of its own, as Python runs a file, but imports only once."""


def ended_together(
    folder: Path, texts: Mapping[str, str], transport: str, places: dict[str, str], *, interrupt: bool = False
) -> dict[str, tuple[int, str, str]]:
    """Run programs at once; return what ``ended`` returns of each."""
    folders = {name: folder / name for name in texts}
    for name, text in texts.items():
        folders[name].mkdir()
        (folders[name] / "program.py").write_text(textwrap.dedent(text))
        (folders[name] / "stdout").touch()
    parent = started(folder, FORKS, transport, places, arguments=[*map(str, folders.values())])
    try:
        assert parent.stdout is not None
        children = json.loads(parent.stdout.readline())
        for each, pid in children.items() if interrupt else ():
            stdout = Path(each) / "stdout"
            wait_until(lambda stdout=stdout: stdout.read_text().startswith("ready\n"))  # type: ignore[misc]
            os.kill(pid, signal.SIGINT)
        output, _ = parent.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        pytest.fail("a program hangs")
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)
        parent.communicate()
    statuses = json.loads(output)
    return {
        name: (statuses[str(each)], (each / "stdout").read_text(), (each / "stderr").read_text())
        for name, each in folders.items()
    }


@pytest.mark.parametrize(
    ("transport", "end"),
    # On LCM, where Python waits for no callbacks, a receiver can only fail to see the end or an interruption.
    [*(("zenoh", end) for end in ENDS), ("lcm", "its last line"), ("lcm", "Ctrl-C")],
)
def test_a_program_ends_whatever_ends_it(
    transport: str, end: str, places: dict[str, str], tmp_path: Path
) -> None:
    """With its own status, its own exception and nothing else, after one Ctrl-C."""
    statement, status, exception, is_interrupted = ENDS[end]
    texts = {}
    for use, text in USES.items():
        ended_by = text.replace("ENDS_BY_ITSELF", str(not exception)).replace("WAITS", str(is_interrupted))
        texts[use] = ended_by.replace("END", statement)
    found = ended_together(tmp_path, texts, transport, places, interrupt=is_interrupted)
    for use, (found_status, output, errors) in found.items():
        assert (use, output.startswith("ready"), found_status, exceptions(errors)) == (
            use,
            True,
            status,
            [exception] if exception else [],
        ), errors


RECEIVES_IN_A_THREAD: Final = """
        data = live("lab", **where)
        def receive():
            for frame in data:
                has_come.set()
        has_come = threading.Event()
        thread = threading.Thread(target=receive)
        thread.start()
        has_come.wait()
"""


def run_to_its_end(
    folder: Path, text: str, transport: str, places: dict[str, str], *options: str, **streams: Any
) -> tuple[int, str, str]:
    """Run a program; return its exit status, stdout and stderr."""
    return ended(started(folder, text, transport, places, *options, **streams))


def test_a_program_goes_on_while_a_thread_of_its_own_receives(places: dict[str, str], tmp_path: Path) -> None:
    """As Python does it: the end of the main thread is not that of the program."""
    text = """
        def receive():
            threading.main_thread().join()
            for number, frame in enumerate(live("lab", components=["3d"], **where)):
                if number == 20:
                    break
            ready()
        data = live("lab", **where).open()
        threading.Thread(target=receive).start()
    """
    assert run_to_its_end(tmp_path, text, "zenoh", places) == (0, "ready\n", "")


def test_a_program_ends_by_an_exception_although_a_thread_receives(
    places: dict[str, str], tmp_path: Path
) -> None:
    """Iterations in other threads end then: one Ctrl-C is enough."""
    text = """
        ready()
        while thread.is_alive():
            thread.join(0.1)  # Python does not see a Ctrl-C that comes just before it waits
    """
    process = started(tmp_path, RECEIVES_IN_A_THREAD + text, "zenoh", places)
    status, _, errors = ended(process, interrupt=True)
    assert (status, exceptions(errors)) == (-signal.SIGINT, ["KeyboardInterrupt"])


def test_a_program_that_catches_ctrl_c_ends_although_it_joined_a_thread_that_receives(
    places: dict[str, str], tmp_path: Path
) -> None:
    """Python takes a thread as stopped when Ctrl-C interrupts its join, and does not wait for it again.

    From 3.13 on, it does, until the next Ctrl-C.
    """
    text = """
        def interrupt():
            time.sleep(0.1)  # until the main thread waits
            os.kill(os.getpid(), signal.SIGINT)
            while not is_caught.wait(5.0):  # it may have come just before Python waits
                os.kill(os.getpid(), signal.SIGINT)
            while sys.version_info >= (3, 13):
                time.sleep(5.0)  # until Python waits for the thread that receives
                os.kill(os.getpid(), signal.SIGINT)
        import signal
        is_caught = threading.Event()
        try:
            threading.Thread(target=interrupt, daemon=True).start()
            thread.join()
        except KeyboardInterrupt:
            is_caught.set()
            ready()
    """
    status, output, errors = run_to_its_end(tmp_path, RECEIVES_IN_A_THREAD + text, "zenoh", places)
    shown = ["KeyboardInterrupt: "] if sys.version_info >= (3, 13) else []
    assert (status, output, exceptions(errors)) == (0, "ready\n", shown), errors


@pytest.mark.parametrize("transport", ["zenoh", "lcm"])
def test_an_interactive_session_ends(transport: str, places: dict[str, str], tmp_path: Path) -> None:
    """After an exception at the prompt, and Ctrl-D."""
    commands = tmp_path / "typed"
    commands.write_text("again = next(iter(live('lab', **where)))\n1 / 0\nprint(again.source)\n")
    text = """
        for frame in live("lab", **where):
            break
        ready()
    """
    with commands.open() as stdin:
        status, output, errors = run_to_its_end(tmp_path, text, transport, places, "-i", stdin=stdin)
    assert (status, output) == (0, "ready\nlab\n")
    assert exceptions(errors) == []


@pytest.mark.parametrize("transport", ["zenoh", "lcm"])
def test_spawned_processes_receive_and_end(transport: str, places: dict[str, str], tmp_path: Path) -> None:
    text = """
        import multiprocessing
        def receive(number):
            for frame in live("lab", **where):
                return frame.source
        if __name__ == "__main__":
            assert receive(0) == "lab"
            with multiprocessing.get_context("spawn").Pool(2) as pool:
                assert pool.map(receive, range(2)) == ["lab", "lab"]
            process = multiprocessing.get_context("spawn").Process(target=receive, args=(0,))
            process.start()
            process.join()
            assert process.exitcode == 0
            ready()
    """
    status, output, errors = run_to_its_end(tmp_path, text, transport, places)
    assert (status, output, exceptions(errors)) == (0, "ready\n", []), errors


FORKED: Final = """
        import multiprocessing, os
        from gateway.errors import ForkError
        context = multiprocessing.get_context("fork")
        def child():
            try:
                RECEIVE
            except ForkError as error:
                os._exit(7)
        BEFORE
        process = context.Process(target=child)
        process.start()
        process.join()
        print(process.exitcode)
"""


@pytest.mark.parametrize("transport", ["zenoh", "lcm"])
def test_a_fork_is_refused_what_would_never_get_anything(
    transport: str, places: dict[str, str], tmp_path: Path
) -> None:
    """As in a worker of a DataLoader. What the fork opens itself works, if Zenoh is new to it."""
    first = "next(iter(live('lab', **where)))"
    client = "GatewayClient(address).sources()"
    is_zenoh = transport == "zenoh"
    cases = [
        ("", first, 0),
        (first, first, 7 if is_zenoh else 0),
        *([(client, first, 7), (client, client, 7)] if is_zenoh else []),
        *(
            (f"data = live('lab', **where); {before}", receive, 7)
            for before, receive in (
                ("next(iter(data))", "data.latest()"),
                ("next(iter(data))", "data.collect()"),
                ("next(iter(data))", "data.on_frame(print)"),
                ("next(iter(data))", "next(iter(data))"),
                ("frames = iter(data); next(frames)", "[*frames]"),
                ("data.client.sources()", "data.client.takes()"),
            )
        ),
        # The first answer of the history has several messages: those after the first wait in the program.
        ("data = live('lab', last_s=1, **where); frames = iter(data); next(frames)", "next(frames)", 7),
        ("data = live('lab', **where); next(iter(data))", "data.close()", 0),
    ]
    texts = {
        str(number): FORKED.replace("BEFORE", before).replace("RECEIVE", receive)
        for number, (before, receive, _) in enumerate(cases)
    }
    found = ended_together(tmp_path, texts, transport, places)
    for case, (status, output, errors) in zip(cases, found.values(), strict=True):
        assert (case, status, output, exceptions(errors)) == (case, 0, f"{case[2]}\n", []), errors


@pytest.mark.parametrize("transport", ["zenoh", "lcm"])
def test_the_end_of_a_fork_closes_nothing_of_its_parent(
    transport: str, places: dict[str, str], tmp_path: Path
) -> None:
    """Both would use one connection, and the parent would lose its own."""
    text = """
        import os
        data = live("lab", **where)
        first = next(iter(data))
        if (child := os.fork()) == 0:
            sys.exit(5)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 5
        for _, frame in zip(range(20), data):
            pass
        ready()
    """
    status, output, errors = run_to_its_end(tmp_path, text, transport, places)
    assert (status, output, exceptions(errors)) == (0, "ready\n", []), errors
