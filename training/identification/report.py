"""The figure of an identified system."""

from pathlib import Path
from typing import Any

import numpy as np

from training.figures import ESTIMATE, MEASURED, TRUTH, drawing
from training.identification.identify import Identified

LAGS = 40  # largest lag in samples
SHOWN = 3  # largest number of held-out records in the figure


def autocorrelation(residuals: np.ndarray, lags: int) -> np.ndarray:
    """Return the autocorrelation of residuals (steps + 1, n) at lags from 1 to at most ``lags``."""
    r = residuals - np.nanmean(residuals)
    products = [np.nanmean(r[lag:] * r[:-lag]) for lag in range(1, min(lags, len(r) - 1) + 1)]
    return np.array(products) / max(np.nanmean(r**2), 1e-300)


def write_report(path: Path, found: Identified) -> None:
    """Draw the autocorrelation of residuals, and predictions of held-out records."""
    shown = found.predictions[:SHOWN]
    with drawing(path, 12, 3.2 + 2.2 * len(shown)) as figure:
        first, *others = figure.subplots(1 + len(shown), squeeze=False)[:, 0]
        _draw_residuals(first, found)
        for ax, prediction in zip(others, shown, strict=True):
            record = prediction.record
            t = record.t[: len(prediction.y)]
            for j, name in enumerate(record.signals.measured):
                ax.plot(t, record.y[: len(t), j], ".", ms=2, color=MEASURED, label=f"{name}, measured")
                ax.plot(t, prediction.y[:, j], color=ESTIMATE, label="predicted")
            ax.axvline(t[prediction.fitted], color=TRUTH, lw=0.8, ls=":")
            ax.set(xlabel="t in s", title=f"{record.name}, held out; start fitted to the samples before the line")
            ax.legend(loc="upper right")


def _draw_residuals(ax: Any, found: Identified) -> None:
    """Draw the autocorrelation of the residuals in the fit's windows, and the 95 % band of white residuals."""
    fit = found.fit
    for j, noise in enumerate(fit.noise):
        values = autocorrelation(fit.residuals[:, fit.used, j], LAGS)
        ax.plot(range(1, len(values) + 1), values, ".-", label=f"output {j + 1}, residuals' deviation {noise:.3g}")
    limit = 1.96 / np.sqrt(max(np.isfinite(fit.residuals[:, fit.used, 0]).sum(), 1))
    ax.axhspan(-limit, limit, color=MEASURED, alpha=0.3, lw=0, zorder=0)
    ax.set(xlabel="lag in samples", ylabel="autocorrelation", title=f"{found.system.name}, residuals of the fit")
    ax.legend()
