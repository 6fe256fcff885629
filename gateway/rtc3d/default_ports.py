"""The TCP ports on which RT servers listen by default (§2, field note 12)."""

from typing import Final

FIRST_PRINCIPLES_PORT: Final = 3020
WAVEFRONT_PORT: Final = 3030
