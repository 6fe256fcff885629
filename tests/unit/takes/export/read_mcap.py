"""Reading exported MCAP files by the package ``mcap``, independently of foxglove-sdk."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from mcap.reader import make_reader
from mcap.records import Attachment
from mcap_protobuf.decoder import DecoderFactory

from gateway.takes import open_take


class Logged(NamedTuple):
    """A message and its time in ns since 1970."""

    time_ns: int
    content: Any


class McapContent(NamedTuple):
    """What a file has. ``schemas`` has the names of the schemas, by topic."""

    topics: dict[str, list[Logged]]
    schemas: dict[str, str]
    attachments: list[Attachment]
    metadata: dict[str, dict[str, str]]


def read_mcap(path: Path) -> McapContent:
    """Return the content of a file; each topic must have one schema only, and pass all checksums."""
    topics: defaultdict[str, list[Logged]] = defaultdict(list)
    schemas: dict[str, str] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        names = [channel.topic for channel in summary.channels.values()]
        assert len(set(names)) == len(names)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            schemas[channel.topic] = schema.name
            if channel.message_encoding == "json":
                topics[channel.topic].append(Logged(message.log_time, json.loads(message.data)))
        for _, channel, message, content in reader.iter_decoded_messages(
            topics=[name for name in names if not name.endswith("/parameters")], log_time_order=False
        ):
            topics[channel.topic].append(Logged(message.log_time, content))
        assert sum(map(len, topics.values())) == summary.statistics.message_count
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        return McapContent(dict(topics), schemas, list(reader.iter_attachments()), metadata)


def points_of(cloud: Any) -> npt.NDArray[Any]:
    """Return the points of a PointCloud as its own fields describe them."""
    formats = {7: "<f4", 5: "<u4"}  # FLOAT32, UINT32
    fields = cloud.fields
    dtype: dict[str, Any] = {
        "names": [field.name for field in fields],
        "formats": [formats[field.type] for field in fields],
    }
    offsets = [field.offset for field in fields]
    return np.frombuffer(
        cloud.data, np.dtype(cast(Any, {**dtype, "offsets": offsets, "itemsize": cloud.point_stride}))
    )


def floats_of(record: Any) -> dict[str, float]:
    """Return the fields of a message that has numbers only."""
    return {field.name: getattr(record, field.name) for field in record.DESCRIPTOR.fields}


def assert_equals_take(content: McapContent, path: Path, arrow_interval: int = 1) -> None:
    """The file has every value and every time of capture of a take whose labels do not change.

    Of the frames of forces, one of ``arrow_interval`` has its arrows.
    """
    recorded = open_take(path).sources["lab"]
    topics = content.topics
    for key, topic in (("3d", "markers"), ("analog", "analog"), ("force", "loads"), ("force", "forces")):
        times = [log.time_ns // 1000 for log in topics.get(f"/lab/{topic}", [])]
        expected = recorded.series[key].capture_utime.tolist() if key in recorded.series else []
        assert times == (expected[::arrow_interval] if topic == "forces" else expected)
    assert recorded.markers is not None
    metres = {"mm": 1e-3, "m": 1.0}[recorded.markers.unit]
    for row, log in zip(recorded.markers.items, topics["/lab/markers"], strict=True):
        points = points_of(log.content)
        visible = row[points["marker"]]
        for axis in "xyz":
            assert np.allclose(points[axis], visible[axis] * metres, rtol=2e-7, atol=0)
            assert np.isnan(np.delete(row[axis], points["marker"])).all()
        assert np.array_equal(points["reliability"], visible["reliability"])
    if recorded.tools is not None:
        rows = recorded.tools.items[~np.isnan(recorded.tools.items["q0"]).all(axis=1)]
        for row, log in zip(rows, topics["/lab/tools"], strict=True):
            shown = [
                f"lab/{label}"
                for label, tool in zip(recorded.tools.labels, row, strict=True)
                if not np.isnan(tool["q0"])
            ]
            assert [transform.child_frame_id for transform in log.content.transforms] == shown
    for key, topic in (("analog", "analog"), ("force", "loads")):
        if key in recorded.series:
            values = recorded.series[key].values.reshape(len(recorded.series[key]), -1)
            logged = [list(floats_of(log.content).values()) for log in topics[f"/lab/{topic}"]]
            assert np.array_equal(np.array(logged, np.float32), values, equal_nan=True)


def rotated(quaternion: Any, vector: tuple[float, float, float]) -> npt.NDArray[Any]:
    """Return a vector after the rotation by a quaternion."""
    axis, v = np.array([quaternion.x, quaternion.y, quaternion.z]), np.array(vector)
    t = 2 * np.cross(axis, v)
    return np.asarray(v + quaternion.w * t + np.cross(axis, t))
