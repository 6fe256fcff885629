"""Receives a gateway's topics with zenoh-ros2-sdk, an independent implementation of rmw_zenoh.

    python -m tests.support.ros2_listener PORT DOMAIN_ID TOPIC:TYPE...

It prints one line of JSON: the next message of each topic, what the attachments say, and the graph. The
package keeps one session in each process, and does not close it: so it has a process of its own.
"""

import json
import os
import sys
import time
from typing import Any, Final

import numpy as np
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Subscriber, discovery
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.session import ZenohSession

PATIENCE_S: Final = 20.0


def plain(value: Any) -> Any:
    """Return a message as values that JSON can hold."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list):
        return [plain(item) for item in value]
    if hasattr(value, "__msgtype__"):
        fields = [name for name in value.__dataclass_fields__ if name != "__msgtype__"]
        return {name: plain(getattr(value, name)) for name in fields}
    return value


def wait_for(condition: Any) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < deadline_s:
        time.sleep(0.01)


def main() -> None:
    port, domain_id = int(sys.argv[1]), int(sys.argv[2])
    topics = dict(argument.split(":") for argument in sys.argv[3:])
    session = ZenohSession.get_instance("127.0.0.1", port)
    # The definitions come from rosbags: otherwise, the package would clone them from the network.
    types = get_typestore(Stores.ROS2_JAZZY)
    session.store.register(types.fielddefs)
    attachments: dict[str, list[Attachment]] = {topic: [] for topic in topics}

    def on_sample(sample: Any) -> None:
        for topic, received in attachments.items():
            if str(sample.key_expr).startswith(f"{domain_id}{topic}/"):
                received.append(Attachment.from_bytes(sample.attachment.to_bytes()))

    everything = session.session.declare_subscriber(f"{domain_id}/**", on_sample)
    messages: dict[str, Any] = {}
    subscribers = []
    for topic, type_name in topics.items():
        session._registered_types[type_name] = type_name
        subscribers.append(
            ROS2Subscriber(
                topic,
                type_name,
                lambda message, topic=topic: messages.__setitem__(topic, message),
                msg_definition="given",
                domain_id=domain_id,
                router_port=port,
                type_hash=types.hash_rihs01(type_name),
            )
        )
    wait_for(lambda: len(messages) == len(topics) and all(len(each) > 1 for each in attachments.values()))
    published = discovery.get_topic_names_and_types(domain_id=domain_id, router_port=port, timeout=2)
    info = {
        topic: discovery.get_topic_info(topic, domain_id=domain_id, router_port=port, timeout=2, verbose=True)
        for topic in topics
    }
    everything.undeclare()
    result = {
        "messages": {topic: plain(message) for topic, message in messages.items()},
        "attachments": {
            topic: [(each.sequence_id, each.timestamp_ns, each.gid.hex()) for each in received]
            for topic, received in attachments.items()
        },
        "topics": dict(published),
        "publishers": {
            topic: [vars(each) for each in found.publishers] for topic, found in info.items() if found
        },
    }
    print(json.dumps(result), flush=True)
    os._exit(0)  # the package's session has threads that do not end


if __name__ == "__main__":
    main()
