"""Tables and the figure, from the benchmark's two CSV files and nothing else."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import bootstrap

# Component-wise SMAPE in % after the first 20 %, without noise, starts in 1.5X \ X: printed by the notebooks that
# the paper's authors released.
PRINTED = {
    "spinn": {"reverse_duffing": 1.96, "van_der_pol": 0.35, "rossler": 4.77, "lorenz": 8.64},
    "ae": {"reverse_duffing": 55.4, "van_der_pol": 200.0, "rossler": 79.9, "lorenz": 88.1},
    "dmf": {"reverse_duffing": 46.2, "van_der_pol": 98.2, "rossler": 23.5, "lorenz": 8.76},
    "node": {"reverse_duffing": 159.8, "van_der_pol": 11.9, "rossler": 24.7, "lorenz": 11.0},
}
DOMAINS = {"X": "starts in X", "1.5X": "starts in 1.5X \\ X", "2X": "starts in 2X \\ X"}


def summarise(results: pd.DataFrame, column: str) -> pd.DataFrame:
    """Median, half the interquartile range and a bootstrap 95 % interval of the median, for each cell.

    Cells are system, method, starts and noise; trajectories that escaped are not among the values.
    """
    rows = []
    for key, group in results[results.escaped == 0].groupby(["system", "method", "starts", "noise"], sort=False):
        values = group[column].to_numpy(dtype=float)
        finite = np.minimum(values, 1e12)  # an infinite settling time is a large one
        low, median, high = np.quantile(finite, [0.25, 0.5, 0.75])
        interval = (median, median)
        if len(set(finite)) > 1:
            found = bootstrap((finite,), np.median, method="percentile", n_resamples=1000, rng=np.random.default_rng(0))
            interval = found.confidence_interval
        rows.append((*key, len(values), median, (high - low) / 2, *interval))
    names = ["system", "method", "starts", "noise", "n", "median", "half_iqr", "low", "high"]
    return pd.DataFrame(rows, columns=names)


def write_table(path: Path, results: pd.DataFrame, methods: pd.DataFrame, note: str) -> None:
    """All measures as Markdown."""
    labels = _labels(methods)
    systems = list(dict.fromkeys(methods.system))
    lines = ["# Benchmark", "", note, ""]

    def table(title: str, cell: Any, explain: str = "") -> None:
        lines.extend([f"## {title}", ""] + ([explain, ""] if explain else []))
        lines.append("| | " + " | ".join(system.replace("_", " ") for system in systems) + " |")
        lines.append("|---" * (1 + len(systems)) + "|")
        for name, label in labels.items():
            lines.append(f"| {label} | " + " | ".join(cell(system, name) for system in systems) + " |")
        lines.append("")

    summaries = {column: summarise(results, column) for column in ("smape", "smape_late", "settling", "rmse_late")}

    def measure(column: str, form: str, starts: str, noise: float) -> Any:
        summary = summaries[column]
        chosen = summary[(summary.starts == starts) & (summary.noise == noise)].set_index(["system", "method"])

        def cell(system: str, name: str) -> str:
            if (system, name) not in chosen.index:
                return "–"
            row = chosen.loc[(system, name)]
            return "never" if row["median"] >= 1e12 else form.format(**row)

        return cell

    spread = "{median:.3g} ± {half_iqr:.2g} [{low:.3g}, {high:.3g}]"
    cases = results[["starts", "noise"]].drop_duplicates().itertuples(index=False)
    cases = sorted(cases, key=lambda case: (list(DOMAINS).index(case.starts), case.noise))
    for case in cases:
        title = f"SMAPE in %, all steps, {DOMAINS[case.starts]}, noise {case.noise:g}"
        explain = "Median ± half the interquartile range [bootstrap 95 % interval of the median]."
        table(title, measure("smape", spread, case.starts, case.noise), explain)
    for case in cases:
        title = f"SMAPE in % after the first 20 %, {DOMAINS[case.starts]}, noise {case.noise:g}"
        table(title, measure("smape_late", spread, case.starts, case.noise))
    for case in cases:
        title = f"Settling time in s, {DOMAINS[case.starts]}, noise {case.noise:g}"
        explain = "Median time from which the error stays below a tenth of the trajectory's size."
        table(title, measure("settling", "{median:.2f}", case.starts, case.noise), explain)
    for case in cases:
        title = f"RMSE after the first 20 %, {DOMAINS[case.starts]}, noise {case.noise:g}"
        table(title, measure("rmse_late", "{median:.3g} ± {half_iqr:.2g}", case.starts, case.noise))

    lost = results[results.escaped == 0].groupby(["system", "method", "starts", "noise"]).lost.mean() * 100

    def lost_cell(system: str, name: str) -> str:
        shares = [lost.get((system, name, case.starts, case.noise)) for case in cases]
        return "–" if shares[0] is None else " / ".join(f"{share:.0f}" for share in shares)

    order = ", ".join(f"{case.starts} at noise {case.noise:g}" for case in cases)
    table("Lost trajectories in %", lost_cell, f"Above 50 % after the first 20 %, or not finite. In order: {order}.")

    component = summarise(results, "component_late")
    component = component[component.noise == 0].set_index(["system", "method", "starts"])["median"]

    def beside(system: str, name: str) -> str:
        found = [component.get((system, name, starts)) for starts in DOMAINS]
        ours = " / ".join("–" if value is None else f"{value:.3g}" for value in found)
        printed = PRINTED.get(name, {}).get(system)
        return ours if printed is None else f"{ours} ({printed:g})"

    table(
        "Component-wise SMAPE in % after the first 20 %, no noise",
        beside,
        "Median for starts in X / 1.5X \\ X / 2X \\ X. In brackets what the notebooks released with the paper print "
        "for 1.5X \\ X, from other networks, budgets and data.",
    )

    costs = methods.set_index(["system", "method"])

    def cost(system: str, name: str) -> str:
        if (system, name) not in costs.index:
            return "–"
        row = costs.loc[(system, name)]
        return f"{row.train_seconds:.0f} s; {row.us_batch_1:.0f}, {row.us_batch_1000:.0f} µs"

    table("Cost", cost, "CPU seconds of training; CPU time of one step for one trajectory, and for a batch of 1,000.")
    table(
        "Configuration chosen on validation",
        lambda system, name: (
            str(costs.loc[(system, name)].configuration).strip("{}").replace('"', "") or "only one"
            if (system, name) in costs.index
            else "–"
        ),
    )
    escaped = results[results.escaped == 1].drop_duplicates(["system", "starts", "trajectory"])
    counts = escaped.groupby(["system", "starts"], sort=False).size()
    lines.append("## Starts that escape")
    lines.append("")
    total = results.groupby(["system", "starts"]).trajectory.nunique()
    lines += [
        f"- {system}, {starts}: {n} of {total[(system, starts)]}, in no figure above."
        for (system, starts), n in counts.items()
    ]
    if counts.empty:
        lines.append("None.")
    path.write_text("\n".join(lines) + "\n")


def draw(path: Path, results: pd.DataFrame, methods: pd.DataFrame, note: str) -> None:
    """The paper's heatmap: median ± half the interquartile range of the SMAPE over all steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm

    labels, systems = _labels(methods), list(dict.fromkeys(methods.system))
    summary = summarise(results, "smape").set_index(["system", "method", "starts", "noise"])
    domains = [domain for domain in DOMAINS if domain in set(results.starts)]
    levels = sorted(set(results.noise))
    size = (2.2 + (0.8 + 0.95 * len(systems)) * len(domains), 1.0 + (0.6 + 0.36 * len(labels)) * len(levels))
    figure, axes = plt.subplots(
        len(levels), len(domains), figsize=size, squeeze=False, sharex=True, sharey=True, layout="constrained"
    )
    image: Any = None
    for row, noise in zip(axes, levels, strict=True):
        for ax, domain in zip(row, domains, strict=True):
            values = np.full((len(labels), len(systems)), np.nan)
            for i, name in enumerate(labels):
                for j, system in enumerate(systems):
                    key = (system, name, domain, noise)
                    if key not in summary.index:
                        continue
                    cell = summary.loc[key]
                    values[i, j] = cell["median"]
                    light = 0.5 < cell["median"] < 80.0
                    ax.text(
                        j,
                        i,
                        f"{_short(cell['median'])}\n± {_short(cell['half_iqr'])}",
                        ha="center",
                        va="center",
                        fontsize=6.5,
                        color="black" if light else "white",
                    )
            image = ax.imshow(values, cmap="RdYlBu_r", norm=LogNorm(0.1, 200, clip=True), aspect="auto")
            ax.set_xticks(range(len(systems)), [system.replace("_", "\n") for system in systems], fontsize=7)
            ax.set_yticks(range(len(labels)), list(labels.values()), fontsize=8)
            ax.set_title(f"{DOMAINS[domain]}, noise {noise:g}", fontsize=9)
            ax.tick_params(length=0)
    figure.colorbar(image, ax=axes, label="SMAPE in %, all steps", shrink=0.6)
    figure.suptitle(note, fontsize=9)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _labels(methods: pd.DataFrame) -> dict[str, str]:
    return dict(zip(methods.method, methods.label, strict=True))


def _short(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.0f}"
