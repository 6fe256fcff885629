"""Runs the doctor in tests, with servers, Zenoh and LCM on this machine only."""

from typing import Any

from gateway.config.settings import MetricsSettings, SourceSettings, StreamSettings
from gateway.doctor.all_checks import run_checks
from gateway.findings import Finding, Result
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.configurations import make_settings

SECONDS = 0.3


class Findings:
    """The doctor's findings, by subject and check."""

    def __init__(self, findings: list[Finding]) -> None:
        self.all = findings

    def of(self, check: str, subject: str = "lab") -> Finding:
        [finding] = self.all_of(check, subject)
        return finding

    def all_of(self, check: str, subject: str = "lab") -> list[Finding]:
        return [each for each in self.all if (each.subject, each.check) == (subject, check)]

    def failing(self, subject: str = "lab") -> list[str]:
        return [each.check for each in self.all if each.subject == subject and each.result is Result.FAILING]

    def not_tested(self, *checks: str, subject: str = "lab") -> set[str]:
        """Return why these checks were not made."""
        findings = [self.of(check, subject) for check in checks]
        assert {finding.result for finding in findings} == {Result.NOT_TESTED}
        return {finding.found for finding in findings}


async def run_doctor(
    *sources: SourceSettings,
    zenoh_settings: ZenohSettings | None = None,
    lcm: LcmSettings | None = None,
    metrics: MetricsSettings | None = None,
    seconds: float = SECONDS,
    connects: bool = True,
) -> Findings:
    """Return the findings for ``sources``.

    By default, Zenoh is disabled, LCM stays in memory, and no running gateway is asked.
    """
    settings = make_settings(
        sources=sources,
        zenoh=zenoh_settings or ZenohSettings(enabled=False),
        lcm=lcm or LcmSettings(url="memq://"),
        metrics=metrics or MetricsSettings(enabled=False),
    )
    checks = run_checks(settings, "lab.yaml", seconds, connects=connects)
    return Findings([finding async for finding in checks])


def lab(port: int, *streams: StreamSettings, **keys: Any) -> SourceSettings:
    """Return the settings of the source "lab" on this machine; ``keys`` are further settings."""
    source: dict[str, Any] = {"host": "127.0.0.1", "reply_timeout_s": 0.1, "connect_timeout_s": 5.0}
    source["streams"] = streams or (StreamSettings(),)
    return SourceSettings(name="lab", port=port, **(source | keys))
