import json
from pathlib import Path

import pytest
import yaml

from gateway.config.loading import shown_configuration
from tests.support.configurations import load, read

FILE = """\
sources:
  - name: lab
    host: 192.0.2.20
    streams: [{components: [6d], rate: {frequency_hz: 60}}]
zenoh:
  config: {mode: client, connect: {endpoints: [tcp/192.0.2.10:7447, tcp/192.0.2.11:7447]}}
lcm: {url: memq://}
"""


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("LCM_DEFAULT_URL", "STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    path = tmp_path / "lab.yaml"
    path.write_text(FILE)
    return path


def shown(path: Path, **variables: str) -> list[str]:
    """Return the lines, blanks made one, files as their last part, and variables without prefix."""
    environ = {f"RTC3D_GATEWAY__{name}": value for name, value in variables.items()}
    text = shown_configuration(read(path, environ)).replace(str(path), path.name)
    return [" ".join(line.split()) for line in text.replace("RTC3D_GATEWAY__", "").splitlines()]


def test_every_value_is_shown_with_its_origin(file: Path) -> None:
    lines = shown(file, LCM__PREFIX="HALL2", ZENOH__CONFIG__CONNECT__ENDPOINTS__1="tcp/192.0.2.12:7447")
    for line in (
        "- name: lab # lab.yaml:2",
        "port: 3020 # default",
        "frame_id: lab # default",
        "- components: [6d] # lab.yaml:4",
        "frequency_hz: 60.0 # lab.yaml:4",
        "backlog: all # default",
        "mode: client # lab.yaml:6",
        "endpoints: ['tcp/192.0.2.10:7447', 'tcp/192.0.2.12:7447'] "
        "# lab.yaml:6, ZENOH__CONFIG__CONNECT__ENDPOINTS__1",
        "prefix: HALL2 # LCM__PREFIX",
        "prefix: mocap # default",
        "url: memq:// # lab.yaml:7",
    ):
        assert line in lines
    is_section = [line.endswith(":") for line in lines]
    assert [" # " in line for line in lines] == [not section for section in is_section]


def test_a_variable_is_the_origin_of_a_whole_list_that_it_sets(file: Path) -> None:
    lines = shown(file, SOURCES__0__STREAMS="[{rate: all}]")
    assert "rate: all # SOURCES__0__STREAMS" in lines
    assert "- components: [3d, 6d, analog, force, event] # default" in lines


def test_values_from_the_environment_are_shown_as_used(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text(FILE.replace("lcm: {url: memq://}", ""))
    assert "url: udpm://239.255.76.67:7667?ttl=0 # default" in shown(file)
    monkeypatch.setenv("LCM_DEFAULT_URL", "udpm://239.255.76.68:7667?ttl=1")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/lab")
    lines = shown(file)
    assert "url: udpm://239.255.76.68:7667?ttl=1 # LCM_DEFAULT_URL" in lines
    assert "directory: /var/lib/lab/c3d # STATE_DIRECTORY" in lines


def test_the_output_is_an_equivalent_configuration(file: Path) -> None:
    configuration = read(file, {})
    again = file.with_name("again.yaml")
    again.write_text(shown_configuration(configuration))
    [source] = configuration.settings.sources
    sources = (source.model_copy(update={"frame_id": source.name}),)
    directory = configuration.settings.spool.effective_directory
    spool = configuration.settings.spool.model_copy(update={"directory": str(directory)})
    takes = configuration.settings.takes
    takes = takes.model_copy(update={"directory": str(takes.effective_directory)})
    before = configuration.settings.lcm
    lcm = before.model_copy(update={"queries_url": before.effective_queries_url})
    assert load(again, {}) == configuration.settings.model_copy(
        update={"sources": sources, "spool": spool, "lcm": lcm, "takes": takes}
    )


def test_unusual_keys_and_values_are_quoted(file: Path) -> None:
    metadata = {"on": "off", "12": "1e3", "a: b": "x # y", "lines": "a\nb", "list": [{}, {"a": []}, "x"]}
    inline = f"mode: client, metadata: {json.dumps(metadata)}"
    file.write_text(FILE.replace("mode: client", inline))
    values = yaml.safe_load(shown_configuration(read(file, {})))
    assert values["zenoh"]["config"]["metadata"] == metadata
