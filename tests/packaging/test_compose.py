"""The files for compose fit each other. The images of others are not at hand, so no test runs them."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any, Final

import yaml

from gateway import __version__
from tests.support.configurations import load
from tests.support.documents import ROOT
from tests.support.needs import need_programs

FOLDER: Final = ROOT / "config/compose"
SERVICES: Final[dict[str, dict[str, Any]]] = yaml.safe_load((FOLDER / "compose.yaml").read_text())["services"]


def mounts(service: str) -> dict[str, Path]:
    """Return the files and folders that a service sees, by their path in its container."""
    volumes = [volume.split(":") for volume in SERVICES[service]["volumes"]]
    return {target: FOLDER / source for source, target, *_ in volumes if source.startswith(".")}


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def test_every_file_that_is_mounted_exists_and_is_read_only() -> None:
    """An engine would make a folder of a file that does not exist."""
    for service in SERVICES.keys() - {"simulator"}:
        assert all(path.exists() for path in mounts(service).values()), service
        binds = [volume for volume in SERVICES[service]["volumes"] if volume.startswith(".")]
        assert all(volume.endswith(":ro") for volume in binds), service


def test_the_gateway_has_this_version_and_reaches_the_other_services() -> None:
    assert {SERVICES[name]["image"] for name in ("gateway", "simulator")} == {f"rtc3d-gateway:{__version__}"}
    settings = load(mounts("gateway")["/etc/rtc3d-gateway"] / "gateway.yaml")
    [source] = settings.sources
    assert source.host in SERVICES
    [endpoint] = settings.zenoh.config["connect"]["endpoints"]
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition(":")
    assert protocol == "tcp"
    assert host in SERVICES
    assert f"{port}:{port}" in SERVICES[host]["ports"]


def test_prometheus_reads_its_rules_and_the_metrics_of_the_gateway(tmp_path: Path) -> None:
    need_programs("promtool", packages="prometheus")
    for target, path in mounts("prometheus").items():
        copy = tmp_path / target.removeprefix("/")
        copy.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if path.is_dir() else shutil.copy)(path, copy)
    configuration = tmp_path / "etc/prometheus/prometheus.yml"
    command = ("promtool", "check", "config", configuration)
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    assert "1 rule files found" in checked.stdout

    [job] = read(configuration)["scrape_configs"]
    rules = (ROOT / "config/prometheus/rtc3d-gateway.yaml").read_text()
    assert f'up{{job="{job["job_name"]}"}}' in rules
    metrics = load(mounts("gateway")["/etc/rtc3d-gateway"] / "gateway.yaml").metrics
    assert job["static_configs"] == [{"targets": [f"gateway:{metrics.port}"]}]
    assert metrics.host == "0.0.0.0"  # noqa: S104 - inside the container


def test_grafana_finds_the_dashboard_and_its_data_source() -> None:
    seen = mounts("grafana")
    provisioning = "/etc/grafana/provisioning"
    [provider] = read(seen[f"{provisioning}/dashboards/rtc3d-gateway.yaml"])["providers"]
    [dashboard] = seen[provider["options"]["path"]].glob("*.json")
    variables = json.loads(dashboard.read_text())["templating"]["list"]
    [wanted] = [variable["query"] for variable in variables if variable["type"] == "datasource"]

    [source] = read(seen[f"{provisioning}/datasources/rtc3d-gateway.yaml"])["datasources"]
    assert (source["type"], source["isDefault"]) == (wanted, True)
    host, port = source["url"].removeprefix("http://").split(":")
    assert any(published.endswith(f":{port}") for published in SERVICES[host]["ports"])
