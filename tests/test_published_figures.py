"""Numbers on the pages are those of the files in docs/results."""

from functools import cache
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "docs" / "results"
ACCURACY = "docs/results/accuracy.md"
SYSTEMS = ("reverse_duffing", "van_der_pol", "rossler", "lorenz")


@cache
def page(name):
    return (ROOT / name).read_text()


@cache
def results(name):
    return pd.read_csv(RESULTS / f"{name}.csv")


def row(title, cells):
    return f"| {title} | {' | '.join(cells)} |"


def text(value):
    """Format a number as in the tables: three digits, at most two decimals."""
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


def from_to(shares, digits=1):
    return f"{shares.min():.{digits}f} to {shares.max():.{digits}f}"


def of_evaluation(file, kind, column, starts, driven, noise):
    """Median of a column by system, over the runs of a condition; rows without a system belong to the one above."""
    rows = results(file)
    systems = rows.observer.str.extract(f"^({'|'.join(SYSTEMS)})")[0].ffill()
    rows = rows[(rows.starts == starts) & (rows.driven == driven) & (rows.measurement_noise == noise)]
    found = []
    for system in SYSTEMS:
        own = rows[systems[rows.index] == system]
        own = own[own.observer.str.endswith(kind) if kind else own.observer == system]
        found.append(text(own[column].median()))
    return found


def of_benchmark():
    """Median SMAPE for starts in X, by system, method and noise level."""
    rows = results("benchmark/results")
    return rows[rows.starts == "X"].groupby(["system", "method", "noise"]).smape.median()


ALONE = {"accuracy": "accuracy", "process-noise": "accuracy-process-noise", "plant-error": "plant-error"}
CONDITIONS = [
    ("no noise", "accuracy", "smape", ("X", False, 0.0)),
    ("noise 0.1", "accuracy", "smape", ("X", False, 0.1)),
    ("noise 0.5", "accuracy", "smape", ("X", False, 0.5)),
    ("noise 1", "accuracy", "smape", ("X", False, 1.0)),
    ("no noise, after 20 %", "accuracy", "smape_late", ("X", False, 0.0)),
    ("noise 0.5, after 20 %", "accuracy", "smape_late", ("X", False, 0.5)),
    ("driven, no noise", "accuracy", "smape", ("X", True, 0.0)),
    ("driven, noise 0.5", "accuracy", "smape", ("X", True, 0.5)),
    ("starts in 2X \\ X, no noise", "accuracy", "smape", ("2X \\ X", False, 0.0)),
    ("starts in 2X \\ X, noise 0.5", "accuracy", "smape", ("2X \\ X", False, 0.5)),
    ("process noise, no noise on y", "process-noise", "smape", ("X", False, 0.0)),
    ("process noise, noise 0.5", "process-noise", "smape", ("X", False, 0.5)),
    ("plant 10 % off, no noise", "plant-error", "smape", ("X", False, 0.0)),
    ("plant 10 % off, noise 0.5", "plant-error", "smape", ("X", False, 0.5)),
]


def of_all(kind, column, condition):
    """Cells: default observer / T_inv alone / Kalman filter, which only the accuracy runs have."""
    columns = [
        of_evaluation(f"tracking/{kind}", "", column, *condition),
        of_evaluation(ALONE[kind], "T_inv alone", column, *condition),
        of_evaluation("tracking/accuracy", "EKF", column, *condition) if kind == "accuracy" else ["–"] * 4,
    ]
    return list(map(" / ".join, zip(*columns, strict=True)))


@pytest.mark.parametrize(("title", "kind", "column", "condition"), CONDITIONS)
def test_errors_of_the_observers_that_ship(title, kind, column, condition):
    assert row(title, of_all(kind, column, condition)) in page(ACCURACY)


@pytest.mark.parametrize(("title", "column"), [("all steps", "smape"), ("after 20 %", "smape_late")])
def test_the_limit_under_noise(title, column):
    levels = [of_evaluation("tracking/accuracy", "limit", column, "X", False, noise) for noise in (0.1, 0.5, 1.0)]
    cells = list(map(" / ".join, zip(*levels, strict=True)))
    assert row(f"limit at noise 0.1 / 0.5 / 1, {title}", cells) in page(ACCURACY)


@pytest.mark.parametrize("starts", ["X", "2X \\ X"])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_errors_of_spinn(starts, noise):
    title = f"SPINN, {'' if starts == 'X' else f'starts in {starts}, '}{f'noise {noise:g}' if noise else 'no noise'}"
    assert row(title, of_evaluation("accuracy", "-spinn", "smape", starts, False, noise)) in page(ACCURACY)


def test_the_readmes_table():
    quiet, noisy = (("X", False, noise) for noise in (0.0, 0.5))
    titles = ("`NAME`, the default", "`NAME-large` with `tracking=False`: T_inv alone")
    cells = [[cell.split(" / ") for cell in of_all("accuracy", "smape", condition)] for condition in (quiet, noisy)]
    for i, title in enumerate(titles):
        pairs = [f"{without[i]} / {under[i]}" for without, under in zip(*cells, strict=True)]
        assert row(title, pairs) in page("README.md")
    medians = of_benchmark()
    pairs = [" / ".join(text(medians[system, "ukf", noise]) for noise in (0.0, 0.5)) for system in SYSTEMS]
    assert row("unscented Kalman filter, tuned, on the benchmark's runs", pairs) in page("README.md")
    limit = [f"– / {cell}" for cell in of_evaluation("tracking/accuracy", "limit", "smape", "X", False, 0.5)]
    assert row("limit that noise sets (posterior Cramér-Rao bound)", limit) in page("README.md")


def test_the_guide_on_noise_levels():
    for title, kind, noise in (
        ("no noise", "accuracy", 0.0),
        ("noise 0.5", "accuracy", 0.5),
        ("noise 0.5 and process noise", "process-noise", 0.5),
    ):
        cells = of_evaluation(f"tracking/{kind}", "", "smape_late", "X", False, noise)
        assert row(title, cells) in page("docs/guides/noise_levels.md")


def test_the_page_on_agents_has_the_commands_table():
    rows = [line for line in page("docs/results/agents/table.md").splitlines() if line.startswith("|")]
    assert len(rows) == 11
    assert all(one in page("docs/results/agents.md") for one in rows)


def calibration(system, starts, driven, span):
    """Rows of the default map's calibration, one for each noise level."""
    rows = results(f"tracking/{system}")
    return rows[(rows.starts == starts) & (rows.driven == driven) & (rows.span == span)]


def test_coverage_and_nees():
    for starts, driven in [("X", False), ("X", True), ("2X \\ X", False)]:
        for span in ("first 2 s", "after 5 s"):
            title = f"starts in {starts}{', driven' if driven else ''}, {span}"
            cells = [from_to(calibration(system, starts, driven, span)["90"]) for system in SYSTEMS]
            assert row(title, cells) in page(ACCURACY)
    cells = []
    for system in SYSTEMS:
        rows = results(f"tracking/{system}")
        rows = rows[(rows.starts == "X") & (rows.measurement_noise > 0)]
        cells.append(f"{rows.nees.between(rows.nees_low, rows.nees_high).sum()} of {len(rows)}")
    assert row("first four rows, five noise levels above 0: NEES within its 95 % limits for 200 runs", cells) in page(
        ACCURACY
    )


def test_the_benchmark_has_the_shipped_observers():
    benchmark, medians = page("docs/results/benchmark.md"), of_benchmark()
    for title, method in (
        ("the same, as shipped (`NAME-large`)", "shipped-large"),
        ("**the default as shipped, which also [tracks](../guides/tracking.md)**", "shipped"),
    ):
        cells = [" / ".join(text(medians[system, method, noise]) for noise in (0.0, 0.5)) for system in SYSTEMS]
        assert row(title, cells) in benchmark


def test_ratios_to_tuned_kalman_filters():
    medians = of_benchmark().unstack("method")
    ratios = {
        (rival, noise): from_to((medians["shipped"] / medians[rival]).xs(noise, level="noise"), 2)
        for rival in ("ekf", "ukf")
        for noise in (0.0, 0.5)
    }
    benchmark, faq = (" ".join(page(name).split()) for name in ("docs/results/benchmark.md", "docs/faq.md"))
    assert (
        f"At noise 0.5 its error is {ratios['ekf', 0.5]} times the tuned EKF's and {ratios['ukf', 0.5]} times the "
        f"tuned UKF's. Without noise it is {ratios['ekf', 0.0]} times the EKF's and {ratios['ukf', 0.0]} times the "
        "UKF's."
    ) in benchmark
    assert (
        f"errors of default observers are {ratios['ekf', 0.5]} times those of tuned extended filters, and "
        f"{ratios['ukf', 0.5]} times those of tuned"
    ) in faq


def test_the_guide_to_speed_has_the_errors_and_times_of_each_width():
    for title, column, digits in (
        ("width of the hidden layers", "width", 0),
        ("Lorenz, median SMAPE in %, no noise", "smape_without_noise", 2),
        ("Lorenz, median SMAPE in %, noise 0.5", "smape_under_noise", 2),
        ("Lorenz, µs a sample, single", "us_single", 1),
        ("Lorenz, µs a sample, each of 1,024 in a batch", "us_a_row", 2),
    ):
        cells = [f"{value:.{digits}f}" for value in results("sizes/lorenz")[column]]
        assert row(title, cells) in page("docs/guides/speed.md")
