"""What ``echo`` says while it hears nothing; tests/integration/commands has the tests of the command."""

from collections.abc import Callable

import pytest
import rtc3d

from gateway.client.client import GatewayClient
from gateway.client.transport import FoundSources
from gateway.errors import OutputError, QueryError
from gateway.messages.source_report import source_report
from gateway.outputs.kind import SubscriptionRequest
from gateway.tools.cli import echo_sources
from gateway.tools.cli.echo_sources import EchoSources
from tests.support import statuses
from tests.support.errors import names, raises
from tests.support.waiting import wait_until


def found_of(*components: str) -> FoundSources:
    """Return the source lab with a stream of each of these components."""
    found = FoundSources()
    found.hear("lab")
    status = rtc3d.status_t()
    status.streams = [statuses.stream(each) for each in components]
    found.add(source_report(status, "lab"))
    return found


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(echo_sources, "LOOK_S", 0.0)
    monkeypatch.setattr(echo_sources, "SAY_S", 0.0)


Said = Callable[..., str]


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Said:
    """Return a function that returns what is said within the time of many checks, or raises what they do."""

    def say(found: FoundSources | Exception, absence: str = "", component: str | None = None) -> str:
        def find(*_: object) -> FoundSources:
            if isinstance(found, Exception):
                raise found
            found.absence = absence
            return found

        monkeypatch.setattr(GatewayClient, "sources", find)
        sources = EchoSources("zenoh", SubscriptionRequest(component=component))
        texts: list[str] = []

        def is_said() -> bool:
            sources.check_silence()
            texts.append(capsys.readouterr().err)
            return any(texts)

        wait_until(is_said)
        for _ in range(100):
            sources.check_silence()
        return "".join(texts) + capsys.readouterr().err

    return say


def test_without_a_gateway_the_reason_is_said_once(said: Said) -> None:
    assert said(FoundSources(), "no gateway found") == "no gateway found\n"


def test_a_source_that_none_of_the_gateways_has_is_an_error(said: Said) -> None:
    with raises(QueryError, "'hall'", code="no-gateway"):
        said(found_of("3d"), "no gateway serves source 'hall'; sources found: lab")


def test_a_component_is_looked_for_in_all_streams(said: Said) -> None:
    text = said(found_of("3d 6d", "analog"), component="analog")
    assert names(text, "analog", "lab: streaming 200.0 Hz")
    with raises(QueryError, "force", "lab", "--component: 3d, 6d, analog"):
        said(found_of("3d 6d", "analog"), component="force")


def test_a_gateway_that_does_not_answer_proves_nothing(said: Said) -> None:
    found = found_of("3d")
    found.add_silent(["hall"])
    assert names(said(found, component="force"), "hall")


@pytest.mark.parametrize("problem", [RuntimeError("odd"), OutputError("odd", cause="not open")])
def test_a_search_that_fails_ends_nothing(said: Said, problem: Exception) -> None:
    assert said(problem).endswith("odd\n")


def test_outputs_that_cannot_be_searched_stay_silent(capsys: pytest.CaptureFixture[str]) -> None:
    sources = EchoSources("example", SubscriptionRequest())
    for _ in range(10):
        sources.check_silence()
    assert capsys.readouterr().err == ""
