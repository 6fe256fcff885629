"""How many examples of hypothesis a test takes if the usual 100 are too few, or too many, for it."""

from typing import Final

from hypothesis import settings

_USUAL: Final = 100  # of the profile "gateway" in tests/conftest.py


def examples(count: int) -> int:
    """Return ``count`` in the usual profile; in "fuzz", as many times more as that has more than usual."""
    profile = settings.get_profile(settings.get_current_profile_name())
    return max(1, count * profile.max_examples // _USUAL)
