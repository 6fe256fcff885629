from gateway.export.extensions import EXTENSIONS
from gateway.export.formats import FORMATS


def test_every_extension_has_a_format() -> None:
    assert tuple(FORMATS) == EXTENSIONS
