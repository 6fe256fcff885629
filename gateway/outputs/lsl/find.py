"""Finds LSL streams, in a process of its own because liblsl never gives back its ports and threads.

    python -m gateway.outputs.lsl.find SECONDS     prints a list as JSON

The doctor runs it (checks.py). Each stream has name, type, source_id, computer, rate_hz and num_channels.
"""

import json
import os
import sys


def main() -> None:
    """Print the streams that liblsl finds."""
    import pylsl  # noqa: PLC0415 - only here

    found = [
        {
            "name": info.name(),
            "type": info.type(),
            "source_id": info.source_id(),
            "computer": info.hostname(),
            "rate_hz": info.nominal_srate(),
            "num_channels": info.channel_count(),
        }
        for info in pylsl.resolve_streams(float(sys.argv[1]))
    ]
    print(json.dumps(found), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
