"""Make the benchmark's tables and figure from its two CSV files alone."""

import json
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from training.evaluation.levels import read_level, show_level
from training.figures import drawing
from training.files import table, write

SPREAD = "Median ± half the interquartile range, as in the paper [bootstrap 95 % interval of the median]."
# Columns of results.csv, and their titles.
MEASURES = (("smape", "SMAPE in %, all steps"), ("smape_late", "SMAPE in % after the first 20 %"))
NRMSE = re.compile(r"nrmse\d+")  # columns of results.csv, one for each state
NEVER = 1e12  # replaces infinite errors, so that quantiles exist
NARROWEST = 7.0  # least width in inches of a figure with its title
DOMAINS = {"X": "starts in X", "1.5X": "starts in 1.5X \\ X", "2X": "starts in 2X \\ X"}

# Component-wise SMAPE in % that the notebooks released with the paper print for 1.5X \ X, by system and method.
PRINTED = {
    "reverse_duffing": {"spinn": 1.96, "ae": 55.4, "dmf": 46.2, "node": 159.8},
    "van_der_pol": {"spinn": 0.35, "ae": 200.0, "dmf": 98.2, "node": 11.9},
    "rossler": {"spinn": 4.77, "ae": 79.9, "dmf": 23.5, "node": 24.7},
    "lorenz": {"spinn": 8.64, "ae": 88.1, "dmf": 8.76, "node": 11.0},
}


def summarise(results: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return median, half the interquartile range and the median's bootstrap 95 % interval for each table cell."""
    from scipy.stats import bootstrap  # imported here, because it takes half a second

    rows = []
    for key, group in results[results.escaped == 0].groupby(["system", "method", "starts", "noise"], sort=False):
        values = group[column].to_numpy(dtype=float)
        finite = np.minimum(values, NEVER)
        low, median, high = np.quantile(finite, [0.25, 0.5, 0.75])
        interval = (median, median)
        if len(set(finite)) > 1:
            rng = np.random.default_rng(0)
            drawn = bootstrap((finite,), np.median, method="percentile", n_resamples=1000, rng=rng)
            interval = drawn.confidence_interval
        rows.append((*key, len(values), median, (high - low) / 2, *interval))
    names = ["system", "method", "starts", "noise", "n", "median", "half_iqr", "low", "high"]
    return pd.DataFrame(rows, columns=names)


def write_table(path: Path, results: pd.DataFrame, methods: pd.DataFrame, *, note: str) -> None:
    """Write all measures as Markdown: a table for each measure and case, with a row for each method."""
    results = _by_text_of_noise(results)
    cases = sorted(
        results[["starts", "noise"]].drop_duplicates().itertuples(index=False, name=None),
        key=lambda case: (list(DOMAINS).index(case[0]), _size(case[1])),
    )
    lines = ["# Benchmark", "", note, ""]
    for column, title in MEASURES:
        summary = summarise(results, column).set_index(["starts", "noise", "system", "method"])
        for case in cases:
            lines += [f"## {title}, {DOMAINS[case[0]]}, noise {case[1]}", "", SPREAD, ""]
            lines += _by_method(methods, partial(_spread, summary, case))
    states = [column for column in results if NRMSE.fullmatch(column)]  # the benchmark's published CSV has none
    if states:
        medians = results[results.escaped == 0].groupby(["starts", "noise", "system", "method"])[states].median()
        for case in cases:
            lines += [f"## NRMSE in % after the first 20 %, {DOMAINS[case[0]]}, noise {case[1]}", ""]
            lines += ["Median of each state's rms error, in % of its standard deviation in all trajectories.", ""]
            lines += _by_method(methods, partial(_each_state, medians, case))
    order = ", ".join(f"{DOMAINS[starts]} at noise {noise}" for starts, noise in cases)
    lines += [
        "## Lost trajectories in %",
        "",
        f"SMAPE above 50 % after the first 20 %, or estimates not finite. In this order: {order}.",
    ]
    lost = results[results.escaped == 0].groupby(["system", "method", "starts", "noise"]).lost.mean() * 100
    lines += ["", *_by_method(methods, partial(_lost, lost, cases))]
    noise_free = results[results.noise == "0"]
    if len(noise_free):
        component = summarise(noise_free, "component_late").set_index(["system", "method", "starts"])
        rows = _by_method(methods, partial(_beside_printed, component["median"]))
        text = "Mean over components, median over trajectories, for starts in X / 1.5X \\ X / 2X \\ X."
        if any(name in PRINTED.get(system, {}) for system, name in zip(methods.system, methods.method, strict=True)):
            text += (
                " In brackets the figures that the notebooks released with the paper print for 1.5X \\ X, from other "
                "networks, budgets and data; docs/results/benchmark.md has more."
            )
        lines += ["## Component-wise SMAPE in % after the first 20 %, no noise", "", text, "", *rows]
    costs = methods.set_index(["system", "method"])
    lines += ["## Cost", "", "CPU seconds of training; CPU time of a step of one trajectory and of 1,000 at once.", ""]
    lines += _by_method(methods, partial(_cost, costs))
    compared = "The best configuration on validation runs; only one where a method has no other."
    chosen = "The first configuration; none were compared." if (methods.budget == "quick").all() else compared
    lines += ["## Configuration", "", chosen, ""]
    lines += _by_method(methods, partial(_configuration, costs))
    write(path, "\n".join(lines) + "\n")


def _by_method(methods: pd.DataFrame, cell: Callable[[tuple[str, str]], str]) -> list[str]:
    """Return lines of a Markdown table with a cell for each (system, method)."""
    systems = list(dict.fromkeys(methods.system))
    there = set(zip(methods.system, methods.method, strict=True))
    rows = [
        [label, *(cell((system, name)) if (system, name) in there else "–" for system in systems)]
        for name, label in _labels(methods).items()
    ]
    return [*table(["", *(system.replace("_", " ") for system in systems)], rows), ""]


def _by_text_of_noise(results: pd.DataFrame) -> pd.DataFrame:
    """Return the frame with noise levels as text; a level is one number, or one for each output."""
    texts = {noise: show_level(read_level(str(noise))) for noise in results.noise.unique()}
    return results.assign(noise=results.noise.map(texts))


def _size(noise: str) -> list[float]:
    """Return the sort key of a noise level."""
    return np.atleast_1d(read_level(noise)).tolist()


def _each_state(medians: pd.DataFrame, case: tuple[str, str], job: tuple[str, str]) -> str:
    """Return the cell with a number for each of the system's states, or a dash for a constant state."""
    if (*case, *job) not in medians.index:
        return "–"
    row = medians.loc[(*case, *job)].to_numpy()
    known = np.flatnonzero(~np.isnan(row))
    return " / ".join("–" if np.isnan(value) else _number(value) for value in row[: known.max(initial=0) + 1])


def _spread(summary: pd.DataFrame, case: tuple[str, str], job: tuple[str, str]) -> str:
    if (*case, *job) not in summary.index:  # every trajectory left the bounds
        return "–"
    row = summary.loc[(*case, *job)].map(_number)
    return f"{row['median']} ± {row.half_iqr} [{row.low}, {row.high}]"


def _number(value: float) -> str:
    """Return a number with three significant digits as text."""
    if value >= NEVER / 4:
        return "∞"
    return f"{value:.3g}" if value >= 0.001 or value == 0 else "<0.001"


def _lost(lost: pd.Series, cases: Sequence[tuple[str, str]], job: tuple[str, str]) -> str:
    return " / ".join(f"{lost[(*job, *case)]:.0f}" if (*job, *case) in lost.index else "–" for case in cases)


def _beside_printed(component: pd.Series, job: tuple[str, str]) -> str:
    ours = " / ".join(_number(component[(*job, starts)]) for starts in DOMAINS if (*job, starts) in component.index)
    system, method = job
    printed = PRINTED.get(system, {}).get(method)
    return ours if printed is None else f"{ours} ({printed:g})"


def _cost(costs: pd.DataFrame, job: tuple[str, str]) -> str:
    row = costs.loc[job]
    times = ", ".join("–" if np.isnan(us) else f"{us:.0f} µs" for us in (row.us_batch_1, row.us_batch_1000))
    return f"{row.train_seconds:.0f} s; {times}"


def _configuration(costs: pd.DataFrame, job: tuple[str, str]) -> str:
    configuration = json.loads(costs.loc[job].configuration)
    return ", ".join(f"{key} {value}" for key, value in configuration.items()).replace("_", " ") or "only one"


def draw(path: Path, results: pd.DataFrame, methods: pd.DataFrame, *, note: str) -> None:
    """Draw the paper's heatmap: median ± half the interquartile range of the SMAPE over all steps."""
    from matplotlib.colors import LogNorm

    results = _by_text_of_noise(results)
    labels, systems = _labels(methods), list(dict.fromkeys(methods.system))
    summary = summarise(results, "smape").set_index(["system", "method", "starts", "noise"])
    domains = [domain for domain in DOMAINS if domain in set(results.starts)]
    levels = sorted(set(results.noise), key=_size)
    width = max(NARROWEST, 2.4 + 0.9 * len(systems) * len(levels))
    height = 1.4 + (0.3 + 0.24 * len(labels)) * len(domains)
    image: Any = None
    with drawing(path, width, height) as figure:
        axes: Any = figure.subplots(len(domains), len(levels), squeeze=False, sharex=True, sharey=True)
        for row, domain in zip(axes, domains, strict=True):
            for ax, noise in zip(row, levels, strict=True):
                values = np.full((len(labels), len(systems)), np.nan)
                for i, name in enumerate(labels):
                    for j, system in enumerate(systems):
                        key = (system, name, domain, noise)
                        if key in summary.index:
                            values[i, j] = summary.loc[key]["median"]
                            _write_cell(ax, (j, i), values[i, j], summary.loc[key]["half_iqr"])
                image = ax.imshow(values, cmap="RdYlBu_r", norm=LogNorm(0.1, 200, clip=True), aspect="auto")
                ax.set_xticks(range(len(systems)), [system.replace("_", "\n") for system in systems], fontsize=8)
                ax.set_yticks(range(len(labels)), list(labels.values()), fontsize=8)
                ax.set_title(f"{DOMAINS[domain]}, noise {noise}", fontsize=9)
                ax.tick_params(length=0)
                ax.grid(visible=False)
        figure.colorbar(image, ax=axes, label="SMAPE in %, all steps", location="bottom", aspect=60, pad=0.01)
        figure.suptitle(note, fontsize=9)


def _write_cell(ax: Any, at: tuple[int, int], median: float, half_iqr: float) -> None:
    light = 0.5 < median < 80.0
    text = f"{_short(median)} ± {_short(half_iqr)}"
    ax.text(*at, text, ha="center", va="center", fontsize=7.5, color="black" if light else "white")


def _labels(methods: pd.DataFrame) -> dict[str, str]:
    """Return labels by method; a label includes the number of trajectories if it is below the largest."""
    most = methods.trajectories.max()
    return {
        row.method: row.label if row.trajectories == most else f"{row.label} ({row.trajectories} runs)"
        for row in methods.itertuples()
    }


def _short(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.0f}"
