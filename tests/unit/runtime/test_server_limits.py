"""Who is disconnected or refused when a server has too many clients."""

from dataclasses import replace

import pytest

from gateway.runtime.server_limits import Clients, ServerLimits

LIMITS = ServerLimits(clients=3, handshakes=2)


class Lab:
    """Clients that are numbers; ``ended`` are those that were disconnected."""

    def __init__(self, limits: ServerLimits) -> None:
        self.ended: list[int] = []
        self.clients: Clients[int] = Clients(limits, self.ended.append)

    def open(self, *clients: int) -> None:
        for each in clients:
            self.clients.open(each)

    def serve(self, *clients: int) -> None:
        for each in clients:
            self.clients.serve(each)


def test_the_oldest_handshake_makes_room_and_clients_that_are_served_do_not() -> None:
    """A port scan must not keep others out, nor disconnect anybody who is served."""
    lab = Lab(LIMITS)
    lab.open(1, 2)
    lab.serve(1)
    lab.open(3, 4, 5)
    assert (lab.ended, list(lab.clients), list(lab.clients.served)) == ([2, 3], [4, 5, 1], [1])


@pytest.mark.parametrize(("num_served", "num_ended"), [(0, 1), (1, 2), (2, 3)])
def test_without_a_limit_of_its_own_a_handshake_needs_a_free_place(num_served: int, num_ended: int) -> None:
    """All connections together are then bounded by the number of clients."""
    lab = Lab(replace(LIMITS, handshakes=None))
    served = range(100, 100 + num_served)
    lab.open(*served)
    lab.serve(*served)
    lab.open(1, 2, 3, 4)
    assert (lab.ended, len(lab.clients)) == ([1, 2, 3][:num_ended], 3)


def test_a_server_is_full_until_a_client_that_is_served_goes() -> None:
    lab = Lab(LIMITS)
    lab.open(9)
    for each in (1, 2, 3):
        assert not lab.clients.is_full
        lab.serve(each)
    assert lab.clients.is_full
    for each in (9, 9):  # a connection may be reported twice
        lab.clients.close(each)
        assert lab.clients.is_full
    lab.clients.close(2)
    assert (lab.clients.is_full, list(lab.clients)) == (False, [1, 3])


def test_the_oldest_handshake_can_be_disconnected_for_another_reason() -> None:
    """Such as a lack of file descriptors."""
    lab = Lab(LIMITS)
    lab.open(1, 2)
    for _ in range(3):
        lab.clients.disconnect_oldest()
    assert (lab.ended, len(lab.clients)) == ([1, 2], 0)


def test_many_clients_share_what_may_wait_for_all() -> None:
    """A thousand clients that do not read must not use up the memory."""
    limits = ServerLimits(clients=1, unread_bytes=400, unread_bytes_in_all=1000)
    assert [replace(limits, clients=count).unread_bytes_each for count in (1, 2, 4)] == [400, 400, 250]
