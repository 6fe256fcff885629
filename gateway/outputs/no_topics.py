"""The publisher of topics that an output does not publish."""


class IgnoringPublisher:
    """Accepts messages and does nothing with them: for outputs of whole frames, which have no topics."""

    wanted = False

    def publish(self, message: bytes) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""
