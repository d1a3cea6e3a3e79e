"""What a fit is worth, for people: HTML reports."""

from habitus.report.fit.index import write_index
from habitus.report.fit.page import write_report

__all__ = ["write_index", "write_report"]
