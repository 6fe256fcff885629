"""The extensions of the files to which takes are exported; ``formats`` has what writes them."""

from typing import Final

EXTENSIONS: Final = (".c3d", ".trc", ".csv", ".mcap")
