"""The documents tell the truth as far as a machine can see: links, commands, configurations, byte tables."""

import re
import shlex
from pathlib import Path

import pytest
import rtc3d
import typer.core

from gateway import config_file
from gateway.cli import app
from gateway.decode import MESSAGE_TYPES_BY_NAME
from gateway.message import MESSAGE_HEADER_BYTES, MESSAGE_TYPES
from gateway.rtc3d.components import ITEM_DTYPES

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
REFERENCE = (ROOT / "docs/reference/messages.md").read_text()
PROGRAM = "rtc3d-gateway"


def documents() -> list[str]:
    folders = (ROOT.glob("*.md"), *(ROOT.glob(f"{name}/**/*.md") for name in ("docs", "config", "examples")))
    return sorted(str(path.relative_to(ROOT)) for paths in folders for path in paths)


def blocks(language: str) -> list[str]:
    """Return the contents of README's fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Return the lines of README's sh blocks that run the program, without comments."""
    lines = [line for block in blocks("sh") for line in block.replace("\\\n", " ").splitlines()]
    return [shlex.join(words) for line in lines if PROGRAM in (words := shlex.split(line, comments=True))]


def test_there_is_something_to_check() -> None:
    assert {"README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/design.md"} <= set(documents())
    assert {shlex.split(command)[1] for command in commands()} >= {
        "run",
        "check",
        "simulate",
        "echo",
        "params",
    }
    assert any(block.startswith("sources:") for block in blocks("yaml"))


@pytest.mark.parametrize("document", documents())
def test_relative_links_point_to_files(document: str) -> None:
    path = ROOT / document
    links = re.findall(r"\]\(([^)\s]+)\)", path.read_text())
    relative = [link.partition("#")[0] for link in links if not re.match(r"[a-z]+:|#", link)]
    assert [link for link in relative if not (path.parent / link).exists()] == []


@pytest.mark.parametrize("block", [block for block in blocks("yaml") if block.startswith("sources:")])
def test_configurations_can_be_loaded(block: str, tmp_path: Path) -> None:
    file = tmp_path / "gateway.yaml"
    file.write_text(block)
    assert config_file.load(file).sources


@pytest.mark.parametrize("command", commands())
def test_commands_have_these_subcommands_and_options(command: str) -> None:
    name, *arguments = shlex.split(command)[1:]
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    assert name in group.commands
    group.commands[name].make_context(name, arguments)  # raises UsageError; runs nothing


def test_the_reference_has_the_fingerprint_and_sizes_of_every_type() -> None:
    rows = re.findall(r"^\| `(\w+_t)` \| `(\w{16})` \| ([\w ]+) \| (\d*) ?\|$", REFERENCE, re.MULTILINE)
    assert {name for name, *_ in rows} >= set(MESSAGE_TYPES_BY_NAME)
    for name, fingerprint, *_ in rows:
        assert fingerprint == getattr(rtc3d, name)._get_packed_fingerprint().hex(), name
    sizes = {name: (header_bytes, item_bytes) for name, _, header_bytes, item_bytes in rows}
    for component, message_type in MESSAGE_TYPES.items():
        item_bytes = ITEM_DTYPES[component].itemsize
        assert sizes[message_type.__name__] == (str(MESSAGE_HEADER_BYTES), str(item_bytes))
    assert sizes["tool_pose_t"] == (f"{len(rtc3d.tool_pose_t().encode())} in all", "")
