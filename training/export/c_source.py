"""The step as C99: a header, a source without dependencies but math.h, and a program that shows how they are used."""

from collections.abc import Iterable, Sequence
from textwrap import fill
from typing import Any

import numpy as np

import kkl_gym
from observers.inverse import InverseMap
from training.export import c_templates
from training.export.exported import Exported

_WIDTH = 118  # of lines of numbers


def c_files(exported: Exported) -> dict[str, str]:
    """Write the observer in C.

    Parameters
    ----------
    exported : Exported
        The observer. Its levels of noise are those that the source assumes unless the compiler is told others.

    Returns
    -------
    dict of str to str
        By the names of the files: ``NAME.h``, ``NAME.c``, and ``NAME_main.c``, a program around them.
    """
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
    }


def _header(exported: Exported, words: dict[str, Any]) -> str:
    artifact = exported.artifact
    paragraphs = [
        f"{exported.name}_reset takes in the first sample, {exported.name}_step every later one. Samples and inputs "
        "must be finite: a NaN stays until the next reset. Nothing is allocated, and observers share constants alone."
    ]
    for kind, meaning, level, end in _levels(exported):
        beyond = f"; what is beyond {_number(end)} counts as that" if np.isfinite(end) else ""
        paragraphs.append(
            f"{kind} is {meaning}, {_number(level)} unless the compiler is told otherwise, as in "
            f"-D{kind}={_number(level)}{beyond}."
        )
    return c_templates.HEADER.format(
        **words,
        system=_comment(artifact.system),
        dt=_number(artifact.filter.dt),
        version=kkl_gym.__version__,
        source=_comment(exported.source),
        checksum=exported.checksum,
        outputs=_comment(", ".join(exported.outputs)),
        inputs=f" * u:     {_comment(', '.join(exported.inputs))}\n" if artifact.nu else "",
        estimates=_comment(", ".join(exported.estimates)),
        paragraphs="\n *\n".join(fill(text, 116, initial_indent=" * ", subsequent_indent=" * ") for text in paragraphs),
        real=exported.precision,
        age="    unsigned long age; /* samples since the first, as far as that matters */\n"
        if exported.last_age
        else "",
        input_text=" and the input that was held since the last" if artifact.nu else "",
    )


def _levels(exported: Exported) -> list[tuple[str, str, float, float]]:
    """Macros for levels of noise: name, meaning, default and end of each."""
    macro, found = exported.name.upper(), []
    inverse = exported.artifact.inverse
    end = inverse.measurement_noise_max if "measurement_noise" in inverse.features else np.inf
    ends = np.broadcast_to(end, len(exported.levels)).tolist()
    for i, (level, end) in enumerate(zip(exported.levels, ends, strict=True), 1):
        several = len(exported.levels) > 1
        of = f"of {_comment(exported.outputs[i - 1])}" if several else "of y"
        meaning = f"the standard deviation of the noise on each sample {of}"
        found.append((f"{macro}_MEASUREMENT_NOISE{f'_{i}' * several}", meaning, level, end))
    if exported.told_process_noise:
        meaning, end = "the level of process noise that is assumed", float(exported.artifact.process_noise_max or 0)
        found.append((f"{macro}_PROCESS_NOISE", meaning, exported.process_noise, end))
    return found


def _source(exported: Exported, words: dict[str, Any]) -> str:
    linear, nz = exported.artifact.filter, words["nz"]
    parts = [
        f'#include "{exported.name}.h"\n\n#include <math.h>\n#include <stddef.h>\n\n',
        f"typedef {exported.name}_real real;\n",
    ]
    for macro, _, level, end in _levels(exported):
        parts.append(f"\n#ifndef {macro}\n#define {macro} {_number(level)}\n#endif\n")
        if np.isfinite(end):
            parts.append(f"#define CUT_{macro} (({macro}) < {_number(end)} ? ({macro}) : {_number(end)})\n")
        else:
            parts.append(f"#define CUT_{macro} ({macro})\n")
    block = linear.transition[:nz, :nz]
    rows, columns = np.nonzero(block - np.diag(block.diagonal()))
    parts += [
        "\n/* The filter. */\n",
        _array("double", "diagonal", block.diagonal()),
        _array("double", "early_y", linear.early_y[:nz]),
        _array("double", "late_y", linear.late_y[:nz]),
        _array("double", "equilibrium", linear.equilibrium[:nz]),
    ]
    if len(rows):
        parts += [
            _array("double", "mixing", block[rows, columns]),
            _array("unsigned short", "mixing_row", rows),
            _array("unsigned short", "mixing_column", columns),
        ]
    if linear.nu:
        parts.append(_array("double", "held_u", linear.held_u[nz : 2 * nz, 0]))
    for label, inverse in exported.maps.items():
        parts += _constants(exported, label, inverse)
    parts.append(c_templates.LAYER)
    for activation in dict.fromkeys(inverse.mlp.activation for inverse in exported.maps.values()):
        body = c_templates.ACTIVATIONS[activation].format(tanh=_function(exported, "tanh"), half="(real)0.5")
        parts.append(c_templates.ACTIVATION.format(activation=activation, body=body))
    parts += [_map(exported, label, inverse) for label, inverse in exported.maps.items()]
    words = words | {"u": words["u"].replace(f"{exported.name}_real", "real")}
    parts.append((c_templates.ESTIMATE_FREE if "free" in exported.maps else c_templates.ESTIMATE).format(**words))
    last = exported.last_age
    parts.append(c_templates.RESET.format(**words, age_zero="    observer->age = 0;\n" if last else ""))
    parts.append(
        c_templates.ADVANCE.format(nz=nz, mixing=c_templates.MIXING.format(count=len(rows)) if len(rows) else "")
    )
    age = f"    if (observer->age < {last}ul)\n        observer->age++;\n" if last else ""
    parts.append(
        c_templates.STEP.format(**words, inputs=c_templates.INPUTS.format(**words) if linear.nu else "", age_next=age)
    )
    return "".join(parts)


def _constants(exported: Exported, label: str, inverse: InverseMap) -> list[str]:
    """The arrays of a map."""
    parts = [f"\n/* The map of {label} motion. */\n"]
    arrays = ("z_offset", "whiten", "x_offset", "x_scale")
    parts += [_array("double", f"{label}_{name}", getattr(inverse, name)) for name in arrays]
    if inverse.noise_gain.any():
        macros = [macro for macro, *_ in _levels(exported)]
        gains = np.atleast_2d(inverse.noise_gain)
        squares = [
            " + ".join(f"SQUARE(CUT_{macro} * {_number(gain)})" for macro, gain in zip(macros, column))
            for column in gains.T.tolist()
        ]
        parts.append("#ifndef SQUARE\n#define SQUARE(a) ((a) * (a))\n#endif\n")
        parts.append(
            _block("double", f"{label}_gain", f"[{len(squares)}]", [f"1.0 / (1.0 + {sum})" for sum in squares])
        )
    for i, (weight, bias) in enumerate(zip(inverse.mlp.weights, inverse.mlp.biases, strict=True)):
        parts.append(_array("float", f"{label}_weights{i}", weight.reshape(-1)))
        parts.append(_array("float", f"{label}_biases{i}", bias))
    return parts


def _map(exported: Exported, label: str, inverse: InverseMap) -> str:
    modes, size = inverse.whiten.shape
    told: list[str] = []
    for feature, terms in _told(exported, inverse):
        told.append(f"    a[{modes + len(told)}] = (real)log1p({terms}); /* {feature} */\n")
    layers, here, there = [], "a", "b"
    for i, weight in enumerate(inverse.mlp.weights):
        outputs, inputs = weight.shape
        if i:
            layers.append(f"    activate_{inverse.mlp.activation}({here}, {inputs});\n")
        layers.append(f"    layer({here}, {inputs}, {label}_weights{i}, {label}_biases{i}, {there}, {outputs});\n")
        here, there = there, here
    return c_templates.MAP.format(
        NAME=exported.name,
        map=label,
        width=max(max(weight.shape) for weight in inverse.mlp.weights),
        modes=modes,
        size=size,
        gain=f"{label}_gain[i] * " if inverse.noise_gain.any() else "",
        told="".join(told),
        layers="".join(layers),
        last=here,
        nx=len(inverse.x_offset),
    )


def _told(exported: Exported, inverse: InverseMap) -> Iterable[tuple[str, str]]:
    """What else the network is told: each feature with what is the argument of log1p."""
    units = np.atleast_1d(inverse.measurement_noise_unit).tolist()
    macros = [macro for macro, *_ in _levels(exported)]
    if "measurement_noise" in inverse.features:
        for macro, unit in zip(macros[: len(exported.levels)], units, strict=True):
            yield "measurement noise", f"CUT_{macro} / {_number(unit)}"
    if "process_noise" in inverse.features:
        yield "process noise", f"CUT_{macros[-1]} / {_number(inverse.process_noise_unit)}"
    if "age" in inverse.features:
        age = f"(double)observer->age * {_number(exported.artifact.filter.dt)}"
        end = _number(inverse.age_max)
        yield "age", f"({age} < {end} ? {age} : {end}) / {_number(inverse.age_unit)}"


def _program(exported: Exported, words: dict[str, Any]) -> str:
    outputs, inputs = (_comment(", ".join(names)) for names in (exported.outputs, exported.inputs))
    macro, nu = words["MACRO"], exported.artifact.nu
    return c_templates.PROGRAM.format(
        NAME=exported.name,
        MACRO=macro,
        outputs=outputs,
        line=f"the input that led to the next sample, {inputs}, then the sample" if nu else "the next sample",
        digits=9 if exported.precision == "float" else 17,
        declared=f"    {exported.name}_real u[{macro}_NU];\n" if nu else "",
        first=f"u, {macro}_NU" if nu else f"y, {macro}_NY",
        then=c_templates.READ_Y.format(MACRO=macro) if nu else "",
        u=", u" if nu else "",
    )


def _function(exported: Exported, name: str) -> str:
    return f"{name}f" if exported.precision == "float" else name


def _number(value: float) -> str:
    """The shortest decimals that are read back as the same double."""
    return repr(float(value))


def _array(kind: str, name: str, values: np.ndarray) -> str:
    """A constant array of one or two dimensions; numbers are the shortest that are read back as the same."""
    if kind == "float":
        words = [f"{number}f" for number in np.asarray(values, np.float32).astype(str).tolist()]
    elif kind == "double":
        words = list(map(repr, np.asarray(values, float).reshape(-1).tolist()))
    else:
        words = list(map(str, values.tolist()))
    shape = "".join(f"[{length}]" for length in np.shape(values))
    if np.ndim(values) < 2:
        return _block(kind, name, shape, words)
    width = np.shape(values)[1]
    rows = [words[first : first + width] for first in range(0, len(words), width)]
    return _block(kind, name, shape, ["{" + ", ".join(row) + "}" for row in rows])


def _block(kind: str, name: str, shape: str, words: Sequence[str]) -> str:
    lines, line = [], "   "
    for word in words:
        if len(line) + len(word) > _WIDTH and line.strip():
            lines.append(line)
            line = "   "
        line += f" {word},"
    return "\n".join([f"static const {kind} {name}{shape} = {{", *lines, line, "};", ""])


def _comment(text: str) -> str:
    """Names of others as a comment can hold them: on one line, and without its end."""
    return " ".join(text.split()).replace("/*", "/ *").replace("*/", "* /").replace("\\", "/").replace("??", "?")
