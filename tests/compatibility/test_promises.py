"""What earlier versions promised, read from the program and its files: it may grow, but not change.

If a test fails, keep the old form, or offer the new one beside it: docs/reference/compatibility.md. The
recorded files of a version are never changed.
"""

import json
import runpy
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from gateway import __version__
from gateway.takes import open_take
from gateway.takes.files.event_log import EventLogReader
from tests.compatibility import record
from tests.compatibility.comparing import broken, broken_schema
from tests.compatibility.lab import SUBSCRIBER
from tests.compatibility.promises import ALL_VERSIONS, PROMISES, VERSIONS, configuration, recorded
from tests.support.commands import run_in_process
from tests.support.configurations import load

each_version = pytest.mark.parametrize("version", VERSIONS, ids=lambda path: path.name)


@each_version
@pytest.mark.parametrize("name", PROMISES)
def test_what_was_there_is_there_unchanged(version: Path, name: str) -> None:
    """Nobody asks subscribers, dashboards, scripts and packages of others before an update."""
    changes = list(broken(recorded(version, name), PROMISES[name]()))
    assert not changes, f"{version.name} promised these {name}"


@each_version
def test_the_keys_of_the_configuration_accept_what_they_accepted(version: Path) -> None:
    changes = list(broken_schema(recorded(version, "configuration"), configuration()))
    assert not changes, f"{version.name} accepted these configurations"


@each_version
def test_a_configuration_with_every_key_means_what_it_meant(version: Path) -> None:
    file = version / "gateway.yaml"
    changes = list(broken(yaml.safe_load(file.read_text()), load(file, {}).model_dump(mode="json")))
    assert not changes, f"{version.name} read these values from {file}"


def test_a_name_and_a_host_are_enough(tmp_path: Path) -> None:
    """No key that was optional is required; the defaults are compared above."""
    (tmp_path / "lab.yaml").write_text("sources: [{name: lab, host: 192.0.2.20}]\n")
    assert load(tmp_path / "lab.yaml", {}).sources[0].port == 3020


@each_version
def test_variables_set_the_same_configuration(version: Path) -> None:
    """Containers are configured by variables; the name of each comes from its key."""
    file = version / "gateway.yaml"
    sections = yaml.safe_load(file.read_text())
    groups = {f"SOURCES__{number}": source for number, source in enumerate(sections.pop("sources"))}
    environ = {
        f"RTC3D_GATEWAY__{group}__{key}".upper(): json.dumps(value)
        for group, values in (groups | sections).items()
        for key, value in values.items()
    }
    assert load(None, environ) == load(file, {})


def messages_of(take: Path) -> Iterator[dict[str, Any]]:
    """Yield the messages of a take, as the subscriber of 1.0 decodes them."""
    decode = runpy.run_path(str(SUBSCRIBER))["decode"]
    for event in EventLogReader(take).events():
        values = decode(event.message)
        if values is not None:
            yield {"channel": event.channel} | values


@pytest.mark.parametrize("version", ALL_VERSIONS, ids=lambda path: path.name)
def test_a_take_has_the_arrays_that_it_had(version: Path) -> None:
    """Recordings are kept for decades."""
    by_type = defaultdict(list)
    for values in messages_of(version / "take.lcmlog"):
        by_type[values["type"]].append(values)
    [source] = open_take(version / "take.lcmlog").sources.values()
    assert (source.name, source.details.subject, source.details.session) == ("lab", "S01", "baseline")
    for type_name, field, series in (
        ("markers_t", "markers", source.markers),
        ("tools_t", "tools", source.tools),
        ("analog_t", "voltages", source.analog),
        ("forces_t", "plates", source.forces),
    ):
        frames = by_type[type_name]
        items = [[list(item.values()) for item in frame[field]] for frame in frames]
        assert series is not None
        assert np.array_equal(
            series.values, np.array(items, np.float32).reshape(series.values.shape), equal_nan=True
        )
        assert series.capture_utime.tolist() == [frame["capture_utime"] for frame in frames]
        assert series.timestamp_us.tolist() == [frame["timestamp"] for frame in frames]
        assert series.sequence.tolist() == [frame["sequence"] for frame in frames]
        assert np.allclose(series.seconds, (series.capture_utime - series.start_utime) / 1e6)
    assert source.markers is not None
    assert source.markers.labels == ("Marker 1", "Marker 2", "Marker 3")
    assert source.markers.units == ("mm",) * 3
    assert source.events is not None
    events = [event for frame in by_type["events_t"] for event in frame["events"]]
    assert source.events.items["id"].tolist() == [event["id"] for event in events]
    assert source.events.items["param1"].tolist() == [event["param1"] for event in events]
    assert source.events.event_labels


@each_version
def test_take_info_says_of_a_take_what_it_said(version: Path) -> None:
    done = run_in_process("take", "info", version / "take.lcmlog", "--json")
    expected = recorded(version, "take_info")
    of_the_file = {key: expected.pop(key) for key in ("file", "files")}
    now = json.loads(done.stdout)
    assert not list(broken(expected, now))
    assert of_the_file.keys() <= now.keys()


def test_what_a_version_has_promised_is_never_recorded_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["record", str(VERSIONS[0] / "gateway.yaml")])
    monkeypatch.setattr(record, "__version__", f"{VERSIONS[0].name}.9")
    with pytest.raises(SystemExit, match="exists"):
        record.main()


def test_this_version_has_recorded_promises() -> None:
    """Otherwise nothing above is tested."""
    assert __version__.partition(".")[0] in {version.name.partition(".")[0] for version in VERSIONS}
