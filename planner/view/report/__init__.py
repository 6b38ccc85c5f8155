"""report.html: one page per plan that needs no other file."""

from planner.view.report.page import NAME, write_report

__all__ = ["NAME", "write_report"]
