"""When certificates end, and the room for takes. OpenSSL made the certificates, and printed their ends."""

import ssl
from pathlib import Path
from typing import Any

import pytest

from gateway.config.settings import SourceSettings
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.service.gateway import Gateway
from gateway.service.monitoring import process_limits
from gateway.service.monitoring.process_limits import DiskFacts
from tests.support.configurations import make_settings
from tests.support.waiting import wait_until_async

FOLDER = Path(__file__).parents[3] / "data/certificates"
NEAR_S, FAR_S = 1925048779, 3005048779  # one before 2050 and one after, whose times have two forms


async def facts_of(until: str, **outputs: Any) -> DiskFacts:
    """Return the facts of a gateway with these settings of outputs as soon as ``until`` is known."""
    source = SourceSettings(name="lab", host="192.0.2.20")
    facts = DiskFacts(Gateway(make_settings(sources=(source,), **outputs), []))
    facts.start()
    await wait_until_async(lambda: getattr(facts, until))
    facts.close()
    return facts


def tls(**files: Path) -> ZenohSettings:
    keys = {key: str(path) for key, path in files.items()}
    return ZenohSettings(config={"transport": {"link": {"tls": keys}}})


async def test_the_end_of_each_certificate_of_zenoh_is_read(tmp_path: Path) -> None:
    """Zenoh closes a link when its certificate ends, and nobody expects it on that day."""
    both = tmp_path / "chain.crt"
    both.write_text((FOLDER / "far.crt").read_text() + "# the issuer\n" + (FOLDER / "near.crt").read_text())
    (tmp_path / "damaged.crt").write_text((FOLDER / "near.crt").read_text()[:300])
    facts = await facts_of(
        "certificate_ends_s",
        zenoh=tls(
            connect_certificate=FOLDER / "far.crt", root_ca_certificate=both, listen_certificate=tmp_path
        ),
    )
    assert facts.certificate_ends_s == {
        ("zenoh", "connect_certificate"): FAR_S,
        ("zenoh", "root_ca_certificate"): NEAR_S,  # the first to end
    }


@pytest.mark.parametrize("name", ["near", "far"])
def test_a_damaged_certificate_raises_only_the_documented_error(name: str) -> None:
    """What is in a file must not end the thread, or the page of the metrics."""
    der = ssl.PEM_cert_to_DER_cert((FOLDER / f"{name}.crt").read_text())
    assert process_limits._end_s(der) in {NEAR_S, FAR_S}
    for position in range(len(der)):
        for damaged in (der[:position], der[:position] + b"\xff" + der[position + 1 :]):
            try:
                process_limits._end_s(damaged)
            except ValueError:
                continue


async def test_the_room_for_takes_is_that_of_their_disk(tmp_path: Path) -> None:
    """A disk that fills up is to be noticed before takes are lost."""
    facts = await facts_of("takes_free_bytes", takes=TakesSettings(enabled=True, directory=str(tmp_path)))
    assert facts.takes_free_bytes is not None
    assert facts.takes_free_bytes > 0
    assert facts.certificate_ends_s == {}
