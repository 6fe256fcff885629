"""The error that ends a connection because of a defect in this program."""

from gateway.errors import DefectError
from gateway.log import defect_text


def defect_error(defect: BaseException) -> DefectError:
    """Return the error for an exception that nobody expected."""
    error = DefectError(f"{defect_text(defect)}; connecting again; report this with the log")
    error.__cause__ = defect
    return error
