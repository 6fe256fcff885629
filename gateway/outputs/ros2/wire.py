"""The wire format of rmw_zenoh: keys of data, liveliness tokens, attachments, quality of service.

From the design document of rmw_zenoh (ros2/rmw_zenoh, docs/design.md) and its sources. The tokens make nodes
and publishers visible: ``ros2 topic list`` shows what they say. ROS drops a message without an attachment.
"""

import struct
from typing import Final, NamedTuple

import xxhash

from gateway.outputs.ros2.message_types import RosType

_ADMIN_SPACE: Final = "@ros2_lv"
_NODE: Final = "NN"
_PUBLISHER: Final = "MP"
_SUBSCRIPTION: Final = "MS"
_NO_ENCLAVE: Final = "%"
_DEFAULT_DEPTH: Final = 42

NODE_ID: Final = 0
"""The id of the gateway's node in its session. It has only one."""

_GID_BYTES: Final = 16
_ATTACHMENT: Final = struct.Struct(f"<qqB{_GID_BYTES}s")


class QoS(NamedTuple):
    """The quality of service of a publisher. All are volatile and keep the last ``depth`` messages."""

    is_reliable: bool
    depth: int

    @property
    def code(self) -> str:
        """The text in tokens. A field with the default of rmw_zenoh is empty: reliable, volatile, depth 42.

        A node encodes it anew to compute the gid, so writing a default would give another one.

        The fields are reliability, durability, history and depth, deadline, lifespan and liveliness.
        """
        best_effort = "2"
        depth = "" if self.depth == _DEFAULT_DEPTH else self.depth
        return f"{'' if self.is_reliable else best_effort}::,{depth}:,:,:,,"


class Node(NamedTuple):
    """A node: its domain, the id of its Zenoh session, its namespace ("" or such as "mocap") and its name."""

    domain_id: int
    session_id: str
    namespace: str
    name: str

    @property
    def token(self) -> str:
        """The key of its liveliness token."""
        return "/".join((self._prefix(NODE_ID, _NODE), self.name))

    def publisher_token(self, entity_id: int, topic: str, ros_type: RosType, type_hash: str, qos: QoS) -> str:
        """Return the key of the liveliness token of a publisher. ``topic`` begins with a slash."""
        prefix = self._prefix(entity_id, _PUBLISHER)
        return "/".join((prefix, self.name, _mangled(topic), ros_type.dds_name, type_hash, qos.code))

    def _prefix(self, entity_id: int, kind: str) -> str:
        ids = f"{self.domain_id}/{self.session_id}/{NODE_ID}/{entity_id}"
        return f"{_ADMIN_SPACE}/{ids}/{kind}/{_NO_ENCLAVE}/{_mangled(f'/{self.namespace}')}"


def full_name(namespace: str, name: str) -> str:
    """Return the name of a node as ``ros2 node list`` shows it: /mocap/rtc3d_gateway."""
    return f"/{namespace}/{name}" if namespace else f"/{name}"


def tokens_of(domain_id: int) -> str:
    """Return the key expression that matches all tokens of a domain."""
    return f"{_ADMIN_SPACE}/{domain_id}/**"


class SeenEntity(NamedTuple):
    """What a token shows: a node, which has no topic, or one of its publishers, subscriptions and services.

    ``node`` is the full name of the node.
    """

    node: str
    is_subscription: bool
    topic: str = ""
    dds_name: str = ""
    type_hash: str = ""


def seen_entity(token: str) -> SeenEntity | None:
    """Return what a token shows; None if it has another format."""
    parts = token.split("/")
    if len(parts) < 9:
        return None
    kind, _, namespace, node, *topic = parts[5:]
    name = full_name(namespace.replace("%", "/").strip("/"), node)
    if kind == _NODE:
        return SeenEntity(name, False)
    if len(topic) < 3:
        return None
    return SeenEntity(name, kind == _SUBSCRIPTION, topic[0].replace("%", "/"), topic[1], topic[2])


def data_key(domain_id: int, topic: str, ros_type: RosType, type_hash: str) -> str:
    """Return the key of a topic's messages. ``topic`` begins with a slash."""
    return f"{domain_id}{topic}/{ros_type.dds_name}/{type_hash}"


def gid_of(token: str) -> bytes:
    """Return the global id of the publisher with this token, as nodes compute it for their graph.

    That is the low half of XXH3-128, then the high half, both little-endian: its usual form backwards.
    """
    return xxhash.xxh3_128_digest(token.encode())[::-1]


def attachment(sequence: int, source_time_ns: int, gid: bytes) -> bytes:
    """Return the attachment of a message: ``sequence`` counts those of its publisher from 1.

    ``source_time_ns`` is when it was published, in ns since the Unix epoch.
    """
    return _ATTACHMENT.pack(sequence, source_time_ns, _GID_BYTES, gid)


def _mangled(name: str) -> str:
    return name.replace("/", "%")
