"""Text that is safe to print on a terminal."""


def printable(text: str) -> str:
    """Return ``text`` with control characters replaced: it may come from servers or unknown publishers."""
    return "".join(
        character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text
    )
