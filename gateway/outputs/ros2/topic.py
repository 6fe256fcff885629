"""One topic of ROS 2: a Zenoh publisher, and the liveliness token that shows it to ROS."""

import logging
from collections.abc import Callable
from typing import Any, Final

import zenoh

from gateway.outputs.ros2.message_types import RosType
from gateway.outputs.ros2.settings import Ros2Settings
from gateway.outputs.ros2.wire import NODE_ID, Node, QoS, attachment, data_key, gid_of
from gateway.outputs.zenoh.config import in_zenoh_thread, zenoh_reason

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
        publisher = self._session.declare_publisher(
            data_key(settings.domain_id, topic.name, topic.type, type_hash),
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.RELIABLE if self._is_reliable else zenoh.Reliability.BEST_EFFORT,
        )

        def on_status(status: zenoh.MatchingStatus) -> None:
            on_matching(status.matching)

        publisher.declare_matching_listener(in_zenoh_thread(on_status))
        self._last_entity_id += 1
        qos = QoS(self._is_reliable, settings.depth)
        token = self._node.publisher_token(self._last_entity_id, topic.name, topic.type, type_hash, qos)
        return Declared(publisher, self._session.liveliness().declare_token(token), gid_of(token))


class Declared:
    """What is declared for one topic."""

    def __init__(self, publisher: zenoh.Publisher, token: zenoh.LivelinessToken, gid: bytes) -> None:
        self.publisher = publisher
        self.gid = gid
        self._token = token

    def undeclare(self) -> None:
        """Hide the publisher from ROS, and close it."""
        self._token.undeclare()
        self.publisher.undeclare()


class RosTopic:
    """A topic that the gateway publishes. Only the sending thread calls its methods.

    ``on_wanted_changed`` is called in one of Zenoh's threads when subscribers come or when all have gone.
    """

    def __init__(self, name: str, ros_type: RosType, on_wanted_changed: Callable[[], None]) -> None:
        self.name = name
        """With a leading slash."""
        self.type = ros_type
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
            # Zenoh's type stub says that matching_status is a bool, but it is a MatchingStatus.
            status: Any = self._declared.publisher.matching_status
            self._on_matching(status.matching)

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
