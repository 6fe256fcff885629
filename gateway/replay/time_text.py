"""Times in a take as texts."""


def time_text(duration_us: int) -> str:
    """Return a time in a take as hours, minutes, seconds and tenths: "0:01:30.2", "-0:00:02.0"."""
    minutes, tenths = divmod(abs(duration_us) // 100_000, 600)
    sign = "-" if duration_us < 0 else ""
    return f"{sign}{minutes // 60}:{minutes % 60:02}:{tenths // 10:02}.{tenths % 10}"
