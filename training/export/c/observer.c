#include "NAME.h"

#include <math.h>
#include <stddef.h>

typedef NAME_real real;

/* CONSTANTS */

static void layer(const real *in, int inputs, const float *weights, const float *biases, real *out, int outputs)
{
    for (int i = 0; i < outputs; i++) {
        real sums[4] = {biases[i]}; /* four at a time: none waits for the one before, and errors stay smaller */
        int j = 0;
        for (; j + 4 <= inputs; j += 4)
            for (int k = 0; k < 4; k++)
                sums[k] += weights[i * inputs + j + k] * in[j + k];
        for (; j < inputs; j++)
            sums[0] += weights[i * inputs + j] * in[j];
        out[i] = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    }
}

/* FUNCTIONS */

// if free
/* Whether no input has acted since reset. */
static int untouched(const NAME_observer *observer)
{
    for (int i = NZ; i < SIZE; i++)
        if (observer->z[i] != 0.0)
            return 0;
    return 1;
}
// end free

/* T_inv. */
static void invert(const NAME_observer *observer, real *x_hat)
{
// if free
    if (untouched(observer))
        free_map(observer, x_hat);
    else
// end free
    driven_map(observer, x_hat);
}

// if tracks
/* The point before a value among points that rise, and the share of the next point in an interpolation. */
static int before(double at, const double *points, int n, double *share)
{
    int i = 0;
    while (i + 2 < n && at >= points[i + 1])
        i++;
    *share = (at - points[i]) / (points[i + 1] - points[i]);
    *share = *share < 1.0 ? *share : 1.0;
    return i;
}

/* A covariance of T_inv's error in scaled states, from a table by level of noise and age. */
static void tabulated(const double *table, const double *levels, int rows, const double *ages, int columns, double age,
                      double P[NX][NX])
{
    double of_level, of_age;
    int row = before(NOISE_SHARE, levels, rows, &of_level), column = before(age, ages, columns, &of_age);
    const double *at = table + (row * columns + column) * NX * NX, *next = at + columns * NX * NX;
    for (int k = 0; k < NX * NX; k++) {
        double low = at[k] + of_age * (at[NX * NX + k] - at[k]);
        double high = next[k] + of_age * (next[NX * NX + k] - next[k]);
        P[k / NX][k % NX] = low + of_level * (high - low);
    }
}

/* The bounds of the motion. */
static double within(double s, int i)
{
    s = s < low[i] ? low[i] : s;
    return s > high[i] ? high[i] : s;
}

/* FIELD */

/* Scaled states a sample later. */
static void move(const double s[NX], const real *u, double next[NX])
{
// if flow
    real a[FLOW_WIDTH], b[FLOW_WIDTH];
    double in[NX + NU];
    (void)u;
    for (int i = 0; i < NX; i++)
        in[i] = within(s[i], i);
// if inputs
    for (int j = 0; j < NU; j++)
        in[NX + j] = u[j] / flow_u_scale[j];
// end inputs
    for (int i = 0; i < NX + NU; i++)
        a[i] = (real)in[i];
    /* LAYERS */
    for (int i = 0; i < NX; i++) {
        next[i] = in[i] + flow_linear[i][0] + flow_gain[i] * (double)MOVED[i];
        for (int j = 0; j < NX + NU; j++)
            next[i] += flow_linear[i][1 + j] * in[j];
    }
// end flow
// if equations
    double x[NX], at[NX];
    for (int i = 0; i < NX; i++)
        x[i] = x_offset[i] + x_scale[i] * within(s[i], i);
// if discrete
    field(x, u, at);
    for (int i = 0; i < NX; i++)
        x[i] = at[i];
// end discrete
// if continuous
    double k[4][NX]; /* Runge-Kutta's */
    for (int substep = 0; substep < SUBSTEPS; substep++) {
        field(x, u, k[0]);
        for (int n = 0; n < 3; n++) {
            for (int i = 0; i < NX; i++)
                at[i] = x[i] + (n < 2 ? H / 2 : H) * k[n][i];
            field(at, u, k[n + 1]);
        }
        for (int i = 0; i < NX; i++)
            x[i] += H / 6 * (k[0][i] + 2 * (k[1][i] + k[2][i]) + k[3][i]);
    }
// end continuous
    for (int i = 0; i < NX; i++)
        next[i] = (x[i] - x_offset[i]) / x_scale[i];
// end equations
}

/* P = L L^T. Where there is no L, entries that are no numbers spread, and are noticed in the end. */
static void factorise(double P[NX][NX], double L[NX][NX])
{
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j <= i; j++) {
            L[i][j] = P[i][j];
            for (int k = 0; k < j; k++)
                L[i][j] -= L[i][k] * L[j][k];
            L[i][j] = i > j ? L[i][j] / L[j][j] : L[i][j] > 0.0 ? sqrt(L[i][j]) : NAN;
        }
    }
}

/* Solve P X = B in the place of B. */
static void solve(double P[NX][NX], double B[NX][NY])
{
    double L[NX][NX];
    factorise(P, L);
    for (int k = 0; k < NY; k++) {
        for (int i = 0; i < NX; i++) {
            for (int j = 0; j < i; j++)
                B[i][k] -= L[i][j] * B[j][k];
            B[i][k] /= L[i][i];
        }
        for (int i = NX - 1; i >= 0; i--) {
            for (int j = i + 1; j < NX; j++)
                B[i][k] -= L[j][i] * B[j][k];
            B[i][k] /= L[i][i];
        }
    }
}

/* Half the logarithm of P's determinant. */
static double log_determinant(double P[NX][NX])
{
    double L[NX][NX], sum = 0.0;
    factorise(P, L);
    for (int i = 0; i < NX; i++)
        sum += log(L[i][i]);
    return sum;
}

// if nonlinear
/* OUTPUT */

/* Outputs of scaled states; of sigma points where they are undefined, those within the bounds. */
static void output(const double s[NX], const real *u, double y[NY])
{
    double x[NX], near[NY];
    (void)u;
    for (int i = 0; i < NX; i++)
        x[i] = x_offset[i] + x_scale[i] * s[i];
    h(x, NULL, y);
    for (int i = 0; i < NX; i++)
        x[i] = x_offset[i] + x_scale[i] * within(s[i], i);
    h(x, NULL, near);
    for (int k = 0; k < NY; k++)
        y[k] = isfinite(y[k]) ? y[k] : near[k];
}

// end nonlinear
/* What a function makes of a Gaussian, by sigma points: mean (n), covariance (n, n), and that with the states (NX, n).
 */
static void transform(void (*of)(const double *, const real *, double *), int n, const double x[NX], double P[NX][NX],
                      const real *u, double *mean, double *S, double *across)
{
    double L[NX][NX], s[NX], to[1 + 2 * NX][NX > NY ? NX : NY];
    factorise(P, L);
    for (int p = 0; p <= 2 * NX; p++) {
        int column = p ? (p - 1) / 2 : NX;
        for (int i = 0; i < NX; i++)
            s[i] = i < column ? x[i] : x[i] + (p % 2 ? FAR : -FAR) * L[i][column];
        of(s, u, to[p]);
// if nonlinear
        for (int i = 0; i < n; i++)
            if (of == output && !isfinite(to[p][i]))
                to[p][i] = to[0][i];
// end nonlinear
    }
    for (int i = 0; i < n; i++) {
        mean[i] = MIDDLE * to[0][i];
        for (int p = 1; p <= 2 * NX; p++)
            mean[i] += OTHER * to[p][i];
        for (int p = 0; p <= 2 * NX; p++)
            to[p][i] -= mean[i];
        for (int j = 0; j <= i; j++) {
            double sum = MIDDLE_SQUARES * to[0][i] * to[0][j];
            for (int p = 1; p <= 2 * NX; p++)
                sum += OTHER * to[p][i] * to[p][j];
            S[i * n + j] = S[j * n + i] = sum;
        }
        for (int k = 0; k < NX; k++) {
            across[k * n + i] = 0.0;
            for (int column = 0; column <= k; column++)
                across[k * n + i] += OTHER * FAR * L[k][column] * (to[1 + 2 * column][i] - to[2 + 2 * column][i]);
        }
    }
}

/* Condition a prediction on a sample, of which NaN is missing: mean + V white and P - V V^T are what is known then. */
static void correct(const double mean[NX], double P[NX][NX], const real y[NY], double V[NX][NY], double white[NY],
                    double expected[NY])
{
    double S[NY][NY];
// if linear
    for (int k = 0; k < NY; k++) {
        expected[k] = output_mean[k];
        for (int i = 0; i < NX; i++) {
            expected[k] += C[k][i] * mean[i];
            V[i][k] = 0.0;
            for (int j = 0; j < NX; j++)
                V[i][k] += P[i][j] * C[k][j];
        }
        for (int l = 0; l <= k; l++) {
            S[k][l] = 0.0;
            for (int i = 0; i < NX; i++)
                S[k][l] += C[l][i] * V[i][k];
        }
    }
// end linear
// if nonlinear
    transform(output, NY, mean, P, NULL, expected, S[0], V[0]);
// end nonlinear
    for (int k = 0; k < NY; k++)
        white[k] = y[k] - expected[k];
    for (int k = 0; k < NY; k++) {
        double root = sqrt(S[k][k] + R[k]);
        int missing = isnan(y[k]);
        white[k] = missing ? 0.0 : white[k] / root;
        for (int i = 0; i < NX; i++)
            V[i][k] = missing ? 0.0 : V[i][k] / root;
        for (int l = k + 1; l < NY && !missing; l++) {
            double share = S[l][k] / root;
            white[l] -= share * white[k];
            for (int i = 0; i < NX; i++)
                V[i][l] -= share * V[i][k];
            for (int m = k + 1; m <= l; m++)
                S[l][m] -= share * S[m][k] / root;
        }
    }
}

/* Add V W^T to P, times a sign. */
static void add(double P[NX][NX], double V[NX][NY], double W[NX][NY], double sign)
{
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++)
            for (int k = 0; k < NY; k++)
                P[i][j] += sign * V[i][k] * W[j][k];
}

/* Predict again, with the motion linearised about where the step began as far as the sample tells. */
static void relinearise(NAME_observer *observer, const real y[NY], const real *u, double mean[NX], double moved[NX][NX],
                        double across[NX][NX])
{
    double V[NX][NY], G[NX][NY] = {{0.0}}, D[NX][NY] = {{0.0}}, white[NY], expected[NY], L[NX][NX], total = 0.0;
    double start[NX], spread[NX][NX], again[NX], S[NX][NX], of_start[NX][NX];
    correct(mean, moved, y, V, white, expected);
    solve(moved, V);
    for (int i = 0; i < NX; i++) {
        start[i] = observer->x[i];
        for (int k = 0; k < NY; k++) {
            for (int j = 0; j < NX; j++)
                G[i][k] += across[i][j] * V[j][k];
            start[i] += G[i][k] * white[k];
        }
        for (int j = 0; j < NX; j++)
            spread[i][j] = observer->P[i][j];
    }
    add(spread, G, G, -1.0);
    transform(move, NX, start, spread, u, again, S[0], of_start[0]);
    for (int i = 0; i < NX; i++)
        for (int k = 0; k < NY; k++)
            V[i][k] = G[i][k];
    solve(spread, V);
    for (int i = 0; i < NX; i++) {
        for (int k = 0; k < NY; k++) {
            for (int j = 0; j < NX; j++)
                D[i][k] += of_start[j][i] * V[j][k];
            again[i] -= D[i][k] * white[k];
        }
        S[i][i] += Q[i];
    }
    add(S, D, D, 1.0);
    add(of_start, G, D, 1.0);
    factorise(S, L);
    for (int i = 0; i < NX; i++) {
        total += again[i];
        for (int j = 0; j <= i; j++)
            total += L[i][j];
    }
    for (int i = 0; i < NX && isfinite(total); i++) {
        mean[i] = again[i];
        for (int j = 0; j < NX; j++) {
            moved[i][j] = S[i][j];
            across[i][j] = of_start[i][j];
        }
    }
}

/* What the innovations tell is forgotten. */
static void watch_anew(NAME_observer *observer)
{
    observer->nis = observer->trend_square = 1.0;
    for (int k = 0; k < NY; k++)
        observer->trend[k] = 0.0;
}

/* Correct a prediction; returns whether estimate and covariance are numbers, and leaves them as they were if not. */
static int take_in(NAME_observer *observer, double mean[NX], double moved[NX][NX], const real y[NY], double white[NY],
                   double expected[NY])
{
    double V[NX][NY], total = 0.0;
    correct(mean, moved, y, V, white, expected);
    add(moved, V, V, -1.0);
    for (int i = 0; i < NX; i++) {
        for (int k = 0; k < NY; k++)
            mean[i] += V[i][k] * white[k];
        total += mean[i];
        for (int j = 0; j < NX; j++)
            total += moved[i][j];
    }
    for (int i = 0; i < NX && isfinite(total); i++) {
        observer->x[i] = within(mean[i], i);
        for (int j = 0; j < NX; j++)
            observer->P[i][j] = moved[i][j];
    }
    return isfinite(total);
}

/* Predict, and take in a sample. What is missing of it is replaced by what was predicted. */
static void track(NAME_observer *observer, const real y[NY], const real *u, real whole[NY])
{
    double mean[NX], moved[NX][NX], across[NX][NX], white[NY], expected[NY], squared = 0.0, raised = 0.0;
    int count = 0, sound;
    transform(move, NX, observer->x, observer->P, u, mean, moved[0], across[0]);
    for (int i = 0; i < NX; i++)
        moved[i][i] += Q[i];
    for (int turn = 0; turn < RELINEARISATIONS && observer->seen < WINDOW; turn++)
        relinearise(observer, y, u, mean, moved, across);
    sound = take_in(observer, mean, moved, y, white, expected);
    for (int k = 0; k < NY; k++)
        whole[k] = !isnan(y[k]) ? y[k] : isfinite(expected[k]) ? (real)expected[k] : observer->y[k];
    if (!sound) {
        observer->nis = INFINITY; /* lost */
        return;
    }
    for (int k = 0; k < NY; k++) {
        if (isnan(y[k]))
            continue;
        observer->trend[k] += TREND_SHARE * (white[k] - observer->trend[k]);
        raised += SQUARE(observer->trend[k]);
        squared += SQUARE(white[k]);
        count++;
    }
    if (!count)
        return;
    observer->nis += SHARE * count / NY * (squared / count - observer->nis);
    observer->trend_square += TREND_SQUARE_SHARE * count / NY * (TREND_GAIN * raised / count - observer->trend_square);
    if (observer->seen < WINDOW)
        observer->seen++;
    if (observer->trend_square > TREND_LIMIT) { /* innovations agree with one another */
        double nis = observer->nis;
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++)
                observer->P[i][j] *= INFLATION;
        watch_anew(observer);
        observer->nis = nis;
    }
}

/* Take T_inv's estimate where it is surer, soon after a reset, or where the filter diverged. */
static void supervise(NAME_observer *observer)
{
    int lost = !(observer->nis <= NIS_LIMIT); /* also where it is no number */
    double P[NX][NX], age = (double)observer->seen * MACRO_DT; /* what misled the filter may have misled z as well */
    real x_hat[NX];
    if (!lost && observer->seen >= WINDOW)
        return;
// if free
    if (untouched(observer))
        TABULATE(free, age, P);
    else
// end free
    TABULATE(driven, age, P);
    if (!lost && !(log_determinant(P) < log_determinant(observer->P)))
        return;
    invert(observer, x_hat);
    for (int i = 0; i < NX; i++) {
        observer->x[i] = within((x_hat[i] - x_offset[i]) / x_scale[i], i);
        for (int j = 0; j < NX; j++)
            observer->P[i][j] = P[i][j];
    }
    if (lost)
        watch_anew(observer);
}

// end tracks
void NAME_estimate(const NAME_observer *observer, real x_hat[NX])
{
// if tracks
    for (int i = 0; i < NX; i++)
        x_hat[i] = (real)(x_offset[i] + x_scale[i] * observer->x[i]);
// end tracks
// if static
    invert(observer, x_hat);
// end static
}

void NAME_reset(NAME_observer *observer, const real y[NY])
{
    observer->age = 0;
    for (int i = 0; i < SIZE; i++)
        observer->z[i] = 0.0;
    for (int j = 0; j < NY; j++) {
        for (int i = 0; i < NZ; i++)
            observer->z[i] += equilibrium[i][j] * y[j];
        observer->y[j] = y[j];
    }
// if tracks
    double mean[NX], moved[NX][NX], white[NY], expected[NY];
    for (int i = 0; i < NX; i++) {
        mean[i] = observer->x[i] = start_mean[i];
        for (int j = 0; j < NX; j++)
            moved[i][j] = observer->P[i][j] = start_covariance[i][j];
    }
    take_in(observer, mean, moved, y, white, expected);
    watch_anew(observer);
    observer->seen = 0;
    supervise(observer);
// end tracks
}

/* z = transition z, of one block of the filter's state. */
static void advance(double *z)
{
    double next[NZ] = {0.0};
    for (int k = 0; k < TRANSITIONS; k++)
        next[transition_row[k]] += transition[k] * z[transition_column[k]];
    for (int i = 0; i < NZ; i++)
        z[i] = next[i];
}

// if inputs
void NAME_step(NAME_observer *observer, const real y[NY], const real u[NU], real x_hat[NX])
// end inputs
// if autonomous
void NAME_step(NAME_observer *observer, const real y[NY], real x_hat[NX])
// end autonomous
{
    double *z = observer->z;
// if tracks
    real whole[NY];
// if inputs
    track(observer, y, u, whole);
// end inputs
// if autonomous
    track(observer, y, NULL, whole);
// end autonomous
    y = whole;
// end tracks
    advance(z);
    for (int i = 0; i < NZ; i++)
        for (int j = 0; j < NY; j++)
            z[i] += early_y[i][j] * observer->y[j] + late_y[i][j] * y[j];
// if inputs
    for (int j = 0; j < NU; j++) {
        z += NZ;
        advance(z);
        for (int i = 0; i < NZ; i++)
            z[i] += held_u[i] * u[j];
    }
// end inputs
    for (int j = 0; j < NY; j++)
        observer->y[j] = y[j];
    if (observer->age != LAST_AGE)
        observer->age++;
// if tracks
    supervise(observer);
// end tracks
    NAME_estimate(observer, x_hat);
}
