"""Reports of runs: one HTML page, and its tables as Markdown and CSV."""

from sb3_ars.experiments.report.page import write_report

__all__ = ["write_report"]
