"""Topics whose newest message late subscribers need: /tf_static, and the labels of each source.

Subscriptions to them are transient local: nodes that come later need what was published before. So the
message is published again and again: at once when subscribers come, and every second. With a cache in Zenoh,
a node that requests it and does not read the answer would hold up what others get.
"""

import logging
import time
from collections.abc import Callable, Sequence

import zenoh

from gateway.messages.host_time import now_utime
from gateway.messages.ros2.encode import TF_MESSAGE, RosType, ros_stamp, tf_message
from gateway.messages.ros2.names import TF_STATIC
from gateway.messages.ros2.plates import Transform
from gateway.outputs.adapters.ros2.topic import RosNode, RosTopic
from gateway.outputs.zenoh.config import zenoh_reason

logger = logging.getLogger(__name__)


class LatchedTopic:
    """A topic with one message, which may change. Only the sending thread calls its methods.

    ``on_subscriber`` is called in one of Zenoh's threads when subscribers come or when all have gone.
    """

    def __init__(self, name: str, ros_type: RosType, on_subscriber: Callable[[], None]) -> None:
        self._topic = RosTopic(name, ros_type, on_subscriber, is_latched=True)
        self._encode: Callable[[], bytes] | None = None
        self._node: RosNode | None = None

    def declare(self, node: RosNode) -> None:
        """Declare the topic on an open session, if there is a message."""
        self._node = node
        self._update()

    def undeclare(self) -> None:
        """Remove the topic from ROS."""
        self._topic.undeclare()

    def set_message(self, encode: Callable[[], bytes] | None) -> None:
        """Publish what ``encode`` returns, from now on. None removes the topic from ROS."""
        self._encode = encode
        self._update()

    def send(self) -> None:
        """Publish the message, if there is one and somebody subscribes."""
        if self._topic.wanted and self._encode is not None:
            try:
                self._topic.put(self._encode(), time.time_ns())
            except zenoh.ZError as error:  # it is published again in a second
                logger.debug("ros2: publishing %s: %s", self._topic.name, zenoh_reason(error))

    def check_subscribers(self) -> None:
        """Check again for subscribers, and publish to those that came while others were there."""
        self._topic.check_subscribers()
        self.send()

    def _update(self) -> None:
        if self._node is not None and self._encode is not None:
            self._topic.declare(self._node)
            self.send()
        else:
            self._topic.undeclare()


class StaticTransforms(LatchedTopic):
    """The topic /tf_static: the frames of force plates of all sources, which do not move."""

    def __init__(self, on_subscriber: Callable[[], None]) -> None:
        super().__init__(TF_STATIC, TF_MESSAGE, on_subscriber)
        self._transforms: dict[str, Sequence[Transform]] = {}  # by source

    def set_transforms(self, source: str, transforms: Sequence[Transform]) -> None:
        """Replace the transforms of a source; without any, the source is forgotten."""
        if transforms:
            self._transforms[source] = transforms
        else:
            self._transforms.pop(source, None)
        self.set_message(self._encode_all if self._transforms else None)

    def _encode_all(self) -> bytes:
        all_transforms = [each for transforms in self._transforms.values() for each in transforms]
        return tf_message(ros_stamp(now_utime()), all_transforms)
