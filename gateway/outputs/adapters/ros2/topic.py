"""A topic of ROS 2 as rmw_zenoh has it: keys, liveliness tokens, attachments, and its publisher.

From the design document of rmw_zenoh (ros2/rmw_zenoh, docs/design.md) and its sources. The tokens make nodes
and publishers visible: ``ros2 topic list`` shows what they say. ROS drops a message without an attachment.
"""

import logging
import struct
from collections.abc import Callable
from typing import Final, NamedTuple

import xxhash
import zenoh

from gateway.messages.ros2.encode import RosType
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.session import declare_publisher, has_subscribers

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
    """The quality of service of a publisher, which keeps the last ``depth`` messages."""

    is_reliable: bool
    depth: int
    is_transient_local: bool = False

    @property
    def code(self) -> str:
        """The text in tokens. A field with the default of rmw_zenoh is empty: reliable, volatile, depth 42.

        A node encodes it anew to compute the gid, so writing a default would give another one.

        The fields are reliability, durability, history and depth, deadline, lifespan and liveliness.
        """
        best_effort, transient_local = "2", "1"
        reliability = "" if self.is_reliable else best_effort
        durability = transient_local if self.is_transient_local else ""
        depth = "" if self.depth == _DEFAULT_DEPTH else self.depth
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


LATCHED: Final = QoS(is_reliable=True, depth=1, is_transient_local=True)
"""The quality of service of topics whose newest message late subscribers need, too."""


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


NODE_NAME: Final = "rtc3d_gateway"

logger = logging.getLogger(__name__)


class RosNode:
    """The gateway's node on an open session: it declares publishers and their tokens."""

    def __init__(self, session: zenoh.Session, settings: Ros2Settings) -> None:
        self._session = session
        self._settings = settings
        self._node = Node(settings.domain_id, str(session.info.zid()), settings.namespace, NODE_NAME)
        self._is_reliable = settings.reliability == "reliable"
        self._last_entity_id = NODE_ID
        self._token = session.liveliness().declare_token(self._node.token)

    def declare(self, topic: "RosTopic", on_matching: Callable[[bool], None]) -> "Declared":
        """Declare the publisher of a topic. ``on_matching`` is called in one of Zenoh's threads."""
        settings = self._settings
        type_hash = topic.type.hash_in(settings.distribution)
        qos = LATCHED if topic.is_latched else QoS(self._is_reliable, settings.depth)
        publisher = declare_publisher(
            self._session,
            data_key(settings.domain_id, topic.name, topic.type, type_hash),
            on_matching,
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.RELIABLE if qos.is_reliable else zenoh.Reliability.BEST_EFFORT,
        )
        self._last_entity_id += 1
        token = self._node.publisher_token(self._last_entity_id, topic.name, topic.type, type_hash, qos)
        return Declared(publisher, self._session.liveliness().declare_token(token), gid_of(token))


class Declared(NamedTuple):
    """What is declared for one topic: its publisher, which the token makes visible, and its global id."""

    publisher: zenoh.Publisher
    token: zenoh.LivelinessToken
    gid: bytes

    def undeclare(self) -> None:
        """Hide the publisher from ROS, and close it."""
        self.token.undeclare()
        self.publisher.undeclare()


class RosTopic:
    """A topic that the gateway publishes. Only the sending thread calls its methods.

    ``on_wanted_changed`` is called in one of Zenoh's threads when subscribers come or when all have gone.
    """

    def __init__(
        self,
        name: str,
        ros_type: RosType,
        on_wanted_changed: Callable[[], None],
        *,
        is_latched: bool = False,
    ) -> None:
        self.name = name
        """With a leading slash."""
        self.type = ros_type
        self.is_latched = is_latched
        """Whether subscriptions to it are transient local, as usual: see LATCHED."""
        self.wanted = False
        """Whether there is a subscriber."""
        self._on_wanted_changed = on_wanted_changed
        self._declared: Declared | None = None
        self._node: RosNode | None = None  # on which it is, or was, declared
        self._sequence = 0  # of the last message; ROS counts from 1

    def declare(self, node: RosNode) -> None:
        """Declare the topic on an open session, unless that has been done."""
        if self._declared is None or self._node is not node:
            self._declared, self._node = node.declare(self, self._on_matching), node

    def _on_matching(self, is_matching: bool) -> None:
        if is_matching is not self.wanted:
            self.wanted = is_matching
            self._on_wanted_changed()

    def check_subscribers(self) -> None:
        """Check again for subscribers, because a notification may have been missed."""
        if self._declared is not None:
            self._on_matching(has_subscribers(self._declared.publisher))

    def put(self, cdr: bytes, now_ns: int) -> None:
        """Publish a message. Nobody gets it if the topic is not declared."""
        self._sequence = sequence = self._sequence + 1
        declared = self._declared
        if declared is not None:
            declared.publisher.put(cdr, attachment=attachment(sequence, now_ns, declared.gid))

    def skip(self, num_messages: int) -> None:
        """Use up the numbers of lost messages, so that ROS notices that they are missing."""
        self._sequence += num_messages

    def undeclare(self) -> None:
        """Remove the topic from ROS."""
        declared, self._declared = self._declared, None
        self.wanted = False
        if declared is not None:
            try:
                declared.undeclare()
            except zenoh.ZError as error:
                logger.debug("undeclaring %s: %s", self.name, zenoh_reason(error))
