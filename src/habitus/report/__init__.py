"""What a fit is worth, for people and for programs: metrics.json and the HTML report."""

from habitus.report.fit.index import write_index
from habitus.report.fit.page import write_report
from habitus.report.metrics import metrics, write_metrics

__all__ = ["metrics", "write_index", "write_metrics", "write_report"]
