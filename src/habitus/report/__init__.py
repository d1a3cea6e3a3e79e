"""Pages and pictures of results."""

from habitus.report.fit.page import write_report
from habitus.report.index import write_index

__all__ = ["write_index", "write_report"]
