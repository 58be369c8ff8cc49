"""C99 as templates for :mod:`training.export.c_source`, with what differs between observers in braces."""

HEADER = """\
/*
 * {NAME}: a learned KKL observer of {system}, for samples every {dt} s.
 *
 * Written by kkl-gym {version} from {source}, SHA-256
 * {checksum}
 *
 * y:     {outputs}
{inputs} * x_hat: {estimates}
 *
{paragraphs}
 */
#ifndef {MACRO}_H
#define {MACRO}_H

#ifdef __cplusplus
extern "C" {{
#endif

#define {MACRO}_NX {nx} /* estimates */
#define {MACRO}_NY {ny} /* outputs */
#define {MACRO}_NU {nu} /* inputs */
#define {MACRO}_DT {dt} /* seconds from sample to sample */

typedef {real} {NAME}_real;

typedef struct {{
    double z[{size}]; /* the filter's state */
    {NAME}_real y[{ny}]; /* the last sample */
{age}{tracker}}} {NAME}_observer;

/* Forget the past and take in the first sample. */
void {NAME}_reset({NAME}_observer *observer, const {NAME}_real y[{ny}]);

/* Take in the next sample{input_text}, and estimate. */
void {NAME}_step({NAME}_observer *observer, const {NAME}_real y[{ny}]{u}, {NAME}_real x_hat[{nx}]);

/* The estimate as things stand, which is what step gives too: after reset, the first. */
void {NAME}_estimate(const {NAME}_observer *observer, {NAME}_real x_hat[{nx}]);

#ifdef __cplusplus
}}
#endif

#endif
"""

LAYER = """
static void layer(const real *in, size_t inputs, const float *weights, const float *biases, real *out, size_t outputs)
{
    for (size_t i = 0; i < outputs; i++) {
        real sums[4] = {biases[i]}; /* four at a time: none waits for the one before, and errors stay smaller */
        size_t j = 0;
        for (; j + 4 <= inputs; j += 4)
            for (size_t k = 0; k < 4; k++)
                sums[k] += weights[i * inputs + j + k] * in[j + k];
        for (; j < inputs; j++)
            sums[0] += weights[i * inputs + j] * in[j];
        out[i] = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    }
}
"""

ACTIVATIONS = {
    "tanh": "h[i] = {tanh}(h[i]);",
    "silu": "h[i] = {half} * h[i] + {half} * h[i] * {tanh}({half} * h[i]);",
    "relu": "h[i] = h[i] > 0 ? h[i] : 0;",
}

ACTIVATION = """
static void activate_{activation}(real *h, size_t n)
{{
    for (size_t i = 0; i < n; i++)
        {body}
}}
"""

MAP = """
static void {map}_read(const {NAME}_observer *observer{age}, real *a)
{{
    for (size_t i = 0; i < {modes}; i++) {{
        double mode = 0.0;
        for (size_t j = 0; j < {size}; j++)
            mode += {map}_whiten[i][j] * (observer->z[j] - {map}_z_offset[j]);
        a[i] = (real)({gain}mode);
    }}
{told}}}

static void {map}_map(const {NAME}_observer *observer, real *x_hat)
{{
    real a[{width}], b[{width}];
    {map}_read(observer{age_now}, a);
{layers}    for (size_t i = 0; i < {nx}; i++)
        x_hat[i] = (real)({map}_x_offset[i] + {map}_x_scale[i] * {last}[i]);
}}
"""

ASK_ONE = """
{head}
{{
    driven_{what};
}}
"""

ASK_TWO = """
{head}
{{
    for (size_t i = {nz}; i < {size}; i++) {{
        if (observer->z[i] != 0.0) {{ /* an input has acted */
            driven_{what};
            return;
        }}
    }}
    free_{what};
}}
"""

ESTIMATE = "void {NAME}_estimate(const {NAME}_observer *observer, real x_hat[{nx}])"

RESET = """
void {NAME}_reset({NAME}_observer *observer, const real y[{ny}])
{{
    for (size_t i = 0; i < {size}; i++)
        observer->z[i] = 0.0;
    for (size_t j = 0; j < {ny}; j++) {{
        for (size_t i = 0; i < {nz}; i++)
            observer->z[i] += equilibrium[i][j] * y[j];
        observer->y[j] = y[j];
    }}
{begin}}}
"""

ADVANCE = """
/* z = transition z, of one block of the filter's state */
static void advance(double *z)
{{
    double next[{nz}];
    for (size_t i = 0; i < {nz}; i++)
        next[i] = diagonal[i] * z[i];
{mixing}    for (size_t i = 0; i < {nz}; i++)
        z[i] = next[i];
}}
"""

MIXING = """\
    for (size_t k = 0; k < {count}; k++)
        next[mixing_row[k]] += mixing[k] * z[mixing_column[k]];
"""

STEP = """
void {NAME}_step({NAME}_observer *observer, const real y[{ny}]{u}, real x_hat[{nx}])
{{
    double *z = observer->z;
{take}    advance(z);
    for (size_t i = 0; i < {nz}; i++)
        for (size_t j = 0; j < {ny}; j++)
            z[i] += early_y[i][j] * observer->y[j] + late_y[i][j] * y[j];
{inputs}    for (size_t j = 0; j < {ny}; j++)
        observer->y[j] = y[j];
{age_next}{supervise}    {NAME}_estimate(observer, x_hat);
}}
"""

INPUTS = """\
    for (size_t j = 0; j < {nu}; j++) {{
        z += {nz};
        advance(z);
        for (size_t i = 0; i < {nz}; i++)
            z[i] += held_u[i] * u[j];
    }}
"""

PROGRAM = """\
/*
 * Reads samples, writes estimates: cc -std=c99 -O2 {NAME}.c {NAME}_main.c -lm && ./a.out < steps.txt
 *
 * The first line of steps.txt holds {outputs}. Every further line holds {line}.
{missing} */
#include <stdio.h>

#include "{NAME}.h"

static int read_numbers({NAME}_real *values, int count)
{{
    for (int i = 0; i < count; i++) {{
        double value;
        int found = scanf("%lf", &value);
        if (found != 1)
            return found == EOF && i == 0 ? EOF : 0;
        values[i] = ({NAME}_real)value;
    }}
    return 1;
}}

static void write_numbers(const {NAME}_real *values, int count)
{{
    for (int i = 0; i < count; i++)
        printf("%.{digits}g%c", (double)values[i], i + 1 < count ? ' ' : '\\n');
}}

int main(void)
{{
    {NAME}_observer observer;
    {NAME}_real y[{MACRO}_NY], x_hat[{MACRO}_NX];
{declared}    int found = read_numbers(y, {MACRO}_NY);
    if (found == 1) {{
        {NAME}_reset(&observer, y);
        {NAME}_estimate(&observer, x_hat);
        write_numbers(x_hat, {MACRO}_NX);
    }}
    while (found == 1 && (found = read_numbers({first})) == 1) {{
{then}        {NAME}_step(&observer, y{u}, x_hat);
        write_numbers(x_hat, {MACRO}_NX);
    }}
    if (found != EOF)
        fprintf(stderr, "there is a line without all its numbers\\n");
    return found != EOF;
}}
"""

READ_Y = """\
        if ((found = read_numbers(y, {MACRO}_NY)) != 1) {{
            found = 0;
            break;
        }}
"""
