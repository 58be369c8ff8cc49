"""Figures on pages are those of the files in docs/results."""

from functools import cache
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "docs" / "results"
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
    """Three digits, and never more than two behind the point, as the tables have them."""
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


def from_to(shares):
    return f"{shares.min():.1f} to {shares.max():.1f}"


def of_evaluation(file, suffix, column, starts, driven, noise):
    """Medians of each system's map over the runs of a condition."""
    rows = results(file)
    rows = rows[(rows.starts == starts) & (rows.driven == driven) & (rows.measurement_noise == noise)]
    medians = rows.groupby("observer")[column].median()
    return [text(medians[system + suffix]) for system in SYSTEMS]


def of_benchmark(file="benchmark/results"):
    """Medians of starts in X, by system, method and level of noise."""
    rows = results(file)
    return rows[rows.starts == "X"].groupby(["system", "method", "noise"]).smape.median()


def test_the_readmes_table_is_the_benchmarks():
    rows = {
        "the default maps": "shipped",
        "the same without [tracking](docs/guides/tracking.md)": "shipped-static",
        "extended Kalman filter, tuned": "ekf",
        "unscented Kalman filter, tuned": "ukf",
        "parameters 10 % wrong: without tracking": "default-wrong",
        "parameters 10 % wrong: extended Kalman filter": "ekf-wrong",
    }
    for label, method in rows.items():
        cells = [" / ".join(text(of_benchmark()[system, method, noise]) for noise in (0.0, 0.5)) for system in SYSTEMS]
        assert row(label, cells) in page("README.md")


CONDITIONS = [
    ("no noise, all steps", "accuracy", "smape", ("X", False, 0.0)),
    ("noise 0.5, all steps", "accuracy", "smape", ("X", False, 0.5)),
    ("no noise, after 20 %", "accuracy", "smape_late", ("X", False, 0.0)),
    ("noise 0.5, after 20 %", "accuracy", "smape_late", ("X", False, 0.5)),
    ("starts in 2X \\ X, no noise, all steps", "accuracy", "smape", ("2X \\ X", False, 0.0)),
    ("starts in 2X \\ X, noise 0.5, all steps", "accuracy", "smape", ("2X \\ X", False, 0.5)),
    ("driven, no noise, after 5 s", "accuracy", "smape_late", ("X", True, 0.0)),
    ("driven, noise 0.5, after 5 s", "accuracy", "smape_late", ("X", True, 0.5)),
    ("no noise but w, after 20 %", "process-noise", "smape_late", ("X", False, 0.0)),
    ("noise 0.5 and w, after 20 %", "process-noise", "smape_late", ("X", False, 0.5)),
    ("plant 10 % off, no noise, all steps", "plant-error", "smape", ("X", False, 0.0)),
    ("plant 10 % off, noise 0.5, all steps", "plant-error", "smape", ("X", False, 0.5)),
]
SPINN = [*CONDITIONS[:3], *CONDITIONS[4:6]]
OF_STATIC = {"accuracy": "accuracy", "process-noise": "accuracy-process-noise", "plant-error": "plant-error"}
ACCURACY = "docs/results/accuracy.md"


@pytest.mark.parametrize(
    ("where", "label", "conditions", "suffix", "file"),
    [
        (ACCURACY, "default", CONDITIONS, "", "tracking/{}".format),
        (ACCURACY, "T_inv alone", CONDITIONS, "-static", OF_STATIC.get),
        (ACCURACY, "SPINN", SPINN, "-spinn", str),
    ],
)
def test_errors_of_what_ships(where, label, conditions, suffix, file):
    for title, kind, column, chosen in conditions:
        assert row(f"{label}, {title}", of_evaluation(file(kind), suffix, column, *chosen)) in page(where)


def test_the_page_on_the_benchmark_has_errors_on_other_plants():
    for title, column, starts, driven in (
        ("starts in X, all steps", "smape", "X", False),
        ("starts in X, after 20 %", "smape_late", "X", False),
        ("starts in 2X \\ X, all steps", "smape", "2X \\ X", False),
        ("starts in X, driven, after 5 s", "smape_late", "X", True),
    ):
        pairs = zip(*(of_evaluation("plant-error", "-static", column, starts, driven, noise) for noise in (0.0, 0.5)))
        assert row(title, map(" / ".join, pairs)) in page("docs/results/benchmark.md")


def test_the_page_on_agents_has_the_commands_table():
    rows = [line for line in page("docs/results/agents/table.md").splitlines() if line.startswith("|")]
    assert len(rows) == 11
    assert all(one in page("docs/results/agents.md") for one in rows)


def test_the_page_on_error_bars():
    for label, observer, starts, driven in [
        ("observer, starts in X", "KKL", "X", False),
        ("observer, starts in X, driven", "KKL", "X", True),
        ("observer, starts in 2X \\ X", "KKL", "2X \\ X", False),
        ("EKF, starts in X", "EKF", "X", False),
    ]:
        for span in ("first 2 s", "after 5 s"):
            cells = []
            for system in SYSTEMS:
                rows = results(f"error_bars/{system}-static").set_index(["observer", "starts", "driven", "span"])
                shares = rows.sort_index().loc[(observer, starts, driven, span), "90"]
                assert len(shares) == 6
                cells.append(from_to(shares))
            assert row(f"{label}, {span}", cells) in page("docs/results/error_bars.md")
            if (label, span) == ("observer, starts in X", "after 5 s"):
                title = "starts in X, all levels of noise, T_inv alone"
                assert row(title, cells) in page("docs/guides/tracking.md")


def calibration(system, starts, driven, span):
    """Rows of the default map's calibration by level of noise."""
    rows = results(f"tracking/{system}")
    return rows[(rows.starts == starts) & (rows.driven == driven) & (rows.span == span)]


def test_the_page_on_tracking_has_coverage_and_nees():
    tracking = page("docs/results/tracking.md")
    for starts, driven in [("X", False), ("X", True), ("2X \\ X", False)]:
        for span in ("first 2 s", "after 5 s"):
            title = f"starts in {starts}{', driven' if driven else ''}, {span}"
            assert row(title, [from_to(calibration(s, starts, driven, span)["90"]) for s in SYSTEMS]) in tracking
            if starts == "X":  # with noise, of four times as many runs
                rows = [calibration(f"{system}-400", starts, driven, span) for system in SYSTEMS]
                cells = [from_to(each[each.measurement_noise > 0]["90"]) for each in rows]
                assert row(f"{title}, 400 runs with noise", cells) in tracking
    for title, suffix in [("NEES within its limits after 5 s, with noise", ""), ("the same of 400 runs", "-400")]:
        cells = []
        for system in SYSTEMS:
            rows = pd.concat([calibration(system + suffix, "X", driven, "after 5 s") for driven in (False, True)])
            rows = rows[rows.measurement_noise > 0]
            cells.append(f"{rows.nees.between(rows.nees_low, rows.nees_high).sum()} of {len(rows)}")
        assert row(title, cells) in tracking


def test_what_is_said_of_noise_and_of_tuned_kalman_filters():
    rows = results("tracking/accuracy")
    rows = rows[(rows.starts == "X") & ~rows.driven & rows.observer.isin(SYSTEMS)]
    medians = rows.groupby(["measurement_noise", "observer"]).smape.median()
    accuracy, readme = (" ".join(page(name).split()) for name in (ACCURACY, "README.md"))
    assert f"the errors of the default maps {from_to(medians[1.0] / medians[0.1])} times as large" in accuracy

    def beside(rival, noises, file="benchmark/results"):
        medians = of_benchmark(file).unstack("method")
        return (medians["shipped"] / medians[rival])[medians.index.get_level_values("noise").isin(noises)]

    assert (
        f"At noise 0.5 they leave {from_to(beside('ekf', [0.5]))} times the error of the tuned EKF on the "
        f"benchmark's runs, and {from_to(beside('ukf', [0.5]))} times that of the UKF."
    ) in accuracy
    under_noise = pd.concat([beside("ekf", [0.5]), beside("ekf", [0.1], "benchmark/noise-0.1")])
    assert f"Under noise their errors are {from_to(under_noise)} times those of tuned" in readme


def test_the_guide_to_speed_has_the_errors_and_times_of_each_width():
    for title, column, digits in (
        ("width of the hidden layers", "width", 0),
        ("Lorenz, median SMAPE in %, no noise", "smape_without_noise", 2),
        ("Lorenz, median SMAPE in %, noise 0.5", "smape_under_noise", 2),
        ("Lorenz, µs a sample, single", "us_single", 1),
        ("Lorenz, µs a sample, each of 1,024 rows", "us_a_row", 2),
    ):
        cells = [f"{value:.{digits}f}" for value in results("sizes/lorenz")[column]]
        assert row(title, cells) in page("docs/guides/speed.md")
