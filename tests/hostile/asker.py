"""A peer on Zenoh that asks without end, in a process of its own.

    python -m tests.hostile.asker ENDPOINT COUNT PAYLOAD_BYTES SELECTOR...

It sends COUNT queries at once, with the selectors in turn, and prints a line when they are sent. "{}" in a
selector stands for the number of the query. When every query has ended, it prints a JSON object: the number
of replies by code ("ok", or the code of the error), and of queries without any.
"""

import json
import sys
import threading
from collections import Counter
from functools import partial

import zenoh

from tests.networks import open_zenoh

_TIMEOUT_S = 20.0


def main() -> None:
    endpoint, count, num_bytes = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    selectors, payload = sys.argv[4:], bytes(num_bytes)
    counts: Counter[str] = Counter()
    unanswered = set(range(count))
    ended = threading.Semaphore(0)

    def receive(number: int, reply: zenoh.Reply) -> None:
        unanswered.discard(number)
        counts["ok" if reply.err is None else str(reply.err.encoding).rpartition(";")[2]] += 1

    with open_zenoh("client", connect=endpoint) as session:
        for number in range(count):
            session.get(
                selectors[number % len(selectors)].replace("{}", str(number)),
                zenoh.handlers.Callback(partial(receive, number), drop=ended.release),
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=_TIMEOUT_S,
                payload=payload or None,
            )
        print("sent", flush=True)
        for _ in range(count):
            ended.acquire(timeout=_TIMEOUT_S)
        print(json.dumps(counts | {"unanswered": len(unanswered)}), flush=True)


main()
