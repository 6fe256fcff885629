"""An output for ROS 2 that is connected to a router."""

from collections.abc import Iterator

import pytest

from tests.ros_lab import RosLab, ros_lab


@pytest.fixture
def lab() -> Iterator[RosLab]:
    with ros_lab() as lab:
        yield lab.open()
