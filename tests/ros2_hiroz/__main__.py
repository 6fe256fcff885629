"""Receives from a gateway with the Rust crate hiroz, which has a decoder, type hashes and a graph of its own.

    make hiroz

The first build needs cargo, the network and six minutes of one core, so this is not part of the tests.
tests/integration/test_ros2.py makes the same checks with zenoh-ros2-sdk.
"""

import asyncio
import json
from asyncio.subprocess import PIPE
from pathlib import Path
from typing import Any, Final

from tests.integration.test_ros2 import TYPES, gateway_of, settings_of, simulated
from tests.support.networks import free_endpoint, open_zenoh

HERE: Final = Path(__file__).parent


async def listen(program: Path) -> list[dict[str, Any]]:
    """Return the lines that the program prints about a gateway with a simulated server."""
    router = free_endpoint()
    with open_zenoh("router", listen=router):
        async with simulated() as server, gateway_of(settings_of(router, {"hall-2": server})):
            listener = await asyncio.create_subprocess_exec(program, router, "0", *TYPES, stdout=PIPE)
            output, _ = await listener.communicate()
    assert listener.returncode == 0
    return [json.loads(line) for line in output.splitlines()]


def main() -> None:
    *heard, graph = asyncio.run(listen(HERE / "target/debug/ros2-hiroz"))
    messages = {line["topic"]: line["message"] for line in heard}
    assert set(messages) == set(TYPES)
    assert messages["/mocap/hall_2/Tool_1/pose"]["header"]["frame_id"] == "hall-2"
    assert messages["/tf"]["transforms"][0]["child_frame_id"] == "hall-2/Tool_1"
    assert messages["/mocap/hall_2/markers"]["width"] == 3
    assert ["rtc3d_gateway", "/mocap"] in graph["nodes"]
    topics = dict(graph["topics"])
    for topic, type_name in TYPES.items():
        package, _, name = type_name.split("/")
        assert topics[topic] == f"{package}::msg::dds_::{name}_"
        print(f"{topic}: {json.dumps(messages[topic])[:200]}")
    print(f"hiroz received all {len(TYPES)} types and sees {len(topics)} topics")


if __name__ == "__main__":
    main()
