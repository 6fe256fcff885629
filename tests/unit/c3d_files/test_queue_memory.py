from gateway.c3d_files.queue_memory import QueueMemory

PIECE = bytes(800)  # and 200 bytes of overhead


def reserved(memory: QueueMemory, source: str) -> int:
    """Reserve as many pieces as a source can have; return their number."""
    count = 0
    while memory.reserve(source, PIECE):
        count += 1
    return count


def test_a_source_gets_half_of_the_memory_and_leaves_the_others_their_share() -> None:
    memory = QueueMemory(120_000)
    assert reserved(memory, "a") == 60
    assert reserved(memory, "b") == 30
    assert reserved(memory, "c") == 15
    assert memory.held_bytes == 105_000
    assert reserved(memory, "a") == 0


def test_released_memory_is_free_again() -> None:
    memory = QueueMemory(10_000)
    for _ in range(reserved(memory, "a")):
        memory.release("a", PIECE)
    assert memory.held_bytes == 0
    assert reserved(memory, "b") == 5


def test_pieces_without_content_take_memory_too() -> None:
    memory = QueueMemory(2000)
    assert [memory.reserve("a", b"") for _ in range(7)] == [*5 * [True], *2 * [False]]
