"""Tables that several commands print."""

from __future__ import annotations

import pandas as pd
from rich.console import Console
from rich.table import Table

__all__ = ["print_evaluation"]


def print_evaluation(frame: pd.DataFrame, protocol: str) -> None:
    """Print the final evaluation of a run, a row per task.

    :param frame: :attr:`~sb3_ars.experiments.runner.RunResult.table`
    :param protocol: in one line
    """
    table = Table(title=protocol, title_justify="left")
    table.add_column("task")
    for heading in ("success", "success, sampled", "at the end", "return", "c_i"):
        table.add_column(heading, justify="right")
    columns = ("success", "success_sampled", "success_at_end", "return", "c")
    formats = ("{:.2f}", "{:.2f}", "{:.2f}", "{:,.1f}", "{:.3g}")
    for name, row in frame.iterrows():
        table.add_row(str(name), *(f.format(row[c]) for f, c in zip(formats, columns, strict=True)))
    table.add_section()
    means = [f.format(frame[c].mean()) for f, c in zip(formats[:3], columns[:3], strict=True)]
    table.add_row("mean", *means, "", "")
    Console().print(table)
