"""Labels in a real viser server."""

import numpy as np
import viser

from gateway.view.labels import Labels


def test_labels_from_the_network_are_one_line_of_limited_length() -> None:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        labels = Labels(server.scene, "/labels")
        positions = np.zeros((2, 3), np.float32)
        labels.update(positions, ["", ""], now_s=0.0)
        labels.update(positions, ["a\n\u202eb", "L" * 500], now_s=1.0)
        assert [node.text for node in labels._nodes] == [r"a\n\u202eb", "L" * 99 + "…"]
        more = np.zeros((3, 3), np.float32)
        labels.update(more, ["a", "b", "c\td"], now_s=2.0)
        assert [node.text for node in labels._nodes] == ["a", "b", r"c\td"]
    finally:
        server.stop()
