"""A receiver of LSL streams in a process of its own, with pylsl's inlet: what an EEG lab has.

    python -m tests.support.lsl_receiver NAME...      prints lines of JSON until it is killed

One line for each stream that opens: name, xml, and the offset of its clock. Then one for each chunk: name,
times in s on LSL's clock, and values, which are lists of numbers or of one text.
"""

import json
import os
import secrets
import subprocess
import sys
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, Final

_PAGE: Final = Path(__file__).parents[2] / "docs/how-to/lsl.md"

_POLL_S: Final = 0.01


def lsl_config(folder: Path) -> Path:
    """Write the configuration of liblsl that the page recommends for one computer, for one test only."""
    recommended = _PAGE.read_text().partition("```ini\n")[2].partition("```")[0]
    file = folder / "lsl_api.cfg"
    file.write_text(recommended.replace("this-computer", secrets.token_hex(8)) + "[ports]\nIPv6 = disable\n")
    return file


class LslReceiver:
    """Receives all streams with these names. ``xml``, ``offset_s`` and ``samples`` are by name."""

    def __init__(self, config: Path, *names: str) -> None:
        self.xml: dict[str, str] = {}
        self.offset_s: dict[str, float] = {}
        self.samples: defaultdict[str, list[tuple[float, list[Any]]]] = defaultdict(list)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.lsl_receiver", *names],
            env={**os.environ, "LSLAPICFG": str(config)},
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # liblsl's log
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                if not line.endswith(b"\n"):
                    break  # the process was killed while it wrote
                report = json.loads(line)
                name = report["name"]
                if "xml" in report:
                    self.offset_s[name] = report["offset_s"]
                    self.xml[name] = report["xml"]
                else:
                    self.samples[name] += zip(report["times"], report["values"], strict=True)

    def forget(self) -> None:
        """Forget the samples received so far."""
        self.samples = defaultdict(list)

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()


def _print(report: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(report) + "\n")
    sys.stdout.flush()


def main() -> None:
    """Receive until the process is killed. A stream that comes back is recovered by liblsl."""
    import pylsl  # noqa: PLC0415 - it finds its configuration in the environment

    resolver = pylsl.ContinuousResolver()
    inlets: dict[str, Any] = {}  # by the ids of the streams' sources
    while True:
        for info in resolver.results():
            if info.name() not in sys.argv[1:] or info.source_id() in inlets:
                continue
            inlet = pylsl.StreamInlet(info, recover=True)
            try:
                xml = inlet.info(timeout=2).as_xml()
                inlet.open_stream(timeout=2)
                offset_s = inlet.time_correction(timeout=2)
            except (pylsl.util.TimeoutError, pylsl.util.LostError):
                continue  # it was replaced at this moment
            inlets[info.source_id()] = inlet
            _print({"name": info.name(), "xml": xml, "offset_s": offset_s})
        for inlet in inlets.values():
            values, times = inlet.pull_chunk(timeout=0.0, max_samples=4096)
            if times:
                name = inlet.info().name()
                _print({"name": name, "times": list(times), "values": [list(each) for each in values]})
        time.sleep(_POLL_S)


if __name__ == "__main__":
    main()
