"""Reloading the configuration of a running gateway, on real Zenoh and LCM."""

import asyncio
import json
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.config.settings import MetricsSettings, Settings
from gateway.daemon.daemon import Daemon
from gateway.daemon.gateway import Gateway
from gateway.errors import ConfigError
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.support.configurations import local_settings, local_source
from tests.support.gateways import running_gateway
from tests.support.networks import free_endpoint, free_port, lcm_url, zenoh_keys
from tests.support.queried_gateway import ParameterServer, query, query_all, zenoh_peer
from tests.support.servers import ScriptedServer
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns


class SettingsBuilder:
    """Builds settings with a Zenoh endpoint and an LCM URL that no other test uses."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.url = lcm_url()

    def settings(self, sources: Mapping[str, int], **sections: Any) -> Any:
        """Return settings with sources by name and port; ``sections`` replace the default sections."""
        own = {"zenoh": self.zenoh(), "lcm": LcmSettings(url=self.url)}
        return local_settings(*(local_source(port, name) for name, port in sources.items()), **own | sections)

    def zenoh(self, **keys: Any) -> ZenohSettings:
        return ZenohSettings(**{"config": zenoh_keys("peer", listen=self.endpoint), **keys})


@asynccontextmanager
async def running(settings: Settings) -> AsyncIterator[Gateway]:
    async with running_gateway(Gateway(settings)) as gateway:
        await gateway.opened.wait()
        yield gateway


async def test_zenoh_reopens_at_the_same_address_and_publishes_cached_parameters() -> None:
    builder, server = SettingsBuilder(), ParameterServer("known")
    async with (
        ScriptedServer(server.script) as lab_server,
        running(builder.settings({"lab": lab_server.port})) as gateway,
    ):
        await wait_until_async(lambda: server.count("StreamFrames") >= 1)
        changed = builder.settings({"lab": lab_server.port}, zenoh=builder.zenoh(prefix="other"))
        assert await gateway.reload(changed) == ["output zenoh changed"]
        await wait_until_async(lambda: gateway.outputs[0].health().connected)
        payloads: list[bytes] = []
        with zenoh_peer(builder.endpoint) as peer:
            subscriber = peer.declare_subscriber(
                "other/lab/parameters", lambda sample: payloads.append(sample.payload.to_bytes())
            )
            assert b"known" in (await query(peer, "other/lab/parameters")).payload
            await wait_until_async(lambda: payloads)
            assert b"known" in payloads[0]
            assert await query_all(peer, "mocap/lab/parameters") == []
            subscriber.undeclare()


async def test_metrics_move_to_another_port(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    builder, before, after = SettingsBuilder(), free_port(), free_port()
    first = builder.settings({"lab": free_port()}, metrics=MetricsSettings(port=before))
    settings = [first.model_copy(update={"metrics": MetricsSettings(port=after)})]
    daemon = Daemon(settings.pop, Gateway(first))
    task = asyncio.create_task(daemon.run())
    await wait_until_async(daemon._gateway.opened.is_set)
    daemon.hang_up()
    await wait_until_async(lambda: "metrics changed" in caplog.text)
    _, writer = await asyncio.open_connection("127.0.0.1", after)
    writer.close()
    with pytest.raises(ConnectionRefusedError):
        await asyncio.open_connection("127.0.0.1", before)
    daemon.request_stop()
    await task


async def test_a_changed_zenoh_configuration_file_reopens_the_output_unless_zenoh_refuses_it(
    tmp_path: Path,
) -> None:
    builder, file = SettingsBuilder(), tmp_path / "zenoh.json5"
    other = free_endpoint()
    file.write_text(json.dumps(zenoh_keys("peer", listen=builder.endpoint)))
    settings = builder.settings({"lab": free_port()}, zenoh=builder.zenoh(config=file))
    async with running(settings) as gateway:
        assert await gateway.reload(settings) == []
        file.write_text(json.dumps(zenoh_keys("peer", listen=other)))
        assert await gateway.reload(settings) == ["output zenoh changed"]
        await wait_until_async(lambda: gateway.outputs[0].health().connected)
        file.write_text("{no_such_key: 1}")
        refused = builder.settings({"other": free_port()}, zenoh=builder.zenoh(config=file))
        with pytest.raises(ConfigError, match="no_such_key"):
            await gateway.reload(refused)
        assert [source.name for source in gateway.sources] == ["lab"]
        with zenoh_peer(other) as peer:
            await query(peer, "mocap/lab/status")
