"""examples/read_take.m, run by Octave: what it reads from takes, and what it prints."""

import re
import subprocess
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.takes import open_take
from tests.support.example_programs import EXAMPLES, PROGRAMS, printed_errors
from tests.support.message_vectors import VECTORS
from tests.support.takes import description, frame, log_bytes, markers, parameters, write_take

[OCTAVE] = [program for program in PROGRAMS if program.name.startswith("Octave")]
SAMPLE: Final = EXAMPLES / "walk.lcmlog"


@pytest.fixture(autouse=True, scope="module")
def octave() -> None:
    OCTAVE.build()


def octave_prints(code: str) -> tuple[str, str]:
    """Run code with read_take.m, and return what Octave prints: results, and warnings."""
    run = subprocess.run(
        ["octave-cli", "--quiet", "--no-init-file", "--path", str(EXAMPLES), "--eval", code],
        capture_output=True, check=False, timeout=120,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return run.stdout.decode(), printed_errors(run).decode()


class OctaveTake:
    """What read_take.m returns for a take: each field of a channel as an array."""

    def __init__(self, take: Path, tmp_path: Path) -> None:
        self.folder = tmp_path / "values"
        self.folder.mkdir()
        _, self.warnings = octave_prints(f"""
            take = read_take('{take}');
            for channel = fieldnames(take)'
                frames = take.(channel{{1}});
                if ischar(frames), frames = struct('xml', frames); end
                for field = fieldnames(frames)'
                    values = frames.(field{{1}});
                    kind = class(values);
                    if iscell(values), values = strjoin(values, '|'); end
                    name = sprintf('%s.%s.%s.%d', channel{{1}}, field{{1}}, kind, size(values, 2));
                    id = fopen(['{self.folder}/' name], 'w');
                    fwrite(id, values', class(values));
                    fclose(id);
                end
            end
        """)
        self.channels = {path.name.split(".")[0] for path in self.folder.iterdir()}

    def __call__(self, channel: str, field: str) -> Any:
        [path] = self.folder.glob(f"MOCAP_LAB_{channel}.{field}.*")
        _, _, kind, columns = path.name.split(".")
        if kind == "char":
            return path.read_text(encoding="utf-8")
        if kind == "cell":
            return path.read_text(encoding="utf-8").split("|")
        values = np.fromfile(path, {"single": "f4", "double": "f8"}.get(kind, kind))
        return values if columns == "1" else values.reshape(-1, int(columns))


def test_the_sample_take_has_the_same_values_labels_and_times_as_in_python(tmp_path: Path) -> None:
    found = OctaveTake(SAMPLE, tmp_path)
    source = open_take(SAMPLE).sources["lab"]
    channels = {"3D": source.markers, "6D": source.tools, "FORCE": source.forces, "ANALOG": source.analog}
    first = min(series.capture_utime[0] for series in (*channels.values(), source.events) if series)
    for channel, series in channels.items():
        assert series is not None
        for field in series.items.dtype.names or ["voltages"]:
            expected = series.items[field] if series.items.dtype.names else series.items
            np.testing.assert_array_equal(found(channel, field), expected, f"{channel} {field}")
        for field in ("utime", "capture_utime", "sequence", "session", "parameters_version", "frame_number"):
            np.testing.assert_array_equal(found(channel, field), getattr(series, field))
        np.testing.assert_array_equal(found(channel, "timestamp"), series.timestamp_us)
        np.testing.assert_allclose(found(channel, "time_s"), (series.capture_utime - first) / 1e6)
        assert found(channel, "labels") == list(series.labels)
    assert source.events is not None
    for field in ("id", "param1", "param2", "param3"):
        np.testing.assert_array_equal(found("EVENT", field), source.events.items[field])
    np.testing.assert_array_equal(found("EVENT", "event_timestamp"), source.events.items["timestamp"])
    assert found("PARAMETERS", "xml").startswith("<RT_Parameters")
    assert found.warnings == ""


def test_frames_may_have_different_numbers_of_items(tmp_path: Path) -> None:
    events = [[], [(1, 2**60, 2, 3, 4)], [(-1, -5, 0, -1, -1), (7, 8, 9, 10, 11)]]
    labels = "<Marker id='1'><Label>Ä &amp;lt; B</Label></Marker><Marker id='2'><Label/></Marker>"
    xml = f"<RT_Parameters><The_3D><Markers>{labels}</Markers></The_3D></RT_Parameters>"
    messages = [description(), parameters(xml.encode())]
    messages += [markers(count, number) for number, count in enumerate((2, 1, 0, 2))]
    messages += [frame(ComponentType.EVENT, items, number) for number, items in enumerate(events)]
    take = write_take(tmp_path / "take.lcmlog", messages)
    found = OctaveTake(take, tmp_path)
    np.testing.assert_array_equal(found("3D", "x"), [[0, 1], [0, np.nan], [np.nan] * 2, [0, 1]])
    np.testing.assert_array_equal(found("3D", "y"), [[0, 0], [1, np.nan], [np.nan] * 2, [3, 3]])
    np.testing.assert_array_equal(found("3D", "num_markers"), [2, 1, 0, 2])
    assert found("3D", "labels") == ["Ä &lt; B", ""]
    np.testing.assert_array_equal(found("EVENT", "id"), [1, -1, 7])
    np.testing.assert_array_equal(found("EVENT", "event_timestamp"), [2**60, -5, 8])
    np.testing.assert_array_equal(found("EVENT", "frame_number"), [1, 2, 2])
    assert found.channels == {"MOCAP_LAB_3D", "MOCAP_LAB_EVENT", "MOCAP_LAB_PARAMETERS"}


def test_poses_of_tools_have_a_row_for_each_message(tmp_path: Path) -> None:
    poses = [vector for vector in VECTORS if vector.type_name == "tool_pose_t"]
    messages = [("MOCAP_LAB_6D_TOOL_1", vector.data) for vector in poses]
    malformed = [("MOCAP_LAB_6D_TOOL_2", poses[0].data[:-1])]
    found = OctaveTake(write_take(tmp_path / "take.lcmlog", [*messages, *malformed, markers(2, 1)]), tmp_path)
    for field in ("visible", "position_m", "orientation_xyzw", "error_m"):
        expected = np.array([vector.values[field] for vector in poses], float)  # "nan" becomes NaN
        np.testing.assert_allclose(found("6D_TOOL_1", field), expected, rtol=1e-6)
    np.testing.assert_array_equal(found("6D_TOOL_1", "sequence"), [each.values["sequence"] for each in poses])
    assert found("6D_TOOL_2", "position_m").shape == (0, 3)
    assert "MOCAP_LAB_6D_TOOL_2: ignored 1 malformed messages" in found.warnings


def test_damage_and_malformed_messages_are_skipped_with_a_warning(tmp_path: Path) -> None:
    channel, message = markers(3, 1)
    good = [markers(3, number) for number in range(4)]
    take = tmp_path / "take.lcmlog"
    malformed = log_bytes([(channel, b"x"), *good[:2], (channel, message[:-1]), (channel, message + b"x")])
    damaged = b"\xed\xa1\xda\x01" + bytes(50)
    take.write_bytes(b"garbage" + malformed + damaged + log_bytes(good[2:]) + log_bytes(good)[:-5])
    found = OctaveTake(take, tmp_path)
    np.testing.assert_array_equal(found("3D", "sequence"), [0, 1, 2, 3, 0, 1, 2])
    cut = len(log_bytes(good[3:])) - 5
    assert f"skipped {len(b'garbage') + 54 + cut} bytes that are damaged or incomplete" in found.warnings
    assert "MOCAP_LAB_3D: ignored 3 malformed messages" in found.warnings


@pytest.mark.parametrize("content", [b"", b"nothing of LCM", log_bytes([("MOCAP_LAB_3D", b"")])])
def test_a_file_without_messages_has_no_channels(content: bytes, tmp_path: Path) -> None:
    take = tmp_path / "take.lcmlog"
    take.write_bytes(content)
    assert OctaveTake(take, tmp_path).channels == set()


def test_without_a_result_it_prints_the_first_frames() -> None:
    text, warnings = octave_prints(f"read_take('{SAMPLE}')")
    lines = text.splitlines()
    first = "MOCAP_LAB_3D sequence 0 at 0.000000 s, frame 1 with parameters 1: 34 markers: 65.818,-2448.628,"
    assert lines[0].startswith(first)
    assert any(re.fullmatch(r"MOCAP_LAB_3D: 250 rows in 4\.9\d+ s", line) for line in lines)
    event = "frame 31 with parameters 1: 1 events: 0x101 at 600000 us: 1 0 -1"
    assert f"MOCAP_LAB_EVENT sequence 1 at 0.600000 s, {event}" in lines
    assert warnings == ""
