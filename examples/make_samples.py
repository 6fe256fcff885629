"""Record walk.lcmlog and walk.c3d: a walk over two force plates (walking.py), as a take and as a C3D file.

    python examples/make_samples.py [FOLDER]

A simulator plays the walk once, a gateway records it, and the take is exported. Nothing leaves this computer,
and its name is not in the files. FOLDER is that of this program by default; the files in it are replaced.
"""

import argparse
import asyncio
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import rtc3d
from walking import WalkingPerson

from gateway.config.settings import MetricsSettings, Settings, SourceSettings
from gateway.daemon.gateway import Gateway
from gateway.outputs.registry import settings_type
from gateway.outputs.takes.output import TakesOutput
from gateway.outputs.takes.settings import TakesSettings
from gateway.session.state import StreamState
from gateway.simulator.simulator import Simulator
from gateway.takes.export.job import ExportJob, export_take
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.writer_thread import LogFile

SOURCE: Final = "lab"
NAME: Final = "walk"
TIMEOUT_S: Final = 30.0
SERVER: Final = "127.0.0.1:3020"
HOST: Final = "example"
DESCRIPTIONS: Final[dict[Any, str]] = {rtc3d.status_t: "_STATUS", rtc3d.take_t: "_TAKE"}
"""The types of messages that name computers, and how their channels end."""


async def record(folder: Path) -> Path:
    """Record the walk in ``folder``; return the path of the take."""
    output = TakesOutput(TakesSettings(enabled=True, directory=str(folder)))
    async with asyncio.timeout(TIMEOUT_S), Simulator(WalkingPerson(), once=True) as simulator:
        gateway = Gateway(_settings(simulator.port), [output])
        stop = asyncio.Event()
        running = asyncio.create_task(gateway.run(stop))
        # The walk begins a second after the gateway has requested it.
        await until(lambda: simulator.connections)
        await output.takes(SOURCE).start(NAME)
        [source] = gateway.sources
        await until(
            lambda: all(
                status.frames_in and status.state is StreamState.NO_MEASUREMENT for status in source.statuses
            )
        )
        await output.takes(SOURCE).stop()
        stop.set()
        await running
    return folder / SOURCE / f"{NAME}.lcmlog"


async def until(condition: Callable[[], object]) -> None:
    """Wait until ``condition`` is true."""
    while not condition():  # noqa: ASYNC110 - what it reads has no events
        await asyncio.sleep(0.02)


def _settings(port: int) -> Settings:
    source = SourceSettings(name=SOURCE, host="127.0.0.1", port=port)
    return settings_type()(sources=(source,), metrics=MetricsSettings(enabled=False))


def without_names_of_computers(channel: str, message: bytes) -> bytes:
    """Return a message in which this computer has another name."""
    for kind, end in DESCRIPTIONS.items():
        if channel.endswith(end):
            described = kind.decode(message)
            described.host, described.server = HOST, SERVER
            encoded: bytes = described.encode()
            return encoded
    return message


def main() -> None:
    """Make both files."""
    parser = argparse.ArgumentParser(description="Record the sample files walk.lcmlog and walk.c3d.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parent)
    folder: Path = parser.parse_args().folder
    take, c3d = folder / f"{NAME}.lcmlog", folder / f"{NAME}.c3d"
    for path in (take, c3d):
        path.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as recorded:
        events = [*TakeReader(asyncio.run(record(Path(recorded)))).events()]
    log = LogFile(take)
    log.append(
        [(each.channel.encode(), without_names_of_computers(each.channel, each.message)) for each in events]
    )
    log.close()
    export_take(ExportJob(take, c3d))
    for path in (take, c3d):
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
