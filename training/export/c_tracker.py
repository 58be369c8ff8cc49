"""A tracking observer's own part in C99: the flow, the Kalman filter on it, and how sure T_inv is.

It is :mod:`observers.tracker` for a single sample. Estimates and covariances are doubles whatever the precision is: P
is what differences leave, and in floats its factor would break down.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from observers.flow import Flow
from observers.network import MLP
from observers.polynomial import table
from observers.spread import LARGEST_LOG, Spread
from observers.supervision import INFLATION, Supervision
from training.export import c_templates, c_tracker_templates
from training.export.c_map import SQUARE, map_functions, measurement_levels, process_level
from training.export.c_text import array, block, network_arrays, network_words, number
from training.export.exported import Exported

_LARGER = "#define LARGER(a, b) ((a) > (b) ? (a) : (b))\n"


def tracker_networks(exported: Exported, flow: Flow) -> list[MLP]:
    """The networks beside those of T_inv."""
    return [flow.mlp, *(spread.mlp for spread in _spreads(exported).values())]


def tracker_constants(exported: Exported, flow: Flow) -> list[str]:
    """The flow's arrays, variances at the levels of noise, and error bars of T_inv."""
    artifact, measurement, process = exported.artifact, measurement_levels(exported), process_level(exported)
    assert artifact.C is not None
    assert process is not None
    low, high = flow.scaled_bounds
    level = f"LARGER({process.macro}, {number(flow.least_process_noise)})"
    Q = [
        f"SQUARE({level} * {number(each)}) + {number(error**2)}"
        for each, error in zip(flow.process_noise, flow.error, strict=True)
    ]
    macros = [f"CUT_{each.macro}" for each in measurement] * (artifact.ny // len(measurement))
    least = map(number, flow.least_measurement_noise)
    R = [f"SQUARE(LARGER({macro}, {each}))" for macro, each in zip(macros, least, strict=True)]
    parts = ["\n/* The flow: how scaled states move over a sample. */\n"]
    names = ("x_offset", "x_scale", *(["u_scale"] if flow.nu else []), "gain", "polynomial")
    parts += [array("double", f"flow_{name}", getattr(flow, name)) for name in names]
    for name, each in zip(("earlier", "by"), table(flow.nx + flow.nu, flow.degree), strict=True):
        parts.append(array("unsigned short", f"flow_{name}", each))
    parts += network_arrays("flow", flow.mlp)
    parts += [
        "\n/* The Kalman filter: bounds, outputs, and variances of what is added to states and outputs. */\n",
        SQUARE,
        _LARGER,
        array("double", "low", low),
        array("double", "high", high),
        array("double", "output_mean", artifact.C @ flow.x_offset),
        array("double", "C", artifact.C * flow.x_scale),
        block("double", "Q", f"[{len(Q)}]", Q),
        *([] if flow.bend is None else [array("double", "bend", flow.bend)]),
        block("double", "R", f"[{len(R)}]", R),
    ]
    for label, spread in _spreads(exported).items():
        parts.append(f"\n/* How sure T_inv is, of {label} motion: logarithms of standard deviations, and rises. */\n")
        largest = spread.largest_variances(exported.maps[label].x_scale) / flow.x_scale**2
        parts.append(array("double", f"{label}_largest", largest))
        parts += network_arrays(f"{label}_bars", spread.mlp)
        parts += [array("double", f"{label}_{name}", getattr(spread, name)) for name in ("ages", "levels")]
        rises = np.log(spread.factors.reshape(-1, len(spread.ages))) / 2
        parts.append(array("double", f"{label}_rise", rises))
    return parts


def tracker_functions(exported: Exported, flow: Flow, words: dict[str, Any]) -> str:
    """``NAME_estimate``, and all functions that come before it."""
    watch = Supervision.of(flow, exported.artifact.filter.dt)
    nx, free = flow.nx, "free" in exported.maps
    parts = [map_functions(exported, label, inverse) for label, inverse in exported.maps.items()]
    parts.append(c_tracker_templates.INTERPOLATED)
    parts += [_covariance(exported, label, spread, words) for label, spread in _spreads(exported).items()]
    ask = c_templates.ASK_TWO if free else c_templates.ASK_ONE
    parts.append(ask.format(**words, head=c_tracker_templates.INVERT.format(**words), what="map(observer, x_hat)"))
    head = c_tracker_templates.COVARIANCE_OF_ONE.format(**words)
    parts.append(ask.format(**words, head=head, what="covariance(observer, age, P)"))
    parts.append(
        c_tracker_templates.TRACKER.format(
            **words,
            **network_words("flow", flow.mlp),
            inputs=nx + flow.nu,
            terms=flow.polynomial.shape[1],
            count=2 * nx,
            far=number(math.sqrt(nx)),
            bent=c_tracker_templates.BENT.format(**words) if flow.bend is not None else "",
            scaled_inputs=c_tracker_templates.SCALED_INPUTS.format(**words) if flow.nu else "",
            window=watch.window,
            inflation=number(INFLATION),
            **{
                name: number(getattr(watch, name))
                for name in ("share", "limit", "trend_share", "trend_square_share", "trend_gain", "trend_limit")
            },
        )
    )
    parts.append(c_tracker_templates.ESTIMATE_TRACKED.format(**words, head=c_templates.ESTIMATE.format(**words)))
    return "".join(parts)


def _spreads(exported: Exported) -> dict[str, Spread]:
    """Error bars of each map, of networks that give logarithms in units of the states."""
    found = {}
    for label, inverse in exported.maps.items():
        assert inverse.spread is not None  # or the artifact could not have a flow
        found[label] = replace(inverse.spread, mlp=inverse.spread.in_units(inverse.x_scale))
    return found


def _covariance(exported: Exported, label: str, spread: Spread, words: dict[str, Any]) -> str:
    shares = [f"CUT_{each.macro} / {number(each.end)}" for each in measurement_levels(exported)]
    measurement_share = shares[0]
    for share in shares[1:]:
        measurement_share = f"LARGER({measurement_share}, {share})"
    tables, process = len(spread.factors.reshape(-1, len(spread.ages))) // len(spread.levels), process_level(exported)
    between = ""
    if tables > 1 and process is not None:
        share = f"CUT_{process.macro} / {number(process.end)}"
        between = c_tracker_templates.BETWEEN_TABLES.format(share=share)
    return c_tracker_templates.COVARIANCE.format(
        **words,
        **network_words(f"{label}_bars", spread.mlp),
        map=label,
        levels=len(spread.levels),
        ages=len(spread.ages),
        tables=tables,
        age=", age" if "age" in exported.maps[label].features else "",
        dt=number(exported.artifact.filter.dt),
        measurement_share=measurement_share,
        process=between,
        largest=number(LARGEST_LOG),
    )
