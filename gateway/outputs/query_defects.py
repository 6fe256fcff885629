"""Defects that come up while a query is answered: one log for each source, one text for peers."""

import logging

from gateway.errors import QueryError
from gateway.log import DefectLog


class QueryDefects:
    """Logs defects of one output with ``logger``, each once for each source. Any thread may call it."""

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._logs: dict[str, DefectLog] = {}  # by source

    def log(self, source: str, defect: Exception, query: str) -> QueryError:
        """Log the defect that a query about ``source`` met; return the error for its peer."""
        self._logs.setdefault(source, DefectLog(self._logger, source)).log(defect, text=query)
        return QueryError(f"a defect in the gateway: {defect!r}", code="defect")
