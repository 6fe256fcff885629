"""Numbers with units, as text for people: the same form wherever they are shown."""


def counted(number: int, noun: str) -> str:
    """Return a number of things, such as "1 router" or "2 routers"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def size_text(num_bytes: float) -> str:
    """Return a size, such as "300 bytes" or "3.4 MB"."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if num_bytes >= 0.99995 * factor:  # otherwise, it could be "1000.0 kB"
            return f"{num_bytes / factor:.1f} {unit}"
    return f"{num_bytes:.0f} bytes"


def duration_text(seconds: float) -> str:
    """Return a duration, such as "0.125 s", "12.3 s", "4 min 12.3 s" or "1 h 2 min 3.4 s"."""
    if 0 < seconds < 0.9995:
        return f"{seconds:.3f} s"
    minutes, rest = divmod(round(seconds, 1), 60)
    hours, minutes = divmod(int(minutes), 60)
    text = f"{rest:.1f} s"
    if hours or minutes:
        text = f"{minutes} min {text}"
    return f"{hours} h {text}" if hours else text


def age_text(age_s: float) -> str:
    """Return how long something takes or is ago: "0.3 s", "12 s", "3 min 5 s", "2 h 14 min", "3 days"."""
    if age_s < 9.95:
        return f"{max(age_s, 0.0):.1f} s"
    seconds = int(age_s)
    minutes, hours = seconds // 60, seconds // 3600
    if seconds < 60:
        return f"{seconds} s"
    if minutes < 60:
        return f"{minutes} min {seconds % 60} s"
    return f"{hours} h {minutes % 60} min" if hours < 48 else f"{hours // 24} days"


def rate_text(rate_hz: float) -> str:
    """Return a rate in Hz with at most one decimal: "2000", "199.9", "0.5"."""
    return f"{rate_hz:.0f}" if rate_hz >= 999.95 else f"{rate_hz:.1f}".removesuffix(".0")
