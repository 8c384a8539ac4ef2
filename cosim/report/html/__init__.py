"""The report of a run: one self-contained HTML file."""

from cosim.report.html.page import html, write

__all__ = ["html", "write"]
