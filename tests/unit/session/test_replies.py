"""XmlThread: XML is processed in a thread for each source, and long XML in one thread for all."""

import asyncio
import threading

from gateway.session.replies import LONG_XML_BYTES, XmlThread

SHORT, LONG = b"short", bytes(LONG_XML_BYTES + 1)


class Gate:
    """A function for XmlThread that waits until it may finish."""

    def __init__(self) -> None:
        self.entered = threading.Event()
        self.may_finish = threading.Event()

    def __call__(self, xml: bytes) -> int:
        self.entered.set()
        self.may_finish.wait()
        return len(xml)


def test_short_xml_does_not_wait_for_another_source() -> None:
    asyncio.run(_process_short_xml_beside_long())


async def _process_short_xml_beside_long() -> None:
    slow, lab = XmlThread("slow"), XmlThread("lab")
    gate = Gate()
    waiting = asyncio.create_task(slow.process(LONG, gate))
    await asyncio.to_thread(gate.entered.wait)
    assert await lab.process(SHORT, len) == len(SHORT)
    gate.may_finish.set()
    assert await waiting == len(LONG)


def test_long_xml_is_processed_by_one_source_at_a_time() -> None:
    asyncio.run(_process_long_xml_of_two_sources())


async def _process_long_xml_of_two_sources() -> None:
    first, second = Gate(), Gate()
    tasks = [asyncio.create_task(XmlThread("a").process(LONG, first))]
    await asyncio.to_thread(first.entered.wait)
    tasks.append(asyncio.create_task(XmlThread("b").process(LONG, second)))
    assert not await asyncio.to_thread(second.entered.wait, 0.2)
    first.may_finish.set()
    await asyncio.to_thread(second.entered.wait)
    second.may_finish.set()
    assert await asyncio.gather(*tasks) == [len(LONG), len(LONG)]
