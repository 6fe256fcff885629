"""The alerts in config/prometheus: promtool checks their syntax, and lets each fire and not fire."""

import subprocess
from pathlib import Path
from typing import Final

import pytest
import yaml

from tests.documents import ROOT
from tests.needs import need_programs

RULES: Final = ROOT / "config/prometheus/rtc3d-gateway.yaml"


_SOURCE: Final = 'instance="a",source="lab",stream="3d"'
_STREAMING: Final = {f'rtc3d_gateway_stream_state{{{_SOURCE},state="streaming"}}': "1+0x30"}
_DROPS: Final = 'instance="a",source="lab",cause="x"'

CASES: Final[list[tuple[str, str, str, str, bool]]] = [
    # alert, series, its values each minute if it fires, and if it does not, whether a stream is streaming
    ("GatewayDown", 'up{job="rtc3d-gateway",instance="a"}', "0+0x30", "1+0x30", False),
    ("OutputDown", 'rtc3d_gateway_output_connected{output="zenoh"}', "0+0x30", "1+0x30", False),
    ("TakesNotWritten", 'rtc3d_gateway_output_connected{output="takes"}', "0+0x30", "1+0x30", False),
    (
        "TakesNotWritten",
        f'rtc3d_gateway_output_drops_total{{{_DROPS},output="takes"}}',
        "0+1x30",
        "7+0x30",
        False,
    ),
    ("TakesDiskFilling", 'rtc3d_gateway_takes_free_bytes{instance="a"}', "1e9+0x30", "9e10+0x30", False),
    ("TakesDiskFilling", 'rtc3d_gateway_takes_free_bytes{instance="a"}', "9e10-1.7e9x30", "9e10+0x30", False),
    (
        "CertificateEnds",
        'rtc3d_gateway_certificate_not_after_timestamp_seconds{output="zenoh",key="connect_certificate"}',
        "2500000+0x30",
        "2700000+0x30",
        False,
    ),
    ("SourceSilent", f"rtc3d_gateway_last_frame_timestamp_seconds{{{_SOURCE}}}", "0+0x30", "0+60x30", True),
    ("ServerAway", f'rtc3d_gateway_stream_state{{{_SOURCE},state="idle"}}', "0+0x30", "1+0x30", False),
    ("ConnectionUnsteady", f"rtc3d_gateway_sessions_total{{{_SOURCE}}}", "0+1x30", "1+0x30", False),
    ("FramesDropped", f"rtc3d_gateway_stream_drops_total{{{_DROPS}}}", "0+1x30", "7+0x30", False),
    (
        "FramesDropped",
        f'rtc3d_gateway_output_drops_total{{{_DROPS},output="lcm"}}',
        "0+1x30",
        "7+0x30",
        False,
    ),
    ("FramesLate", f"rtc3d_gateway_lag_seconds{{{_SOURCE}}}", "0.1+0x30", "0.01+0x30", True),
    ("NoClock", f"rtc3d_gateway_clock_valid{{{_SOURCE}}}", "0+0x30", "1+0x30", True),
    ("EventLoopSlow", 'rtc3d_gateway_loop_delay_max_seconds{instance="a"}', "0.2+0x30", "0.01+0x30", False),
    ("NoSubscriber", 'rtc3d_gateway_source_subscribed{instance="a",source="lab"}', "0+0x30", "1+0x30", True),
    ("Defect", 'rtc3d_gateway_defects_total{instance="a"}', "0+1x30", "3+0x30", False),
    ("HostClockSet", 'rtc3d_gateway_host_clock_steps_total{instance="a"}', "0+1x30", "1+0x30", False),
]


def test_there_is_a_case_for_each_alert() -> None:
    [group] = yaml.safe_load(RULES.read_text())["groups"]
    assert {rule["alert"] for rule in group["rules"]} == {alert for alert, *_ in CASES}


@pytest.mark.parametrize("does_fire", [True, False], ids=["fire", "do not fire"])
def test_alerts_fire_when_they_should_and_only_then(does_fire: bool, tmp_path: Path) -> None:
    """After 20 minutes with these values, one a minute."""
    need_programs("promtool", packages="prometheus")
    tests = []
    for alert, series, fires, rests, is_streaming in CASES:
        values = {series: fires if does_fire else rests} | (_STREAMING if is_streaming else {})
        query = {
            "expr": f'count(ALERTS{{alertname="{alert}",alertstate="firing"}})',
            "eval_time": "20m",
            "exp_samples": [{"labels": "{}", "value": 1}] if does_fire else [],
        }
        inputs = [{"series": name, "values": value} for name, value in values.items()]
        tests.append({"interval": "1m", "input_series": inputs, "promql_expr_test": [query]})
    file = tmp_path / "test.yaml"
    file.write_text(yaml.safe_dump({"rule_files": [str(RULES)], "tests": tests}))
    for command in (("check", "rules", str(RULES)), ("test", "rules", str(file))):
        done = subprocess.run(["promtool", *command], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
