"""report.html: one page per plan that says everything and needs nothing beside it."""

from planner.view.report.page import NAME, html, write_report

__all__ = ["NAME", "html", "write_report"]
