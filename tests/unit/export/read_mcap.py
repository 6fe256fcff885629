"""Reading exported MCAP files by the package ``mcap``, independently of foxglove-sdk."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.reader import make_reader
from mcap.records import Attachment
from mcap_protobuf.decoder import DecoderFactory

from gateway.takes import Series, open_take


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
    dtype = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [formats[field.type] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_stride,
        }
    )
    return np.frombuffer(cloud.data, dtype)


def floats_of(record: Any) -> dict[str, float]:
    """Return the fields of a message that has numbers only."""
    return {field.name: getattr(record, field.name) for field in record.DESCRIPTOR.fields}


def assert_equals_take(content: McapContent, path: Path, source: str = "lab") -> None:
    """The file has every value and every time of capture of a take whose labels do not change."""
    recorded = open_take(path).sources[source]
    topics = content.topics
    for key, topic in (("3d", "markers"), ("analog", "analog"), ("force", "loads"), ("force", "forces")):
        times = [log.time_ns // 1000 for log in topics.get(f"/{source}/{topic}", [])]
        assert times == (recorded.series[key].capture_utime.tolist() if key in recorded.series else [])
    if recorded.markers is not None:
        assert_equal_markers(topics[f"/{source}/markers"], recorded.markers)
    if recorded.tools is not None:
        assert_equal_tools(topics.get(f"/{source}/tools", []), recorded.tools, source)
    for key, topic in (("analog", "analog"), ("force", "loads")):
        if key in recorded.series:
            values = recorded.series[key].values.reshape(len(recorded.series[key]), -1)
            logged = [list(floats_of(log.content).values()) for log in topics[f"/{source}/{topic}"]]
            assert np.array_equal(np.array(logged, np.float32), values, equal_nan=True)
    num_events = 0 if recorded.events is None else len(recorded.events)
    assert len(topics.get(f"/{source}/events", [])) == num_events


def assert_equal_markers(logged: list[Logged], recorded: Series) -> None:
    metres = {"mm": 1e-3, "m": 1.0}[recorded.unit]
    for row, log in zip(recorded.items, logged, strict=True):
        points = points_of(log.content)
        visible = row[points["marker"]]
        for axis in "xyz":
            assert np.allclose(points[axis], visible[axis] * metres, rtol=2e-7, atol=0)
            assert np.isnan(np.delete(row[axis], points["marker"])).all()
        assert np.array_equal(points["reliability"], visible["reliability"])


def assert_equal_tools(logged: list[Logged], recorded: Series, source: str) -> None:
    visible_frames = ~np.isnan(recorded.items["q0"]).all(axis=1)
    rows = recorded.items[visible_frames]
    for row, log in zip(rows, logged, strict=True):
        found = {transform.child_frame_id: transform for transform in log.content.transforms}
        for label, tool in zip(recorded.labels, row, strict=True):
            transform = found.pop(f"{source}/{label}", None)
            assert (transform is None) == np.isnan(tool["q0"])
            if transform is not None:
                p, q = transform.translation, transform.rotation
                assert np.allclose((p.x, p.y, p.z), [tool[axis] * 1e-3 for axis in "xyz"], rtol=2e-7)
                assert (q.w, q.x, q.y, q.z) == tuple(tool[name] for name in ("q0", "qx", "qy", "qz"))
        assert not found


def rotated(quaternion: Any, vector: tuple[float, float, float]) -> npt.NDArray[Any]:
    """Return a vector after the rotation by a quaternion."""
    axis, v = np.array([quaternion.x, quaternion.y, quaternion.z]), np.array(vector)
    t = 2 * np.cross(axis, v)
    return np.asarray(v + quaternion.w * t + np.cross(axis, t))
