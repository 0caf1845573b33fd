"""One HTML page of one or more runs, which needs nothing beside it."""

from cohdc_train.report.command import report, write_report
from cohdc_train.report.page import Table

__all__ = ["Table", "report", "write_report"]
