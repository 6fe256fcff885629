"""The example programs that ask the gateway again for what is lost on the way: no frame is missing."""

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import lcm
import pytest
import zenoh

from gateway.messages.history import sequence_of
from tests.support.example_programs import (
    LCM_URL,
    PROGRAMS,
    ExampleProgram,
    output_until_the_end,
    run_gateway,
    run_program,
)
from tests.support.networks import free_endpoint, open_zenoh

pytestmark = pytest.mark.netns

GATEWAY_URL = "udpm://239.255.76.68:7732?ttl=0"
QUERIES_URL = LCM_URL.replace("7712", "7713")
_NAMES = {"Python, LCM", "C, LCM", "Rust, LCM", "JavaScript, LCM", "Python, Zenoh"}


def is_lost(message: bytes) -> bool:
    """Return whether a message gets lost on the way: three of ten."""
    return sequence_of(message) % 10 in {3, 4, 7}


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Return where a gateway listens on Zenoh; on LCM, programs get its messages only through a relay."""
    folder = tmp_path_factory.mktemp("gateway")
    simulated = ("--markers", "5", "--tools", "0", "--analog", "0", "--plates", "0", "--rate", "100")
    urls = {"url": GATEWAY_URL, "queries_url": QUERIES_URL}
    with run_gateway(folder, *simulated, ready="connected to", lcm=urls) as endpoint:
        yield endpoint


@contextmanager
def lossy_lcm() -> Iterator[None]:
    """Pass on the markers on LCM, with losses."""
    source, target, stop = lcm.LCM(GATEWAY_URL), lcm.LCM(LCM_URL), threading.Event()

    def pass_on(channel: str, message: bytes) -> None:
        if not is_lost(message):
            target.publish(channel, message)

    source.subscribe("MOCAP_LAB_3D", pass_on).set_queue_capacity(1000)

    def run() -> None:
        while not stop.is_set():
            source.handle_timeout(100)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextmanager
def lossy_zenoh(endpoint: str) -> Iterator[str]:
    """Yield an endpoint with the markers and the queries of the gateway at ``endpoint``, with losses."""
    listen = free_endpoint()
    with (
        open_zenoh("client", connect=endpoint) as gateway,
        open_zenoh("peer", listen=listen) as programs,
    ):

        def pass_on(sample: zenoh.Sample) -> None:
            if not is_lost(sample.payload.to_bytes()):
                programs.put(sample.key_expr, sample.payload)

        def answer(query: zenoh.Query) -> None:
            for reply in gateway.get(query.selector):
                if reply.ok:
                    query.reply(reply.ok.key_expr, reply.ok.payload, attachment=reply.ok.attachment)
                elif reply.err:
                    query.reply_err(reply.err.payload)

        gateway.declare_subscriber("mocap/lab/3d", pass_on)
        programs.declare_queryable("mocap/lab/3d", answer)
        yield listen


@pytest.mark.parametrize("program", [each for each in PROGRAMS if each.name in _NAMES], ids=str)
def test_the_program_prints_every_frame_although_three_of_ten_are_lost(
    endpoint: str, program: ExampleProgram
) -> None:
    """Whoever copies an example gets complete data."""
    program.build()
    with (
        lossy_lcm(),
        lossy_zenoh(endpoint) as lossy_endpoint,
        run_program(*program.run_command(lossy_endpoint), ready="listening") as process,
    ):
        text = output_until_the_end(process)
    assert process.returncode == 0, text
    numbers = [int(number) for number in re.findall(r"^#(\d+) frame", text, re.MULTILINE)]
    assert numbers == list(range(numbers[0], numbers[0] + 20)), text
