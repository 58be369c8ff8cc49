"""The table of ``kkl-gym evaluate --faults``: how soon monitors notice faulty sensors."""

from typing import TYPE_CHECKING

import numpy as np
from rich.table import Column, Table

if TYPE_CHECKING:
    import pandas as pd

HEADER = ("false alarms", "fault", "within", "noticed in time", "median delay in s", "95 %")


def fault_rows(runs: "pd.DataFrame") -> list[list[str]]:
    """A row for each observer and fault."""
    rows = []
    for observer, group in runs.groupby("observer", sort=False):
        false = f"{100 * (group[group.fault == 'none'].score > 1).mean():.1f} %"
        for fault, faulty in group[group.fault != "none"].groupby("fault", sort=False):
            noticed = f"{100 * (faulty.score > 1).mean():.1f} %"
            delays = (f"{delay:.2f}" for delay in np.quantile(faulty.delay, [0.5, 0.95], method="higher"))
            rows.append([str(observer), false, str(fault), f"{faulty.deadline.iloc[0]:g} s", noticed, *delays])
    return rows


def fault_table(runs: "pd.DataFrame") -> Table:
    """Lay out :func:`fault_rows` for the console."""
    table = Table(Column("observer", overflow="fold"), *HEADER)
    for row in fault_rows(runs):
        table.add_row(*row)
    return table
