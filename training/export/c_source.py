"""The step as C99: a header, a source without dependencies but math.h, and a program that shows how they are used."""

from textwrap import fill
from typing import Any

import numpy as np

import kkl_gym
from training.export import c_templates, c_tracker_templates
from training.export.c_map import levels, map_constants, map_functions, process_level
from training.export.c_text import array, comment, number
from training.export.c_tracker import tracker_constants, tracker_functions, tracker_networks
from training.export.exported import Exported


def c_files(exported: Exported) -> dict[str, str]:
    """Write the observer in C."""
    exported.refuse_nonlinear("C")
    name, words = exported.name, _words(exported)
    return {
        f"{name}.h": _header(exported, words),
        f"{name}.c": _source(exported, words),
        f"{name}_main.c": _program(exported, words),
    }


def _words(exported: Exported) -> dict[str, Any]:
    """What the templates have in common."""
    artifact, real = exported.artifact, f"{exported.name}_real"
    return {
        "NAME": exported.name,
        "MACRO": exported.name.upper(),
        "nx": len(exported.estimates),
        "ny": artifact.ny,
        "nu": artifact.nu,
        "nz": len(artifact.filter.A),
        "size": artifact.filter.size,
        "u": f", const {real} u[{artifact.nu}]" if artifact.nu else "",
        "pass_u": ", u" if artifact.nu else "",
    }


def _header(exported: Exported, words: dict[str, Any]) -> str:
    artifact = exported.artifact
    tracks = artifact.flow is not None
    finite = (
        "Where an output is missing, pass NaN: it is predicted. The first sample and inputs must be finite, and the "
        "compiler must know NaN, as it does without -ffast-math."
        if tracks
        else "Samples and inputs must be finite: a NaN stays until the next reset."
    )
    paragraphs = [
        f"{exported.name}_reset takes in the first sample, {exported.name}_step every later one. {finite} Nothing is "
        "allocated, and observers share constants alone."
    ]
    process = process_level(exported) if tracks else None  # of which the Kalman filter takes any
    for level in levels(exported):
        value, to = number(level.value), " for T_inv" if level == process else ""
        beyond = f"; what is beyond {number(level.end)} counts as that{to}" if np.isfinite(level.end) else ""
        paragraphs.append(
            f"{level.macro} is {level.meaning}, {value} unless the compiler is told otherwise, as in "
            f"-D{level.macro}={value}{beyond}."
        )
    return c_templates.HEADER.format(
        **words,
        system=comment(artifact.system),
        dt=number(artifact.filter.dt),
        version=kkl_gym.__version__,
        source=comment(exported.source),
        checksum=exported.checksum,
        outputs=comment(", ".join(exported.outputs)),
        inputs=f" * u:     {comment(', '.join(exported.inputs))}\n" if artifact.nu else "",
        estimates=comment(", ".join(exported.estimates)),
        paragraphs="\n *\n".join(fill(text, 116, initial_indent=" * ", subsequent_indent=" * ") for text in paragraphs),
        real=exported.precision,
        age="    unsigned long age; /* samples since the first, as far as that matters */\n"
        if exported.last_age
        else "",
        tracker=c_tracker_templates.FIELDS.format(**words) if tracks else "",
        input_text=" and the input that was held since the last" if artifact.nu else "",
    )


def _source(exported: Exported, words: dict[str, Any]) -> str:
    linear, nz = exported.artifact.filter, words["nz"]
    parts = [
        f'#include "{exported.name}.h"\n\n#include <math.h>\n#include <stddef.h>\n\n',
        f"typedef {exported.name}_real real;\n",
    ]
    for level in levels(exported):
        macro, end = level.macro, number(level.end)
        parts.append(f"\n#ifndef {macro}\n#define {macro} {number(level.value)}\n#endif\n")
        cut = f"(({macro}) < {end} ? ({macro}) : {end})" if np.isfinite(level.end) else f"({macro})"
        parts.append(f"#define CUT_{macro} {cut}\n")
    block = linear.transition[:nz, :nz]
    rows, columns = np.nonzero(block - np.diag(block.diagonal()))
    parts += [
        "\n/* The filter. */\n",
        array("double", "diagonal", block.diagonal()),
        array("double", "early_y", linear.early_y[:nz]),
        array("double", "late_y", linear.late_y[:nz]),
        array("double", "equilibrium", linear.equilibrium[:nz]),
    ]
    if len(rows):
        parts += [
            array("double", "mixing", block[rows, columns]),
            array("unsigned short", "mixing_row", rows),
            array("unsigned short", "mixing_column", columns),
        ]
    if linear.nu:
        parts.append(array("double", "held_u", linear.held_u[nz : 2 * nz, 0]))
    for label, inverse in exported.maps.items():
        parts += map_constants(exported, label, inverse)
    flow, networks = exported.artifact.flow, [inverse.mlp for inverse in exported.maps.values()]
    if flow is not None:
        parts += tracker_constants(exported, flow)
        networks += tracker_networks(exported, flow)
    parts.append(c_templates.LAYER)
    for activation in dict.fromkeys(mlp.activation for mlp in networks if len(mlp.weights) > 1):
        tanh = "tanhf" if exported.precision == "float" else "tanh"
        body = c_templates.ACTIVATIONS[activation].format(tanh=tanh, half="(real)0.5")
        parts.append(c_templates.ACTIVATION.format(activation=activation, body=body))
    words = words | {"u": words["u"].replace(f"{exported.name}_real", "real")}
    if flow is None:
        parts += [map_functions(exported, label, inverse) for label, inverse in exported.maps.items()]
        ask = c_templates.ASK_TWO if "free" in exported.maps else c_templates.ASK_ONE
        parts.append(ask.format(**words, head=c_templates.ESTIMATE.format(**words), what="map(observer, x_hat)"))
    else:
        parts.append(tracker_functions(exported, flow, words))
    last = exported.last_age
    begin = "" if flow is None else c_tracker_templates.BEGIN
    age_zero = "    observer->age = 0;\n" if last else ""
    parts.append(c_templates.RESET.format(**words, begin=age_zero + begin))
    parts.append(
        c_templates.ADVANCE.format(nz=nz, mixing=c_templates.MIXING.format(count=len(rows)) if len(rows) else "")
    )
    parts.append(
        c_templates.STEP.format(
            **words,
            take="" if flow is None else c_tracker_templates.TAKE.format(**words),
            inputs=c_templates.INPUTS.format(**words) if linear.nu else "",
            age_next=f"    if (observer->age < {last}ul)\n        observer->age++;\n" if last else "",
            supervise="" if flow is None else "    supervise(observer, told);\n",
        )
    )
    return "".join(parts)


def _program(exported: Exported, words: dict[str, Any]) -> str:
    outputs, inputs = (comment(", ".join(names)) for names in (exported.outputs, exported.inputs))
    macro, nu = words["MACRO"], exported.artifact.nu
    return c_templates.PROGRAM.format(
        NAME=exported.name,
        MACRO=macro,
        outputs=outputs,
        line=f"the input that led to the next sample, {inputs}, then the sample" if nu else "the next sample",
        missing="" if exported.artifact.flow is None else " * Outputs that are missing are nan, but for the first.\n",
        digits=9 if exported.precision == "float" else 17,
        declared=f"    {exported.name}_real u[{macro}_NU];\n" if nu else "",
        first=f"u, {macro}_NU" if nu else f"y, {macro}_NY",
        then=c_templates.READ_Y.format(MACRO=macro) if nu else "",
        u=words["pass_u"],
    )
