"""Checks of one output: its own, or whether it opens."""

import time
from collections.abc import Sequence
from typing import Final

from gateway.config.settings import OutputSettings
from gateway.errors import ConfigError
from gateway.findings import Finding, MessageLoad, Subject, as_sentence
from gateway.outputs.kind import OPENS, OutputKind

_POLL_S: Final = 0.05


def check_output(
    kind: OutputKind,
    settings: OutputSettings,
    sources: Sequence[str],
    loads: Sequence[MessageLoad],
    seconds: float,
) -> list[Finding]:
    """Run the checks of one output; blocks for about ``seconds``.

    ``sources`` are the names of all sources, ``loads`` the messages that they make.
    """
    if not settings.enabled:
        subject = Subject(kind.name)
        return [subject.disabled(check) for check in kind.checks]
    if kind.run_checks is not None:
        return kind.run_checks(settings, sources, loads, seconds)
    return [_check_opens(kind, settings, seconds)]


def _check_opens(kind: OutputKind, settings: OutputSettings, seconds: float) -> Finding:
    """Check that the output opens, as in the gateway, within ``seconds``; then close it."""
    subject = Subject(kind.name)
    default_remedy = f"Correct {kind.name} in the configuration."
    try:
        output = kind.create(settings)
    except ConfigError as error:
        return subject.failing(OPENS, str(error), default_remedy)
    output.start()
    deadline_s = time.monotonic() + seconds
    while not output.health().connected and time.monotonic() < deadline_s:
        time.sleep(_POLL_S)
        output.maintain()
    health = output.health()
    output.close()
    if health.connected:
        return subject.passing(OPENS, "the output opens")
    found, _, remedy = health.problem.partition("; ")
    return subject.failing(OPENS, found, as_sentence(remedy) if remedy else default_remedy)
