"""Viewers of ``rtc3d-gateway view`` that are slow or go away, without a browser."""

from contextlib import ExitStack
from typing import Final

import pytest

from tests.view.published_scene import published_scene
from tests.view.view_process import Viewer, view_process, viewer_that_does_not_read

pytestmark = pytest.mark.netns

NUM_MARKERS: Final = 8000
UPDATE_MB: Final = NUM_MARKERS * 12 / 1e6


def test_a_viewer_that_is_slow_or_goes_away_costs_nothing() -> None:
    with ExitStack() as stack:
        scene = stack.enter_context(published_scene([(number, 0.0, 0.0) for number in range(NUM_MARKERS)]))
        scene.step_mm = 10.0
        view = stack.enter_context(view_process("--connect", scene.endpoint))
        viewers = [Viewer(view) for _ in range(3)]
        for viewer in viewers:
            stack.callback(viewer.leave)
            viewer.wait_for_updates(30)
        before_mb = view.memory_mb
        with ExitStack() as slow_ones:
            for _ in range(3):
                slow_ones.enter_context(viewer_that_does_not_read(view))
            for viewer in viewers:
                viewer.wait_for_updates(100)
            queued_mb = 3 * 100 * UPDATE_MB
            assert view.memory_mb - before_mb < queued_mb / 3
        viewers[0].leave()
        for viewer in viewers[1:]:
            viewer.wait_for_updates(30)
        assert view.memory_mb - before_mb < queued_mb / 3
        assert view.end() == 0
        assert "\n" not in view.output.strip()  # nothing but the address
