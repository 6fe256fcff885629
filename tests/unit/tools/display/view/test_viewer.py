"""The server of the page, and the viewer with pages that are connected, but are no browsers."""

import contextlib
import math
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from gateway.errors import ViewError
from gateway.rtc3d.components import ComponentType
from gateway.tools.display.view.viewer import Viewer, ViewServer, address_of, open_server
from tests.support.errors import raises
from tests.support.waiting import wait_until
from tests.unit.tools.display.live_lab import Lab
from tests.unit.tools.display.view.page_client import PageClient, page_client

POINTS = "/sources/MOCAP_LAB/markers"


@pytest.fixture
def viewer(server: ViewServer, lab: Lab) -> Viewer:
    return Viewer(server, lab.live)


def num_sent(server: ViewServer) -> int:
    return server._connection.get_message_buffer().message_counter


def show(viewer: Viewer, lab: Lab, times: int, num_markers: int = 1) -> None:
    """Show frames that differ."""
    for number in range(times):
        markers = [(number % 1000, each, 0, 0.1) for each in range(num_markers)]
        lab.send(ComponentType.MARKERS, markers)
        viewer.update()


def test_nothing_is_sent_while_no_page_is_connected(viewer: Viewer, lab: Lab, server: ViewServer) -> None:
    show(viewer, lab, times=1)
    before = num_sent(server)
    show(viewer, lab, times=50)
    assert num_sent(server) == before


def test_each_of_three_pages_sees_the_data(viewer: Viewer, lab: Lab, server: ViewServer) -> None:
    with contextlib.ExitStack() as stack:
        pages = [stack.enter_context(page_client(server)) for _ in range(3)]
        wait_until(lambda: len(server.get_clients()) == 3)
        with _running(viewer, lab):
            for page in pages:
                page.wait_for(POINTS, "points")
    wait_until(lambda: not server.get_clients())


def test_a_page_gets_everything_although_its_connection_changes_meanwhile(
    viewer: Viewer, lab: Lab, server: ViewServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Setting an event in another thread fails if its waiters change at that moment."""
    event = server._connection.get_message_buffer().message_event
    set_event = event.set

    def set_unless_waiters_change() -> None:
        if threading.current_thread() is threading.main_thread():
            raise RuntimeError("deque mutated during iteration")
        set_event()

    with page_client(server) as page:
        wait_until(lambda: bool(server.get_clients()))
        monkeypatch.setattr(event, "set", set_unless_waiters_change)
        show(viewer, lab, times=1)
        page.wait_for(POINTS, "points")


def test_the_view_of_a_page_is_fitted_once_and_when_it_wants(
    viewer: Viewer, lab: Lab, server: ViewServer
) -> None:
    with page_client(server) as page:
        wait_until(lambda: bool(server.get_clients()))
        with _running(viewer, lab):
            _wait_for_camera(page)
            [number] = server.get_clients()
            cameras = viewer.scene._cameras
            wait_until(lambda: number in cameras._pages)
            cameras.fit_again(server.get_clients()[number])  # as its button does
            wait_until(lambda: number in cameras._pages)


@pytest.mark.parametrize(
    "camera",
    [{"image_height": 0}, {"image_width": 0}, {"position": (math.nan,) * 3}, {"fov": 0.0}, {"fov": 9.0}],
)
def test_a_page_with_an_odd_camera_sees_the_data(
    viewer: Viewer, lab: Lab, server: ViewServer, camera: dict[str, Any]
) -> None:
    with page_client(server, **camera) as page:
        wait_until(lambda: bool(server.get_clients()))
        with _running(viewer, lab):
            wait_until(lambda: viewer.scene._cameras._pages)
            page.wait_for(POINTS, "points")


def test_a_page_that_does_not_read_costs_no_memory_and_does_not_delay_others(
    viewer: Viewer, lab: Lab, server: ViewServer
) -> None:
    with page_client(server), page_client(server) as reader:
        wait_until(lambda: len(server.get_clients()) == 2)
        waiting = server._connection.get_message_buffer().message_from_id
        with _running(viewer, lab):
            reader.wait_for(POINTS, "points")
        show(viewer, lab, times=10)
        before = len(waiting)
        show(viewer, lab, times=300, num_markers=1000)  # 12 kB each: more than its socket takes
        assert len(waiting) <= before + 10
        with _running(viewer, lab):
            reader.wait_for(POINTS, "points")


def test_what_a_page_should_not_send_is_ignored(viewer: Viewer, lab: Lab, server: ViewServer) -> None:
    with page_client(server) as page:
        wait_until(lambda: bool(server.get_clients()))
        with _running(viewer, lab):
            page.wait_for(POINTS, "points")
            uuid = viewer.scene._switches._up._impl.uuid
            page.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": "no axis"}})
            wait_until(lambda: viewer.scene._switches._up.value not in {"x", "y", "z"})
            page.wait_for(POINTS, "points")
    assert viewer.num_defects == 0


def test_a_defect_is_reported_once_and_the_view_goes_on(
    viewer: Viewer, lab: Lab, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise KeyError("plots")

    server = viewer.scene._server
    monkeypatch.setattr(viewer.panel, "update", fail)
    with page_client(server) as page:
        wait_until(lambda: bool(server.get_clients()))
        with _running(viewer, lab):
            wait_until(lambda: viewer.num_defects > 3)
            page.wait_for(POINTS, "points")
    assert capsys.readouterr().err == "defect in rtc3d-gateway view: KeyError: 'plots'; report this\n"


def test_a_page_that_comes_and_goes_leaves_nothing(viewer: Viewer, lab: Lab, server: ViewServer) -> None:
    waiting = server._connection.get_message_buffer().message_from_id
    sizes = []
    for _ in range(8):
        with page_client(server) as page:
            wait_until(lambda: bool(server.get_clients()))
            with _running(viewer, lab):
                page.wait_for(POINTS, "points")
        wait_until(lambda: not server.get_clients())
        viewer.update()
        sizes.append(len(waiting))
    assert sizes[-1] <= sizes[0] + 3, sizes  # the panel shows something for the first time


def _wait_for_camera(page: PageClient) -> None:
    while not any(message["type"] == "SetCameraLookAtMessage" for message in page.receive()):
        pass


@contextlib.contextmanager
def _running(viewer: Viewer, lab: Lab) -> Iterator[None]:
    """Run the viewer in a thread, with a frame for each picture."""
    stop = threading.Event()
    number = 0

    def send() -> None:
        nonlocal number
        number += 1
        lab.send(ComponentType.MARKERS, [(number % 1000, 0, 0, 0.1)])

    thread = threading.Thread(target=viewer.run, args=(stop.wait, send))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_a_port_in_use_is_one_sentence_with_the_port_and_the_option() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with raises(ViewError, port, "127.0.0.1", "--port"):
            open_server("127.0.0.1", port)


def test_a_port_that_was_used_a_moment_ago_can_be_used_again() -> None:
    with socket.create_server(("127.0.0.1", 0)) as former:
        port = former.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as client:
            former.accept()[0].close()  # first, so that the port stays in the state TIME_WAIT
            assert client.recv(1) == b""
    open_server("127.0.0.1", port).stop()


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_an_address_of_another_computer_is_one_sentence_with_the_option(host: str) -> None:
    with pytest.raises(ViewError, match=f"{host}.*--host"):
        open_server(host, 0)


def test_a_connection_that_is_no_browser_logs_nothing(
    server: ViewServer, caplog: pytest.LogCaptureFixture
) -> None:
    for request in (b"", b"\x16\x03\x01 no HTTP\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", server.get_port())) as connection:
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(1000):
                pass
    assert not caplog.records


def test_it_prints_nothing_and_shares_nothing(capfd: pytest.CaptureFixture[str], server: ViewServer) -> None:
    assert server.request_share_url() is None  # type: ignore[func-returns-value]
    server.stop()
    assert capfd.readouterr() == ("", "")


def test_the_address_can_be_opened_on_this_computer() -> None:
    hosts = ("127.0.0.1", "0.0.0.0", "::1", "lab-pc")  # noqa: S104
    addresses = ["http://127.0.0.1:8080", "http://localhost:8080", "http://[::1]:8080", "http://lab-pc:8080"]
    assert [address_of(host, 8080) for host in hosts] == addresses


@pytest.mark.parametrize("field", ["Host: evil.example", "Host: localhost\r\nOrigin: http://evil.example"])
@pytest.mark.parametrize("upgrade", ["", "Connection: Upgrade\r\nUpgrade: websocket\r\n"])
def test_pages_of_foreign_sites_are_refused(server: ViewServer, field: str, upgrade: str) -> None:
    """A web page could watch otherwise, by DNS rebinding or by a WebSocket from another origin."""
    with socket.create_connection(("127.0.0.1", server.get_port())) as connection:
        connection.sendall(f"GET / HTTP/1.1\r\n{field}\r\n{upgrade}\r\n".encode())
        answer = connection.recv(1000)
    assert answer.startswith(b"HTTP/1.1 403 ")


def test_the_page_of_this_server_is_not_refused(server: ViewServer) -> None:
    origin: Any = f"http://localhost:{server.get_port()}"
    with page_client(server, origin=origin):
        wait_until(lambda: bool(server.get_clients()))
    with socket.create_connection(("127.0.0.1", server.get_port())) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert connection.recv(1000).startswith(b"HTTP/1.1 200 ")
