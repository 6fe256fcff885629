from pathlib import Path
from typing import Any

import pytest

from gateway.config.settings import SourceSettings
from gateway.errors import ConfigError
from gateway.outputs.lcm.settings import LcmSettings
from tests.support.configurations import load, make_settings, read, read_server
from tests.support.errors import names

FILE = """\
sources:
  - name: lab
    host: 192.0.2.20
    streams:
      - {components: [3d], rate: all}
      - {components: [analog], rate: {divisor: 2}}
zenoh: {config: {mode: client, connect: {endpoints: [tcp/192.0.2.10:7447]}}}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "lab.yaml"
    path.write_text(FILE)
    return path


def with_prefix(variables: dict[str, str]) -> dict[str, str]:
    return {f"RTC3D_GATEWAY__{name}": value for name, value in variables.items()}


def refused(path: Path | None, **variables: str) -> list[str]:
    """Return the lines of the error, the file as its last part only and the variables without prefix."""
    with pytest.raises(ConfigError) as caught:
        load(path, with_prefix(variables))
    return str(caught.value).replace("RTC3D_GATEWAY__", "").replace(f"{path}:", "lab.yaml:").splitlines()


def test_a_variable_stands_over_the_file(file: Path) -> None:
    variables = {"LCM__URL": "memq://", "SOURCES__0__HOST": "lab-pc", "SOURCES__0__PORT": "3030"}
    settings = load(file, with_prefix(variables))
    assert settings.lcm == LcmSettings(url="memq://")
    assert (settings.sources[0].host, settings.sources[0].port) == ("lab-pc", 3030)
    assert settings.sources[0].streams == load(file, {}).sources[0].streams


def test_the_processes_own_environment_counts(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTC3D_GATEWAY__LCM__PREFIX", "HALL2")
    assert load(file).lcm.prefix == "HALL2"
    assert read_server("lab-pc", 3020).settings.lcm.prefix == "HALL2"


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("LCM__URL", "", None),
        ("LCM__URL", "null", None),
        ("LCM__MAX_RATE_HZ", "{3d: 60}", {"3d": 60}),
        ("SOURCES__0__NAME", "2026-06-01", "2026-06-01"),
        ("SOURCES__0__NAME", "'7'", "7"),
        ("SOURCES__0__STREAMS__1__RATE__DIVISOR", "5", 5),
        ("ZENOH__CONFIG", "{mode: peer}", {"mode": "peer"}),
    ],
)
def test_values_are_yaml(file: Path, name: str, value: str, expected: object) -> None:
    found: Any = load(file, with_prefix({name: value})).model_dump(mode="json")
    for step in name.lower().split("__"):
        found = found[int(step) if step.isdigit() else step]
    assert found == expected


def test_variables_are_applied_mappings_first_and_items_in_their_order(file: Path) -> None:
    """The environment has no order of its own; item 10 is not between 1 and 2."""
    variables = {"LCM__PREFIX": "A", "LCM": "{prefix: B, url: memq://}"}
    assert load(file, with_prefix(variables)).lcm == LcmSettings(prefix="A", url="memq://")
    variables = {f"SOURCES__{n}__NAME": f"s{n}" for n in range(12)}
    variables |= {f"SOURCES__{n}__HOST": "lab" for n in range(12)}
    names = [source.name for source in load(None, with_prefix(variables)).sources]
    assert names == [f"s{n}" for n in range(12)]


def test_relative_paths_count_from_the_files_folder(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zenoh_file = file.parent / "zenoh.json5"
    zenoh_file.write_text("{mode: 'client'}")
    assert load(file, with_prefix({"ZENOH__CONFIG": "zenoh.json5"})).zenoh.config == zenoh_file
    monkeypatch.chdir(file.parent)
    variables = {"SOURCES": "[{name: lab, host: lab}]", "ZENOH__CONFIG": "zenoh.json5"}
    assert load(None, with_prefix(variables)).zenoh.config == zenoh_file


@pytest.mark.parametrize(
    "name", ["RTC3D_GATEWAY_SERVICE_HOST", "RTC3D_GATEWAY_PORT", "rtc3d_gateway__lcm__url", "LCM__URL"]
)
def test_other_names_are_not_ours(file: Path, name: str) -> None:
    assert load(file, {name: "tcp://10.0.0.1:9464"}) == load(file, {})


RATE = "SOURCES__0__STREAMS__0__RATE"
MISTAKES: list[tuple[str, str, str]] = [
    # The name and the value of a variable, and how the error's one line begins after the name.
    ("LCM__ULR", "memq://", "lcm.ulr: unknown key (did you mean 'url'?); known keys: enabled, prefix, "),
    ("LMC__URL", "memq://", "lmc: unknown key (did you mean 'lcm'?); known keys: sources, "),
    ("SOURCES__0__PORT", "abc", "sources[0].port: found 'abc'; expected a whole number"),
    ("SOURCES__0__PORT", "", "sources[0].port: found nothing; expected a whole number"),
    ("SOURCES__0__NAME", "7", "sources[0].name: found 7 (use quotes to make it text); expect"),
    ("SOURCES__1__NAME", "b", "sources[1].host: missing; this key is required"),
    ("SOURCES__2__NAME", "c", "sources: found the index '2'; expected a number from 0 to 1"),
    ("SOURCES__HOST", "c", "sources: found the index 'host'; expected a number from 0 to 1"),
    (
        f"{RATE}__DIVISOR",
        "2",
        "sources[0].streams[0].rate: this value is 'all' (lab.yaml:5:34), which has no keys; "
        f"set the whole value with {RATE}",
    ),
    ("LCM", "{url: [", "not YAML: while parsing a flow node from line 1: expected the node content, but "),
    ("LCM__URL", "\udcff", "found the character U+DCFF, which YAML does not allow"),
    ("", "1", "does not name a key; expected a name such as LCM__URL"),
    ("LCM__", "1", "does not name a key; expected a name such as LCM__URL"),
]


@pytest.mark.parametrize(("name", "value", "error"), MISTAKES, ids=[name for name, _, _ in MISTAKES])
def test_a_mistake_is_told_with_the_variable(file: Path, name: str, value: str, error: str) -> None:
    [line] = refused(file, **{name: value})
    assert line.startswith(f"{name}: {error}")


def test_what_zenoh_refuses_is_told_with_the_place_of_its_keys(file: Path) -> None:
    [line] = refused(file, ZENOH__CONFIG__MODES="x")
    assert line.startswith("lab.yaml:7:17: zenoh.config: ")
    assert names(line, "`modes`")


def test_mistakes_of_the_file_come_first(file: Path) -> None:
    file.write_text(FILE + "spool: {max_files: 0}\n")
    lines = refused(file, SPOOL__MAX_BYTES="0", LCM__PREFIX="Ä")
    assert [line.partition(": ")[0] for line in lines] == ["lab.yaml:8:20", "LCM__PREFIX", "SPOOL__MAX_BYTES"]


def test_one_server_has_the_defaults_and_its_mistakes_are_told() -> None:
    source = SourceSettings(name="lab", host="::1", port=3030)
    assert read_server("::1", 3030, {}).settings == make_settings(sources=(source,))
    with pytest.raises(ConfigError) as caught:
        read_server("two words", 0, {})
    assert [line.partition(";")[0] for line in str(caught.value).splitlines()] == [
        "--server: sources[0].host: found 'two words'",
        "--server: sources[0].port: found 0",
    ]


def test_places_tell_where_each_value_is_from(file: Path) -> None:
    positions = read(file, with_prefix({"ZENOH__CONFIG": "{mode: client}"})).positions
    assert str(positions["sources", 0, "host"]) == f"{file}:3:11"
    assert str(positions["zenoh", "config", "mode"]) == "RTC3D_GATEWAY__ZENOH__CONFIG"
    assert ("zenoh", "config", "connect", "endpoints") not in positions
    assert ("lcm",) not in positions
