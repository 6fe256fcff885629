"""The programs in examples/ that receive what the gateway publishes: how each is built and run.

To add a program, add it to PROGRAMS, and what builds it, if anything does, to examples/Makefile. The tests in
tests/languages then run it:

- with the option --vectors, which lcm_types/vectors/README.md describes;
- with its ``arguments``: it says "listening" when it has subscribed. It prints a line for each frame, such as
  "#41 frame 7 at 0.0600 s with parameters 1: 18 of 20 markers in view, the first at 1.000, 2.000, 3.000 mm".
  It ends with status 0 after ``COUNT`` frames.
"""

import contextlib
import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gateway.messages.decode import MESSAGE_TYPES_BY_NAME
from tests.support.configurations import write_config
from tests.support.gateway_process import program, simulator
from tests.support.needs import need
from tests.support.networks import free_endpoint, zenoh_keys
from tests.support.waiting import wait_until

ROOT: Final = Path(__file__).parents[2]
EXAMPLES: Final = ROOT / "examples"
COUNT: Final = 20
LCM_URL: Final = "udpm://239.255.76.67:7712?ttl=0"

COMPONENT_TYPES: Final = frozenset({"markers_t", "tools_t", "analog_t", "forces_t", "events_t"})
BYTE_TABLE_TYPES: Final = COMPONENT_TYPES | {"tool_pose_t"}
"""What a program without generated code decodes."""

ALL_TYPES: Final = frozenset(MESSAGE_TYPES_BY_NAME)
_ON_LCM: Final = ("LAB", str(COUNT))
_ON_ZENOH: Final = ("--connect", "{endpoint}", "--source", "lab", "--count", str(COUNT))


_CSHARP: Final = ("mono", "build/subscriber.exe")
_JAVA: Final = ("java", "-jar", "build/subscriber.jar")
_RUST: Final = ("build/rust/release/subscriber",)
_OCTAVE_AT_EXIT: Final = b"error: ignoring const execution_exception& while preparing to exit\n"
"""What Octave 7 prints at its end on a machine without graphics, whatever it did."""
_OCTAVE: Final = ("sh", "-c", "exec octave-cli --quiet --no-init-file --eval \"read_take('$0')\"")


def printed_errors(run: subprocess.CompletedProcess[bytes]) -> bytes:
    """Return what a program has printed to stderr, without Octave's complaint about missing graphics."""
    return run.stderr.replace(_OCTAVE_AT_EXIT, b"")


@dataclass(frozen=True)
class ExampleProgram:
    """A program, in one file of examples/.

    ``command`` runs it in the folder examples. ``arguments`` make it subscribe to the markers of the source
    "lab" and end after COUNT frames; {endpoint} stands for the gateway's Zenoh endpoint. Without them, it
    only decodes. ``types`` are those that --vectors decodes. ``target`` is its name for ``make -C examples``;
    None if it is not built. ``tools`` are the programs that building and running it need.
    """

    name: str
    command: tuple[str, ...]
    arguments: tuple[str, ...] | None = None
    types: frozenset[str] = BYTE_TABLE_TYPES
    target: str | None = None
    tools: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.name

    def build(self) -> None:
        """Build the program if it is not up to date; skip the test if tools are missing, and fail in CI."""
        missing = [tool for tool in self.tools if shutil.which(tool) is None]
        packages = "docs/how-to/languages.md says what to install, and .ci/run installs it"
        need(not missing, f"the example {self.name} needs {' and '.join(missing)}: {packages}")
        if self.target is None:
            return
        make = ["make", "-C", str(EXAMPLES), f"PYTHON={sys.executable}", self.target]
        environment = {name: value for name, value in os.environ.items() if name != "MAKEFLAGS"}
        with (EXAMPLES / "Makefile").open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # other workers build, too
            built = subprocess.run(make, env=environment, capture_output=True, text=True, check=False)
        assert built.returncode == 0, built.stdout + built.stderr

    def run_command(self, endpoint: str) -> list[str]:
        """Return the command that prints COUNT frames."""
        return [*self.command, *(argument.format(endpoint=endpoint) for argument in self.arguments or ())]


def _python(file: str) -> tuple[str, ...]:
    return (sys.executable, file)


PROGRAMS: Final = (
    ExampleProgram("Python, LCM", _python("subscriber_lcm.py"), _ON_LCM, ALL_TYPES),
    ExampleProgram("Python, Zenoh", _python("subscriber_zenoh.py"), _ON_ZENOH),
    ExampleProgram("C, LCM", ("build/subscriber",), _ON_LCM, ALL_TYPES, "c", ("cc", "make")),
    ExampleProgram("C++, LCM", ("build/subscriber_cpp",), _ON_LCM, ALL_TYPES, "cpp", ("c++", "make")),
    ExampleProgram("Java, LCM", _JAVA, _ON_LCM, ALL_TYPES, "java", ("javac", "java", "make")),
    ExampleProgram("C#, LCM", _CSHARP, _ON_LCM, ALL_TYPES, "csharp", ("mcs", "mono", "make")),
    ExampleProgram("Lua, takes", ("lua5.4", "read_take.lua"), None, ALL_TYPES, "lua", ("lua5.4", "make")),
    ExampleProgram("Go, LCM", ("build/subscriber_go",), _ON_LCM, target="go", tools=("go", "make")),
    ExampleProgram("Rust, LCM", _RUST, _ON_LCM, target="rust", tools=("cargo", "make")),
    ExampleProgram(
        "JavaScript, LCM", ("node", "subscriber.js"), _ON_LCM, target="javascript", tools=("node",)
    ),
    ExampleProgram("Octave, takes", _OCTAVE, target="octave", tools=("octave-cli",)),
)


@contextlib.contextmanager
def run_program(*command: str, ready: str) -> Iterator["subprocess.Popen[str]"]:
    """Start a program, wait for ``ready`` in its output, and end it after the block."""
    environment = {**os.environ, "LCM_DEFAULT_URL": LCM_URL}
    with subprocess.Popen(
        command, env=environment, cwd=EXAMPLES, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if ready in line:
                    break
            else:
                raise AssertionError(f"{command} ended without {ready!r}")
            yield process
        finally:
            process.terminate()


def output_until_the_end(process: "subprocess.Popen[str]") -> str:
    """Return what a program of ``run_program`` prints until it ends by itself.

    (``communicate`` would lose what came together with the line that ``run_program`` waited for.)
    """
    assert process.stdout is not None
    text = process.stdout.read()
    process.wait(120)
    return text


@contextlib.contextmanager
def run_gateway(
    folder: Path, *simulated: str, ready: str, lcm: Mapping[str, str] | None = None
) -> Iterator[str]:
    """Run a gateway with the source "lab", whose server is a simulator with these options.

    ``lcm`` replaces its settings of LCM. Yields the gateway's Zenoh endpoint when it has logged ``ready``.
    """
    endpoint, log = free_endpoint(), folder / "gateway.log"
    with simulator(*simulated) as (port, _), log.open("wb") as stderr:
        zenoh = {"config": zenoh_keys("peer", listen=endpoint)}
        config = write_config(folder / "gateway.yaml", port, zenoh=zenoh, lcm=lcm or {"url": LCM_URL})
        with program("run", "--config", str(config), "--log-level", "debug", stderr=stderr):
            wait_until(lambda: ready in log.read_text())
            yield endpoint
