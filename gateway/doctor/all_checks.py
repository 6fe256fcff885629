"""All checks, layer by layer, so that a fault is found before its consequences."""

import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from functools import partial
from typing import Final

from gateway.config.settings import OutputSettings, Settings
from gateway.doctor.computer_checks import check_clock
from gateway.doctor.gateway_checks import CHECKS as GATEWAY_CHECKS
from gateway.doctor.gateway_checks import HealthReport, address_text, check_gateway, read_health
from gateway.doctor.source_checks import CHECKS, SourceChecks
from gateway.errors import ConfigError
from gateway.outputs.findings import NO_CONFIGURATION, Finding, MessageLoad, Subject, as_sentence
from gateway.outputs.kind import OPENS, OutputKind
from gateway.outputs.registry import OUTPUTS, UNUSABLE
from gateway.workers import WorkerThread

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


_configuration = Subject("configuration")


async def run_checks(
    settings: Settings,
    origin: str,
    seconds: float,
    *,
    connects: bool = True,
    output_sections: Mapping[str, OutputSettings] | None = None,
) -> AsyncIterator[Finding]:
    """Run all checks, and yield each finding as soon as it is known.

    The running gateway is asked first. Then the sources are watched one after the other, each for
    ``seconds``, unless ``connects`` is False: then no connection to their servers is opened. Outputs that
    are not enabled come after the others.

    ``origin`` says where the settings come from, for example a file name. ``output_sections`` replace those
    of the settings where an output is checked.
    """
    enabled = [name for name, section in settings.outputs.items() if section.enabled]
    names = [source.name for source in settings.sources]
    yield _configuration.passing("file", f"{origin}: {', '.join(names)} to {', '.join(enabled)}")
    report = await read_health(settings.metrics)
    for finding in check_gateway(report, address_text(settings.metrics), names, connects=connects):
        yield finding
    loads: list[MessageLoad] = []
    for source in settings.sources:
        checks = SourceChecks(source, seconds, report if isinstance(report, HealthReport) else None)
        async for finding in checks.run() if connects else checks.run_without_connecting():
            yield finding
        loads += checks.message_loads
    sections = {**settings.outputs, **(output_sections or {})}
    for name, section in sorted(sections.items(), key=lambda item: not item[1].enabled):
        check = partial(check_output, OUTPUTS[name], section, names, loads, seconds)
        for finding in await WorkerThread(name).run(check):
            yield finding
    for name, text in UNUSABLE.items():
        found, _, remedy = text.rpartition("; ")
        yield Subject(name).warning("package", found, as_sentence(remedy))
    leaving = [name for name in enabled if OUTPUTS[name].leaves_host(settings.outputs[name])]
    yield check_clock(leaving)


def run_checks_without_settings(error: ConfigError) -> Iterator[Finding]:
    """Yield ``error`` as a finding, and run the checks that need no settings."""
    yield _configuration.failing(
        "file", str(error), "Correct these lines; config/gateway.yaml explains every key."
    )
    subjects = {
        "running gateway": GATEWAY_CHECKS,
        "source": CHECKS,
        **{name: kind.checks for name, kind in OUTPUTS.items()},
    }
    for subject, checks in subjects.items():
        for check in checks:
            yield Subject(subject).not_tested(check, NO_CONFIGURATION)
    yield check_clock([])
