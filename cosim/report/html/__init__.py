"""The report of a run: one HTML file that needs nothing but itself."""

from cosim.report.html.page import html, write

__all__ = ["html", "write"]
