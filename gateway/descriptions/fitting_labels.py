"""Labels as file formats can hold them: printable, short enough, not empty, each different."""

from collections.abc import Callable, Sequence


def fitting_labels(
    labels: Sequence[str], fit: Callable[[str], str], max_bytes: int, noun: str
) -> tuple[str, ...]:
    """Return labels after ``fit``, of at most ``max_bytes`` in UTF-8 and each different.

    An empty one is called by its position, such as "marker 3". One that another item has already gets _2,
    _3, ….
    """
    fitted: dict[str, None] = {}
    numbers: dict[str, int] = {}
    for position, label in enumerate(labels, start=1):
        base = cut(fit(label), max_bytes) or fit(f"{noun} {position}")
        name, number = base, numbers.get(base, 1)
        while name in fitted:
            number += 1
            suffix = f"_{number}"
            name = cut(base, max_bytes - len(suffix)) + suffix
        numbers[base] = number
        fitted[name] = None
    return tuple(fitted)


def printable(text: str) -> str:
    """Return a text with "_" in place of each character that is not printable."""
    return "".join(character if character.isprintable() else "_" for character in text).strip()


def cut(text: str, max_bytes: int) -> str:
    """Return a text of at most ``max_bytes`` in UTF-8, cut between two characters."""
    return text.encode(errors="replace")[:max_bytes].decode(errors="ignore").strip()
