"""Figures on pages are those of the files in docs/results."""

from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "docs" / "results"
SYSTEMS = ("reverse_duffing", "van_der_pol", "rossler", "lorenz")


def text(value):
    """Three digits, and never more than two behind the point, as the tables have them."""
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


def test_the_readmes_table_is_the_benchmarks():
    found = pd.read_csv(RESULTS / "benchmark" / "results.csv")
    medians = found[found.starts == "X"].groupby(["system", "method", "noise"]).smape.median()
    rows = {
        "the default maps": "shipped",
        "the same without [tracking](docs/guides/tracking.md)": "shipped-static",
        "extended Kalman filter, tuned": "ekf",
        "unscented Kalman filter, tuned": "ukf",
        "parameters 10 % wrong: without tracking": "default-wrong",
        "parameters 10 % wrong: extended Kalman filter": "ekf-wrong",
    }
    readme = (ROOT / "README.md").read_text()
    for label, method in rows.items():
        cells = [" / ".join(text(medians[system, method, noise]) for noise in (0.0, 0.5)) for system in SYSTEMS]
        assert f"| {label} | {' | '.join(cells)} |" in readme


CONDITIONS = [
    ("no noise, all steps", "accuracy", "smape", ("X", False, 0.0)),
    ("noise 0.5, all steps", "accuracy", "smape", ("X", False, 0.5)),
    ("no noise, after 20 %", "accuracy", "smape_late", ("X", False, 0.0)),
    ("noise 0.5, after 20 %", "accuracy", "smape_late", ("X", False, 0.5)),
    ("no noise but w, after 20 %", "process-noise", "smape_late", ("X", False, 0.0)),
    ("noise 0.5 and w, after 20 %", "process-noise", "smape_late", ("X", False, 0.5)),
    ("driven, no noise, after 5 s", "accuracy", "smape_late", ("X", True, 0.0)),
    ("driven, noise 0.5, after 5 s", "accuracy", "smape_late", ("X", True, 0.5)),
    ("starts in 2X \\ X, no noise, all steps", "accuracy", "smape", ("2X \\ X", False, 0.0)),
    ("starts in 2X \\ X, noise 0.5, all steps", "accuracy", "smape", ("2X \\ X", False, 0.5)),
    ("plant 10 % off, no noise, all steps", "plant-error", "smape", ("X", False, 0.0)),
    ("plant 10 % off, noise 0.5, all steps", "plant-error", "smape", ("X", False, 0.5)),
]
OF_STATIC = {"accuracy": "accuracy", "process-noise": "accuracy-process-noise", "plant-error": "plant-error"}
OF_SPINN = [
    row for row in CONDITIONS if row[1] == "accuracy" and "driven" not in row[0] and row[3] != ("X", False, 0.5)
]


@pytest.mark.parametrize(
    ("title", "file", "suffix", "column", "chosen"),
    [
        *((f"default, {title}", f"tracking/{file}", "", *of) for title, file, *of in CONDITIONS),
        *((f"T_inv alone, {title}", OF_STATIC[file], "-static", *of) for title, file, *of in CONDITIONS),
        *((f"SPINN, {title}", file, "-spinn", *of) for title, file, *of in OF_SPINN),
        ("SPINN, noise 0.5, all steps", "accuracy", "-spinn", "smape", ("X", False, 0.5)),
    ],
)
def test_the_page_on_accuracy(title, file, suffix, column, chosen):
    found = pd.read_csv(RESULTS / f"{file}.csv")
    medians = found.groupby(["starts", "driven", "measurement_noise", "observer"])[column].median()
    page = (RESULTS / "accuracy.md").read_text()
    assert f"| {title} | {' | '.join(text(medians[(*chosen, system + suffix)]) for system in SYSTEMS)} |" in page


def test_the_page_on_agents_has_the_commands_table():
    page = (RESULTS / "agents.md").read_text()
    rows = [line for line in (RESULTS / "agents" / "table.md").read_text().splitlines() if line.startswith("|")]
    assert len(rows) == 11
    assert all(row in page for row in rows)


@pytest.mark.parametrize(
    ("title", "observer", "starts", "driven", "span"),
    [
        (f"{label}, starts in {starts}{', driven' if driven else ''}, {span}", who, starts, driven, span)
        for label, who, starts, driven in [
            ("observer", "KKL", "X", False),
            ("observer", "KKL", "X", True),
            ("observer", "KKL", "2X \\ X", False),
            ("EKF", "EKF", "X", False),
        ]
        for span in ("first 2 s", "after 5 s")
    ],
)
def test_the_page_on_error_bars(title, observer, starts, driven, span):
    cells = []
    for system in SYSTEMS:
        found = pd.read_csv(RESULTS / "error_bars" / f"{system}-static.csv").set_index(
            ["observer", "starts", "driven", "span"]
        )
        shares = found.loc[[(observer, starts, driven, span)], "90"]
        assert len(shares) == 6
        cells.append(f"{shares.min():.1f} to {shares.max():.1f}")
    assert f"| {title} | {' | '.join(cells)} |" in (RESULTS / "error_bars.md").read_text()
    if (observer, starts, driven, span) == ("KKL", "X", False, "after 5 s"):
        guide = (ROOT / "docs" / "guides" / "error_bars.md").read_text()
        assert f"| starts in X, all levels of noise, T_inv alone | {' | '.join(cells)} |" in guide


def calibration(system, starts, driven, span, suffix=""):
    """Rows of the default map's calibration by level of noise."""
    found = pd.read_csv(RESULTS / "tracking" / f"{system}{suffix}.csv").set_index(["starts", "driven", "span"])
    return found.loc[[(starts, driven, span)]]


@pytest.mark.parametrize("span", ["first 2 s", "after 5 s"])
@pytest.mark.parametrize(("starts", "driven"), [("X", False), ("X", True), ("2X \\ X", False)])
def test_the_page_on_tracking_has_the_coverage(starts, driven, span):
    page = (RESULTS / "tracking.md").read_text()
    cells = [calibration(system, starts, driven, span)["90"] for system in SYSTEMS]
    shown = " | ".join(f"{each.min():.1f} to {each.max():.1f}" for each in cells)
    title = f"starts in {starts}{', driven' if driven else ''}, {span}"
    assert f"| {title} | {shown} |" in page
    if starts == "X":  # with noise, of four times as many runs
        rows = [calibration(system, starts, driven, span, "-400") for system in SYSTEMS]
        cells = [each[each.measurement_noise > 0]["90"] for each in rows]
        shown = " | ".join(f"{each.min():.1f} to {each.max():.1f}" for each in cells)
        assert f"| {title}, 400 runs with noise | {shown} |" in page


@pytest.mark.parametrize(
    ("title", "suffix"), [("NEES within its limits after 5 s, with noise", ""), ("the same of 400 runs", "-400")]
)
def test_the_page_on_tracking_has_the_nees(title, suffix):
    cells = []
    for system in SYSTEMS:
        rows = pd.concat([calibration(system, "X", driven, "after 5 s", suffix) for driven in (False, True)])
        rows = rows[rows.measurement_noise > 0]
        cells.append(f"{rows.nees.between(rows.nees_low, rows.nees_high).sum()} of {len(rows)}")
    assert f"| {title} | {' | '.join(cells)} |" in (RESULTS / "tracking.md").read_text()


def test_the_page_on_accuracy_says_what_noise_does():
    found = pd.read_csv(RESULTS / "tracking" / "accuracy.csv")
    found = found[(found.starts == "X") & ~found.driven & found.observer.isin(SYSTEMS)]
    medians = found.groupby(["measurement_noise", "observer"]).smape.median()
    growth = medians[1.0] / medians[0.1]
    page = (RESULTS / "accuracy.md").read_text()
    assert f"the errors of the default maps {growth.min():.1f} to {growth.max():.1f} times as large" in page
    found = pd.read_csv(RESULTS / "benchmark" / "results.csv")
    medians = found[(found.starts == "X") & (found.noise == 0.5)].groupby(["method", "system"]).smape.median()
    of_ekf, of_ukf = (medians["shipped"] / medians[name] for name in ("ekf", "ukf"))
    assert (
        f"At noise 0.5 they leave {of_ekf.min():.1f} to {of_ekf.max():.1f} times the error of the tuned EKF on the "
        f"benchmark's runs, and {of_ukf.min():.1f} to {of_ukf.max():.1f} times that of the UKF."
    ) in " ".join(page.split())


def test_the_readme_says_how_the_default_maps_stand_beside_tuned_kalman_filters():
    shares = []
    for file in ("results", "noise-0.1"):
        found = pd.read_csv(RESULTS / "benchmark" / f"{file}.csv")
        medians = found[(found.starts == "X") & (found.noise > 0)].groupby(["method", "system"]).smape.median()
        shares.append(medians["shipped"] / medians["ekf"])
    shares = pd.concat(shares)
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert f"Under noise their errors are {shares.min():.1f} to {shares.max():.1f} times those of tuned" in readme


@pytest.mark.parametrize(
    ("title", "column", "chosen"),
    [
        ("no noise, all steps", "smape", ("X", False, 0.0)),
        ("noise 0.5, all steps", "smape", ("X", False, 0.5)),
        ("driven, noise 0.5, after 5 s", "smape_late", ("X", True, 0.5)),
    ],
)
def test_the_guide_to_speed_has_small_maps_beside_the_default(title, column, chosen):
    page = (ROOT / "docs" / "guides" / "speed.md").read_text()
    for label, suffix, file in (("default", "", "tracking/accuracy"), ("small", "-small", "accuracy-small")):
        found = pd.read_csv(RESULTS / f"{file}.csv")
        medians = found.groupby(["starts", "driven", "measurement_noise", "observer"])[column].median()
        assert f"| {label}, {title} | {' | '.join(text(medians[(*chosen, s + suffix)]) for s in SYSTEMS)} |" in page


def test_the_guide_to_speed_has_the_errors_and_times_of_each_width():
    found, page = pd.read_csv(RESULTS / "sizes" / "lorenz.csv"), (ROOT / "docs" / "guides" / "speed.md").read_text()
    for title, column, digits in (
        ("width of the hidden layers", "width", 0),
        ("Lorenz, median SMAPE in %, no noise", "smape_without_noise", 2),
        ("Lorenz, median SMAPE in %, noise 0.5", "smape_under_noise", 2),
        ("Lorenz, µs a sample, single", "us_single", 1),
        ("Lorenz, µs a sample, each of 1,024 rows", "us_a_row", 2),
    ):
        assert f"| {title} | {' | '.join(f'{value:.{digits}f}' for value in found[column])} |" in page
