"""The mutants of `make mutants`, which takes too long for each change."""

from tests.mutants import load


def test_every_mutant_fits_the_code() -> None:
    """Whoever changes code that a mutant changes, too, learns it now and not at the next `make mutants`."""
    assert load()  # it raises ValueError for one that does not fit
