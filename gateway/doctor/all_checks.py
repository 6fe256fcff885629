"""All checks, layer by layer, so that a fault is found before its consequences."""

from collections.abc import AsyncIterator, Iterator, Mapping
from functools import partial

from gateway.config.settings import OutputSettings, Settings
from gateway.doctor.clock_check import check_clock
from gateway.doctor.gateway_checks import CHECKS as GATEWAY_CHECKS
from gateway.doctor.gateway_checks import check_gateway
from gateway.doctor.output_checks import check_output
from gateway.doctor.running_gateway import HealthReport, address_text, read_health
from gateway.doctor.source_checks import CHECKS, SourceChecks
from gateway.errors import ConfigError
from gateway.findings import NO_CONFIGURATION, Finding, MessageLoad, Subject
from gateway.outputs.registry import OUTPUTS
from gateway.worker_thread import WorkerThread

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
