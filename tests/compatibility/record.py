"""Record what this version promises, for the tests of later versions, in a folder such as 1.0.

    tests/with-netns .venv/bin/python -m tests.compatibility.record CONFIGURATION

CONFIGURATION uses every key that there is: that of the version before, with the new keys. The name of the
folder is the version without its last number. It is made once, for a release: an existing one is never
changed.
"""

import asyncio
import json
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import uvloop
import yaml

from gateway import __version__
from gateway.config.loading import read
from gateway.errors import ConfigError
from gateway.simulator.synthetic import SyntheticScene
from tests.compatibility.comparing import keys_of
from tests.compatibility.lab import observe, running_lab
from tests.compatibility.promises import PROMISES, configuration
from tests.support.commands import run_in_process
from tests.support.configurations import MODEL
from tests.support.queried_gateway import query, zenoh_peer

HERE: Final = Path(__file__).parent
_TAKE_S: Final = 1.2
"""Long enough for the press and the release of a button.

When the take is played again, the server's time starts again before the gateway has a model of its clock
(1.5 s). So no value depends on whether there is one yet.
"""

_KEYS: Final = (
    *("3d", "6d", "6d/Tool%201", "analog", "force", "event", "status", "clock"),
    *("3d/json", "6d/json", "6d/Tool%201/json", "analog/json", "force/json", "event/json"),
)
_CHANNELS: Final = (
    *("3D", "6D", "6D_TOOL_1", "ANALOG", "FORCE", "EVENT", "STATUS", "CLOCK", "PARAMETERS"),
    *("PARAMETERS_REPLY", "COMMAND_REPLY", "3D_REFILL"),
)


def main() -> None:
    folder = HERE / ".".join(__version__.split(".")[:2])
    if len(sys.argv) != 2:
        sys.exit("give a configuration that uses every key")
    file = Path(sys.argv[1])
    if folder.exists():
        sys.exit(f"{folder} exists; what a release promises is never changed")
    try:
        read(file, MODEL, {})
    except ConfigError as error:
        sys.exit(str(error))
    schema = configuration()
    missing = keys_of(schema).keys() - set(_used_keys(yaml.safe_load(file.read_text())))
    if missing:
        sys.exit(
            f"{file} does not use {', '.join(sorted(missing))}; add them, with other values than the defaults"
        )
    with tempfile.TemporaryDirectory() as temporary:
        made = Path(temporary) / "made"
        made.mkdir()
        shutil.copy(file, made / "gateway.yaml")
        _write(made / "configuration.json", schema)
        for name, promise in PROMISES.items():
            _write(made / f"{name}.json", promise())
        uvloop.run(_record(made, Path(temporary)))
        shutil.copytree(made, folder)
    print(f"{folder} has what version {__version__} promises; commit it")


async def _record(folder: Path, temporary: Path) -> None:
    """Record a take of the simulator, play it, and record what a gateway shows of it."""
    # With this seed, nothing is out of view, so that no value is null in some frames only.
    scene = SyntheticScene(markers=3, tools=1, analog=2, plates=1, rate_hz=10, analog_rate_hz=20, seed=25)
    for name in ("first", "second"):
        (temporary / name).mkdir()
    take = folder / "take.lcmlog"
    async with running_lab(scene, temporary / "first") as running:
        with zenoh_peer(running.endpoint) as peer:
            about = "subject=S01;session=baseline;note=recorded for later versions"
            await query(peer, f"mocap/lab/take?set=start;name=walk;{about}")
            await asyncio.sleep(_TAKE_S)
            await query(peer, "mocap/lab/take?set=stop")
        [recorded] = running.takes.glob("**/walk*.lcmlog")
        shutil.copy(recorded, take)
    keys = [f"mocap/lab/{key}" for key in _KEYS]
    channels = [f"MOCAP_LAB_{channel}" for channel in _CHANNELS]
    network, outputs, _ = await observe(take, temporary / "second", keys, channels)
    _write(folder / "network.json", network)
    _write(folder / "json_outputs.json", outputs, temporary)
    info = run_in_process("take", "info", take, "--json")
    _write(folder / "take_info.json", json.loads(info.stdout), folder)


def _used_keys(values: Any, place: str = "") -> Iterator[str]:
    if isinstance(values, dict):
        for key, value in values.items():
            here = f"{place}.{key}".removeprefix(".")
            yield here
            yield from _used_keys(value, here)
    elif isinstance(values, list):
        for value in values:
            yield from _used_keys(value, f"{place}[]")


def _write(path: Path, content: object, temporary: Path | None = None) -> None:
    """Write JSON; a name in the folder ``temporary`` means nothing to anybody else."""
    text = json.dumps(content, indent=1, ensure_ascii=False, sort_keys=True)
    path.write_text(text.replace(f"{temporary}/", "") + "\n")


if __name__ == "__main__":
    main()
