"""Checks of the documents: links, commands, configurations, tables of bytes, causes of drops.

The commands of some pages are run as well, in tests/integration/commands and takes; those of other pages are
parsed by the program, because they name servers that nobody has.
"""

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Final

import pytest
import rtc3d
import typer.core
import yaml
import zenoh

from gateway.messages.decode import MESSAGE_TYPES_BY_NAME
from gateway.messages.encode import ITEMS_OFFSET, MESSAGE_TYPES
from gateway.rtc3d.components import ITEM_DTYPES
from gateway.simulator.simulator import load_scenario
from gateway.tools.cli.main import app
from tests.support.configurations import MODEL, load
from tests.support.documents import ROOT, Block, all_blocks, blocks, documents
from tests.support.fresh_clones import clone_into, files_in
from tests.support.log_messages import messages
from tests.support.log_messages_page import update

LOG_MESSAGES = (ROOT / "docs/reference/log-messages.md").read_text()
REFERENCE = (ROOT / "docs/reference/messages.md").read_text()
WHAT_IS_LOST = (ROOT / "docs/explanation/what-is-lost.md").read_text()
PROGRAM = "rtc3d-gateway"
CLONE = ("git", "clone")
WRAPPERS = {"sudo", "tests/with-netns"}
FOLDERS = ("benchmarks", "config", "docs", "examples", "lcm_types", "systemd", "tests")
OTHERS = {"/tf_static", "/mocap/lab/labels", "scrape_configs", "rule_files"}
"""First keys of YAML for ROS, and for Prometheus, at which tests/integration/test_monitoring.py looks."""


def commands() -> list[tuple[str, tuple[str, ...]]]:
    """Return the words of each command in the documents, with its place, without what is behind a pipe."""
    found = []
    for block in all_blocks("sh"):
        text = re.sub(r"\\\n", " ", block.text)
        for line in re.sub(r"'[^']*'", lambda quoted: quoted[0].replace("\n", " "), text).splitlines():
            try:
                words = shlex.split(line, comments=True)
            except ValueError:
                continue  # a quotation over several lines: a shell's own
            while words and (words[0] in WRAPPERS or re.match(r"\w+=", words[0])):
                words.pop(0)
            end = next((i for i, word in enumerate(words) if re.fullmatch(r"[|>&;]+", word)), len(words))
            if words[:end]:
                found.append((block.place, tuple(words[:end])))
    return found


COMMANDS = commands()
OURS = [(place, words) for place, words in COMMANDS if Path(words[0]).name == PROGRAM]


def variables_behind(block: Block) -> list[tuple[str, str]]:
    """Return the variables that the page says to set for a configuration, in the next block."""
    variable = re.compile(r"^(RTC3D_GATEWAY__\w+)=(.*)$", re.MULTILINE)
    there = blocks(block.document)
    return [pair for each in there[there.index(block) + 1 :][:1] for pair in variable.findall(each.text)]


def of(some: list[Block]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("block", [pytest.param(block, id=block.place) for block in some])


def test_there_is_something_to_check() -> None:
    assert {"README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/design.md"} <= set(documents())
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    assert {words[1] for _, words in OURS if words[1][0] != "-"} == group.commands.keys()
    assert {block.document for block in all_blocks("yaml")} >= {"README.md", "docs/tutorial.md"}


@pytest.mark.parametrize("document", documents())
def test_relative_links_point_to_files(document: str) -> None:
    path = ROOT / document
    links = re.findall(r"\]\(([^)\s]+)\)", path.read_text())
    relative = [link.partition("#")[0] for link in links if not re.match(r"[a-z]+:|#", link)]
    assert [link for link in relative if not (path.parent / link).exists()] == []


@of([block for block in all_blocks("yaml") if block.document != "docs/how-to/write-an-output.md"])
def test_yaml_is_what_a_program_takes(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file for an output of another package is in use in test_how_to."""
    for name, value in variables_behind(block):
        monkeypatch.setenv(name, value)
    content = yaml.safe_load(block.text)
    file = tmp_path / "file.yaml"
    file.write_text(block.text)
    if content.keys() & {"scene", "faults"}:
        assert load_scenario(file).faults
    elif content.keys() <= MODEL.model_fields.keys():
        for other in ROOT.glob("config/*.json5"):
            shutil.copy(other, tmp_path)
        assert load(file).sources
    else:
        assert content.keys() <= OTHERS


@of(all_blocks("json5"))
def test_json5_is_zenohs(block: Block) -> None:
    text = block.text if block.text.lstrip().startswith("{") else f"{{{block.text}}}"
    assert zenoh.Config.from_json5(text)


@pytest.mark.parametrize("file", sorted(ROOT.glob("config/sites/*")), ids=lambda path: path.name)
def test_the_files_for_sites_are_what_a_program_takes(file: Path) -> None:
    assert load(file).sources if file.suffix == ".yaml" else zenoh.Config.from_file(str(file))


@pytest.mark.parametrize(("place", "words"), [pytest.param(*each, id=each[0]) for each in OURS])
def test_commands_have_these_subcommands_and_options(place: str, words: tuple[str, ...]) -> None:
    command = typer.main.get_command(app)
    _, *arguments = words
    while isinstance(command, typer.core.TyperGroup):
        if arguments[0].startswith("-"):  # an option of the program itself, which would be carried out
            assert arguments[0] in {option for each in command.params for option in each.opts}, place
            return
        subcommand = command.get_command(typer.Context(command), arguments[0])
        assert subcommand is not None, f"{place}: no {arguments[0]}"
        command, arguments = subcommand, arguments[1:]
    command.make_context(PROGRAM, arguments)  # raises UsageError; runs nothing


def test_files_and_make_targets_that_commands_name_are_there() -> None:
    makefiles = "\n".join(path.read_text() for path in (ROOT / "Makefile", *ROOT.glob("*/*.mk")))
    targets = set(re.findall(r"^([\w-]+):", makefiles, re.MULTILINE))
    for place, (program, *arguments) in COMMANDS:
        if program == "make" and "-C" not in arguments:
            assert {word for word in arguments if "=" not in word} <= targets, place
        for word in (program, *arguments):
            if word.startswith(FOLDERS) and "/" in word and "/build/" not in word:
                assert list(ROOT.glob(word.partition("::")[0])), f"{place}: {word}"


def test_documents_clone_the_repository_that_the_project_names() -> None:
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]
    cloned = {place: words[2] for place, words in COMMANDS if words[:2] == CLONE}
    assert {place.partition(":")[0] for place in cloned} >= {"README.md", "docs/tutorial.md"}
    assert set(cloned.values()) == {urls["Repository"]}, f"run make clone-url URL=…: {cloned}"
    assert next(iter(blocks("README.md", "sh"))).text.startswith("git clone ")


def test_readme_is_short_and_shows_the_data_of_a_server_within_300_words() -> None:
    """It was 350 lines long, and came to the reader's own server after 868 words."""
    text = (ROOT / "README.md").read_text()
    assert text.count("\n") <= 150
    assert len(text.partition("rtc3d-gateway view")[0].split()) < 300


def test_one_command_changes_the_address_of_the_repository_everywhere(tmp_path: Path) -> None:
    clone_into(tmp_path)
    new = "https://git.example.net/lab/gateway.git"
    subprocess.run(["make", "clone-url", f"URL={new}"], cwd=tmp_path, check=True, capture_output=True)
    changed = {
        name: (tmp_path / name).read_text()
        for name in files_in(tmp_path)
        if (ROOT / name).read_bytes() != (tmp_path / name).read_bytes()
    }
    old = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]["Repository"]
    assert tomllib.loads(changed["pyproject.toml"])["project"]["urls"]["Repository"] == new
    pages = {place.partition(":")[0] for place, words in COMMANDS if words[:2] == CLONE}
    assert changed.keys() == pages | {"pyproject.toml"}
    assert not any(old in text for text in changed.values())


# In the file, not on the command line: with the options of `make types`, mypy uses the cache of `make types`.
MYPY_OPTIONS: Final = '# mypy: allow-any-generics, allow-untyped-calls, disable-error-code="union-attr"'


def test_python_is_what_a_type_checker_takes(tmp_path: Path) -> None:
    """Each block is a whole program, with its imports. Those that need a gateway are run by other tests."""
    files = []
    for number, block in enumerate(all_blocks("python")):
        file = tmp_path / f"block_{number}.py"
        file.write_text(f"# {block.place}\n{block.text}\n{MYPY_OPTIONS}\n")
        files.append(str(file))
    assert len(files) > 5
    checked = subprocess.run(
        [sys.executable, "-m", "mypy", *files], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_the_reference_has_the_fingerprint_and_sizes_of_every_type() -> None:
    rows = re.findall(r"^\| `(\w+_t)` \| `(\w{16})` \| ([\w ]+) \| (\d*) ?\|$", REFERENCE, re.MULTILINE)
    assert {name for name, *_ in rows} >= set(MESSAGE_TYPES_BY_NAME)
    for name, fingerprint, *_ in rows:
        assert fingerprint == getattr(rtc3d, name)._get_packed_fingerprint().hex(), name
    sizes = {name: (header_bytes, item_bytes) for name, _, header_bytes, item_bytes in rows}
    for component, message_type in MESSAGE_TYPES.items():
        item_bytes = ITEM_DTYPES[component].itemsize
        assert sizes[message_type.__name__] == (str(ITEMS_OFFSET), str(item_bytes))
    assert sizes["tool_pose_t"] == (f"{len(rtc3d.tool_pose_t().encode())} in all", "")


def test_the_page_about_loss_lists_every_cause_of_a_drop_and_no_other() -> None:
    documented = set(
        re.findall(r"^\| `([a-zC3D ]+)` \| (?:stream|output|LCM|Zenoh) \|", WHAT_IS_LOST, re.MULTILINE)
    )
    for_others = {"demo_lab.py", "memory.py"}
    sources = [path for path in ROOT.glob("gateway/**/*.py") if path.name not in for_others]
    text = "\n".join(path.read_text() for path in sources)
    counted = set(
        re.findall(
            r'(?:\blost\(\s*|_count_loss\(\s*|\bcause=|(?:_REJECTED|SKIPPED): Final = )"([^"]+)"', text
        )
    )
    assert len(counted) > 7
    assert counted <= documented
    assert {cause for cause in documented if f'"{cause}"' not in text} == set()


def test_the_design_names_every_module() -> None:
    layers = (ROOT / "docs/design.md").read_text().partition("\n## Layers\n")[2].partition("\n## ")[0]
    modules = {path.stem for path in ROOT.glob("gateway/*.py")} | {
        path.parent.name for path in ROOT.glob("gateway/*/__init__.py")
    }
    named = {part for name in re.findall(r"`([\w/]+)`", layers) for part in name.split("/")}
    assert modules - {"__init__", "__main__"} <= named


def test_the_page_of_log_messages_is_that_of_the_source_code_with_advice_for_each() -> None:
    """After a change of a message, ``make messages`` writes the page; only the advice is written by hand."""
    in_source = messages(ROOT / "gateway")
    result = update(LOG_MESSAGES, in_source)
    assert result.without_advice == []
    assert result.page == LOG_MESSAGES, "run make messages"
    assert len(in_source) > 150  # the messages are found at all
