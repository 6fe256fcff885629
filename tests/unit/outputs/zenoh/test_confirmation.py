"""What a router has confirmed, and what is lost with a connection."""

import json
import logging
import os
import signal
import subprocess
import sys
from typing import Any
from unittest.mock import Mock

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from gateway.messages.topics import Topic
from gateway.outputs.zenoh.confirmation import LINK_LOST, SILENT_S, RouterConfirmation
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.runtime.losses import Losses
from tests.support.networks import free_endpoint, open_zenoh, zenoh_keys
from tests.support.statuses import amounts
from tests.support.waiting import wait_until


class Lab:
    """A confirmation with a session whose questions the test answers, and a clock that it sets."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.holder: Any = Mock(is_client=True, is_cut_off=False)
        self.confirmation = RouterConfirmation(self.holder, lambda: self.now_s)

    @property
    def questions(self) -> list[Any]:
        """The handlers of all questions."""
        return [call.args[1] for call in self.holder.session.get.call_args_list]

    def answer(self, index: int = -1) -> None:
        """Let the router end a question without replies."""
        self.questions[index].drop()

    def time_out(self, index: int = -1) -> None:
        """Let Zenoh give a question up."""
        self.questions[index].callback(Mock(ok=None))
        self.questions[index].drop()

    @property
    def lost(self) -> dict[str, int]:
        """What is counted as lost now, and was not before."""
        losses = {name: Losses(logging.getLogger("tests"), name) for name in ("lab", "hall")}
        self.confirmation.count_unconfirmed(losses, "the router")
        return {name: loss.messages for name, each in losses.items() for loss in each.report()}


def test_what_the_router_has_not_confirmed_may_be_lost_with_the_connection() -> None:
    """Zenoh goes on accepting messages for a router that was stopped: 9296 were lost and 1 was counted."""
    lab = Lab()
    sent, others = lab.confirmation.of("lab"), lab.confirmation.of("hall")
    sent.count += 10
    lab.confirmation.check()
    sent.count += 5
    lab.answer()
    lab.confirmation.check()  # takes the answer, and asks again
    others.count += 2
    lab.confirmation.lose_link()
    assert lab.lost == {"lab": 5, "hall": 2}
    assert lab.lost == {}
    sent.count += 1
    lab.confirmation.lose_link()
    assert lab.lost == {"lab": 1}


def test_the_end_of_a_question_with_its_connection_confirms_nothing() -> None:
    """Zenoh ends open questions just before it reports that their connection is lost."""
    lab = Lab()
    lab.confirmation.of("lab").count += 10
    lab.confirmation.check()
    lab.answer()
    lab.confirmation.lose_link()
    lab.confirmation.check()
    assert lab.lost == {"lab": 10}


def test_a_router_that_leaves_questions_open_is_silent_also_after_they_have_timed_out() -> None:
    lab = Lab()
    assert lab.confirmation.silent_s == 0
    lab.confirmation.check()
    lab.now_s += 2 * SILENT_S
    lab.confirmation.check()
    assert (len(lab.questions), lab.confirmation.silent_s) == (1, 2 * SILENT_S)
    lab.time_out()
    lab.confirmation.check()
    lab.now_s += 1
    assert (len(lab.questions), lab.confirmation.silent_s) == (2, 2 * SILENT_S + 1)
    lab.answer()
    assert lab.confirmation.silent_s == 0


def test_only_a_client_with_a_router_asks() -> None:
    """A peer sends to each subscriber itself, so the answer of a router would prove nothing."""
    lab = Lab()
    lab.holder.is_client = False
    lab.confirmation.check()
    lab.holder.is_client, lab.holder.is_cut_off = True, True
    lab.confirmation.check()
    session, lab.holder.session = lab.holder.session, None
    lab.confirmation.check()
    session.get.assert_not_called()


class Connections(RuleBasedStateMachine):
    """Any order of messages, questions, answers and lost connections.

    The model is the queue of the connection, in which messages and questions are one behind the other.
    """

    def __init__(self) -> None:
        super().__init__()
        self.lab = Lab()
        self.sent = self.lab.confirmation.of("lab")
        self.queue: list[int | None] = []  # the numbers of questions; None for messages
        self.num_lost = 0
        self.num_reported = 0

    @rule(count=st.integers(1, 3))
    def send(self, count: int) -> None:
        self.sent.count += count
        self.queue += [None] * count

    @rule()
    def check(self) -> None:
        before = len(self.lab.questions)
        self.lab.confirmation.check()
        self.queue += range(before, len(self.lab.questions))

    @precondition(lambda self: self.queue)
    @rule(count=st.integers(1, 6))
    def read(self, count: int) -> None:
        read, self.queue = self.queue[:count], self.queue[count:]
        for number in read:
            if number is not None:
                self.lab.answer(number)

    @rule()
    def lose_link(self) -> None:
        for number in self.queue:
            if number is not None:
                self.lab.answer(number)  # as Zenoh does
        self.num_lost += self.queue.count(None)
        self.queue.clear()
        self.lab.confirmation.lose_link()

    @invariant()
    def no_loss_is_missed(self) -> None:
        self.num_reported += self.lab.lost.get("lab", 0)
        assert self.num_lost <= self.num_reported <= self.sent.count


TestConnections = Connections.TestCase


_ROUTER = """
import json, sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
print("open", flush=True)
sys.stdin.read()
"""


def test_a_real_router_confirms_what_it_reads_and_not_what_it_does_not() -> None:
    """Of 30 messages, the router has read 10 when it is stopped, and later killed."""
    endpoint = free_endpoint()
    keys = json.dumps(zenoh_keys("router", listen=endpoint))
    with subprocess.Popen(
        [sys.executable, "-c", _ROUTER, keys], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as router:
        assert router.stdout is not None
        assert router.stdout.readline() == b"open\n"
        output = ZenohOutput(ZenohSettings(config=zenoh_keys("client", connect=endpoint)))
        subscriber = open_zenoh("client", connect=endpoint)
        try:
            losses = Losses(logging.getLogger("tests"), "lab to zenoh")
            output.count_losses("lab", losses)
            publisher = output.publisher(Topic("lab", ("3d",), "rtc3d.markers_t"))
            samples: list[object] = []
            subscriber.declare_subscriber("mocap/lab/3d", samples.append)
            output.start()
            wait_until(lambda: publisher.wanted and output.health().connected)
            sent = output._confirmation.of("lab")

            def is_confirmed() -> bool:
                output.maintain()
                return sent.confirmed == sent.count

            for _ in range(10):
                publisher.publish(b"read")
            wait_until(is_confirmed)
            wait_until(lambda: len(samples) == 10)  # the router has read them before it hands them on
            router.send_signal(signal.SIGSTOP)
            os.waitpid(router.pid, os.WUNTRACED)  # until all its threads have stopped
            for _ in range(20):
                publisher.publish(b"not read")
            output.maintain()
            router.kill()
            wait_until(lambda: not output.health().connected)
            output.maintain()
            assert amounts(losses.report()) == {LINK_LOST: (20, 0)}
            assert len(samples) == 10
        finally:
            router.kill()
            output.close()
            subscriber.close()
