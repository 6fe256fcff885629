"""The session of an output: opening, everything declared on it, its router, and closing, without Zenoh."""

import logging
import threading
import time
from collections.abc import Callable
from unittest.mock import Mock

import pytest
import zenoh

from gateway.outputs.zenoh import session as session_module
from gateway.outputs.zenoh.config import zenoh_config
from gateway.outputs.zenoh.session import SessionHolder, SessionTexts
from tests.support.errors import names
from tests.support.networks import zenoh_keys

TEXTS = SessionTexts("zenoh", "not open yet", "cannot open", "correct it", "no router there", "it is open")


def event(*, is_open: bool) -> Mock:
    """Return what SessionHolder uses of a zenoh.TransportEvent."""
    return Mock(kind=zenoh.SampleKind.PUT if is_open else zenoh.SampleKind.DELETE)


class Lab:
    """A SessionHolder whose zenoh.open fails as often as there are ``errors``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, num_errors: int = 0, mode: str = "client") -> None:
        self.session = Mock()
        self.listen = self.session.info.declare_transport_events_listener
        self.errors: list[Exception] = [zenoh.ZError("refused") for _ in range(num_errors)]
        self.declared: list[object] = []
        self.defects: list[Exception] = []  # of declaring
        self.closed: list[object] = []
        self.waits_s: list[object] = []
        self.before_open: Callable[[], None] = lambda: None
        monkeypatch.setattr(zenoh, "open", self._open)
        monkeypatch.setattr(session_module, "close_session", lambda session, _: self.closed.append(session))
        monkeypatch.setattr(session_module, "_closers", set())
        config = zenoh_config(zenoh_keys(mode, connect="tcp/192.0.2.9:7447"))
        self.holder = SessionHolder(TEXTS, config, self._declare)
        monkeypatch.setattr(self.holder._opener._stopped, "wait", self.waits_s.append)

    def _open(self, _config: zenoh.Config) -> Mock:
        self.before_open()
        if self.errors:
            raise self.errors.pop()
        return self.session

    def _declare(self, session: object) -> None:
        if self.defects:
            raise self.defects.pop()
        self.declared.append(session)
        self.while_declaring = (self.holder.is_cut_off, self.holder.refusal.cause)

    def open(self) -> None:
        """Do what the opening thread does."""
        self.holder._opener._run()

    def transport(self, *, is_open: bool) -> None:
        """Tell the gateway that the router has come or gone."""
        self.listen.call_args.args[0].callback(event(is_open=is_open))


def test_the_session_is_opened_as_soon_as_there_is_a_router(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A second after each failure; until then, the health says why it is not open."""
    caplog.set_level(logging.INFO)
    lab = Lab(monkeypatch, num_errors=3)
    problems: list[str] = []
    lab.before_open = lambda: problems.append(lab.holder.health.problem)
    lab.open()
    assert lab.waits_s == [1.0] * 3
    assert problems == ["not open yet", *["cannot open: refused; correct it"] * 3]
    assert lab.declared == [lab.session]
    assert (lab.listen.call_args.args[0].indirect, lab.listen.call_args.kwargs) == (False, {"history": True})
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]
    assert caplog.messages[0] == f"zenoh: {problems[1]}"
    assert names(caplog.messages[1], "zenoh", "it is open")


def test_without_a_transport_nothing_can_be_sent(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Zenoh keeps a session without its router; several links of one router are one connection."""
    lab = Lab(monkeypatch)
    holder = lab.holder
    assert (holder.is_cut_off, holder.refusal.cause) == (True, "not open")
    lab.open()
    assert (holder.is_cut_off, holder.refusal.cause, str(holder.refusal)) == (
        True,
        "no router",
        "no router there",
    )
    assert holder.health.problem == "no router there"
    for is_open, is_cut_off in ((True, False), (True, False), (False, False), (False, True), (True, False)):
        lab.transport(is_open=is_open)
        assert (holder.is_cut_off, holder.health.connected) == (is_cut_off, not is_cut_off)
    caplog.set_level(logging.INFO)
    caplog.clear()
    for is_open in (True, False, False, True):
        lab.transport(is_open=is_open)
        holder.maintain()
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]


def test_a_router_that_connects_while_the_session_opens_is_not_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its event comes before the session is known."""
    lab = Lab(monkeypatch)
    lab.listen.side_effect = lambda events, *, history: events.callback(event(is_open=history))
    lab.open()
    assert not lab.holder.is_cut_off


def test_closing_ends_the_session_and_the_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """A session that opens too late is closed again, and nothing is declared on it."""
    lab = Lab(monkeypatch)
    lab.open()
    lab.transport(is_open=True)
    lab.holder.close()
    lab.holder.close()
    assert (lab.closed, lab.holder.is_cut_off) == ([lab.session], True)
    assert "closed" in lab.holder.health.problem
    lab.holder.maintain()

    late = Lab(monkeypatch, num_errors=2)

    def close_at_last() -> None:
        if not late.errors:
            late.holder.close()

    late.before_open = close_at_last
    late.open()
    assert (late.declared, late.session.close.call_count, late.closed) == ([], 1, [])
    late.open()
    assert len(late.waits_s) == 2


def test_only_some_sessions_may_be_closing_when_another_one_opens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Peers that do not read delay closing; reloads must not fill the memory meanwhile."""
    close_session = session_module.close_session
    lab, can_close = Lab(monkeypatch, mode="peer"), threading.Event()
    monkeypatch.setattr(session_module, "_CLOSE_S", 0.0)
    for _ in range(4):
        close_session(Mock(close=can_close.wait), "zenoh")
    closers = list(session_module._closers)
    problems: list[str] = []

    def wait(_: float) -> None:
        problems.append(lab.holder.health.problem)
        can_close.set()
        closers[0].join()

    monkeypatch.setattr(lab.holder._opener._stopped, "wait", wait)
    lab.open()
    [problem] = problems
    assert names(problem, 4)
    assert lab.holder.health.connected
    for closer in closers:
        closer.join()


def test_what_cannot_be_declared_is_declared_on_the_next_session(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Without a retry, nothing would ever be published, and the health would say "not open yet"."""
    lab = Lab(monkeypatch)
    lab.defects = [RuntimeError("can't start new thread"), zenoh.ZError("no key")]
    problems: list[str] = []
    lab.before_open = lambda: problems.append(lab.holder.health.problem)
    lab.open()
    assert problems[1] == "cannot open: no key; correct it"
    assert "can't start new thread" in problems[2]
    assert (lab.closed, lab.declared) == ([lab.session] * 2, [lab.session])
    assert (lab.holder.session, lab.waits_s) == (lab.session, [1.0] * 2)
    assert [record.levelname for record in caplog.records] == ["WARNING", "ERROR"]


def test_a_peer_needs_no_router(monkeypatch: pytest.MonkeyPatch) -> None:
    """But nothing is sent before everything is declared: the gateway publishes from its own thread."""
    lab = Lab(monkeypatch, mode="peer")
    lab.open()
    assert lab.while_declaring == (True, "not open")
    assert not lab.holder.is_cut_off
    lab.holder.maintain()
    assert lab.holder.health.connected


def test_beyond_the_time_that_zenoh_can_express_nothing_is_sent_until_the_clock_is_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A put at a time after 2106-02-07 panics, and writes that to stderr each time."""
    lab = Lab(monkeypatch, mode="peer")
    lab.open()
    for now_s, is_right in ((2**32 - 1, True), (2**32, False), (1.7e9, True)):
        monkeypatch.setattr(time, "time", lambda now_s=now_s: now_s)
        lab.holder.maintain()
        assert lab.holder.health.connected is is_right
        assert lab.holder.is_cut_off is not is_right
        if not is_right:
            assert lab.holder.refusal.cause == "put failed"
