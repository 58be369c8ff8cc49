#include "NAME.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

typedef NAME_real real;

/* CONSTANTS */

static void layer(const real *in, int inputs, const float *weights, const float *biases, real *out, int outputs)
{
    for (int i = 0; i < outputs; i++) {
        real sums[4] = {biases[i]}; /* four independent sums, which are faster and have smaller rounding errors */
        int j = 0;
        for (; j + 4 <= inputs; j += 4)
            for (int k = 0; k < 4; k++)
                sums[k] += weights[i * inputs + j + k] * in[j + k];
        for (; j < inputs; j++)
            sums[0] += weights[i * inputs + j] * in[j];
        out[i] = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    }
}

// if silu
static void activate_silu(real *h, int n)
{
    for (int i = 0; i < n; i++)
        h[i] = (real)0.5 * h[i] + (real)0.5 * h[i] * TANH((real)0.5 * h[i]);
}

// end silu
// if tanh
static void activate_tanh(real *h, int n)
{
    for (int i = 0; i < n; i++)
        h[i] = TANH(h[i]);
}

// end tanh
// if relu
static void activate_relu(real *h, int n)
{
    for (int i = 0; i < n; i++)
        h[i] = h[i] > 0 ? h[i] : 0;
}

// end relu
/* MAPS */
// if free
/* Returns 1 if all inputs since reset were zero, else 0. */
static int untouched(const NAME_observer *observer)
{
    for (int i = NZ; i < SIZE; i++)
        if (observer->z[i] != 0.0)
            return 0;
    return 1;
}
// end free

/* Writes T_inv(z) to x_hat. A map for motion without input, if any, applies until the first nonzero input. */
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
/* Interpolates P, the covariance of T_inv's error in scaled states, at an age in samples that is within the table. */
static void tabulated(const double *table, const double *ages, double age, double P[NX][NX])
{
    for (; age > ages[1]; ages++)
        table += NX * NX;
    for (int k = 0; k < NX * NX; k++)
        P[k / NX][k % NX] = table[k] + (age - ages[0]) / (ages[1] - ages[0]) * (table[NX * NX + k] - table[k]);
}

/* Returns the scaled state i limited to its bounds. */
static double within(double s, int i)
{
    s = s < low[i] ? low[i] : s;
    return s > high[i] ? high[i] : s;
}

/* MOTION */

/* Computes the scaled states one sample later. */
static void move(const double at[NX], const real *u, double next[NX])
{
    double s[NX + NU];
    for (int i = 0; i < NX; i++)
        s[i] = within(at[i], i);
// if flow
    real a[FLOW_WIDTH], b[FLOW_WIDTH];
// if inputs
    for (int j = 0; j < NU; j++)
        s[NX + j] = u[j] / flow_u_scale[j];
// end inputs
    for (int i = 0; i < NX + NU; i++)
        a[i] = (real)s[i];
    /* LAYERS */
    for (int i = 0; i < NX; i++) {
        next[i] = s[i] + flow_linear[i][0] + flow_gain[i] * (double)MOVED[i];
        for (int j = 0; j < NX + NU; j++)
            next[i] += flow_linear[i][1 + j] * s[j];
        next[i] = within(next[i], i);
    }
    (void)u;
// end flow
// if equations
    double x[NX];
    for (int i = 0; i < NX; i++)
        x[i] = x_offset[i] + x_scale[i] * s[i];
// if discrete
    field(x, u, next);
// end discrete
// if continuous
    double k[4][NX]; /* stages of the Runge-Kutta method */
    for (int substep = 0; substep < SUBSTEPS; substep++) {
        field(x, u, k[0]);
        for (int n = 0; n < 3; n++) {
            for (int i = 0; i < NX; i++)
                next[i] = x[i] + (n < 2 ? H / 2 : H) * k[n][i];
            field(next, u, k[n + 1]);
        }
        for (int i = 0; i < NX; i++)
            next[i] = x[i] += H / 6 * (k[0][i] + 2 * (k[1][i] + k[2][i]) + k[3][i]);
    }
// end continuous
    for (int i = 0; i < NX; i++)
        next[i] = within((next[i] - x_offset[i]) / x_scale[i], i);
// end equations
}

/* Computes the outputs of scaled states. Sigma points may lie where an output is undefined: then its value is
   computed at the states limited to their bounds. */
static void measure(const double s[NX], const real *u, double y[NY])
{
    double x[2][NX], near[NY];
    for (int i = 0; i < NX; i++) {
        x[0][i] = x_offset[i] + x_scale[i] * s[i];
        x[1][i] = x_offset[i] + x_scale[i] * within(s[i], i);
    }
    h(x[0], u, y);
    h(x[1], u, near);
    for (int k = 0; k < NY; k++)
        y[k] = isfinite(y[k]) ? y[k] : near[k];
}

/* Computes L with P = L L^T, and returns the sum of the logarithms of L's diagonal. If P is not positive definite, L
   and the sum contain NaN. */
static double factorise(double P[NX][NX], double L[NX][NX])
{
    double sum = 0.0;
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j <= i; j++) {
            L[i][j] = P[i][j];
            for (int k = 0; k < j; k++)
                L[i][j] -= L[i][k] * L[j][k];
            L[i][j] = i > j ? L[i][j] / L[j][j] : L[i][j] > 0.0 ? sqrt(L[i][j]) : NAN;
        }
        sum += log(L[i][i]);
    }
    return sum;
}

/* Computes X = A^T P^-1 B if transposed, else A P^-1 B. */
static void weigh(double A[NX][NX], int transposed, double P[NX][NX], double B[NX][NY], double X[NX][NY])
{
    double L[NX][NX], b[NX];
    factorise(P, L);
    for (int k = 0; k < NY; k++) {
        for (int i = 0; i < NX; i++) {
            b[i] = B[i][k];
            for (int j = 0; j < i; j++)
                b[i] -= L[i][j] * b[j];
            b[i] /= L[i][i];
        }
        for (int i = NX - 1; i >= 0; i--) {
            for (int j = i + 1; j < NX; j++)
                b[i] -= L[j][i] * b[j];
            b[i] /= L[i][i];
        }
        for (int i = 0; i < NX; i++) {
            X[i][k] = 0.0;
            for (int j = 0; j < NX; j++)
                X[i][k] += (transposed ? A[j][i] : A[i][j]) * b[j];
        }
    }
}

/* Adds sign * V w to x. */
static void shift(double x[NX], double sign, double V[NX][NY], const double w[NY])
{
    for (int i = 0; i < NX; i++)
        for (int k = 0; k < NY; k++)
            x[i] += sign * V[i][k] * w[k];
}

/* Adds sign * V W^T to P. */
static void add(double P[NX][NX], double sign, double V[NX][NY], double W[NX][NY])
{
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++)
            for (int k = 0; k < NY; k++)
                P[i][j] += sign * V[i][k] * W[j][k];
}

/* Computes, by sigma points, the mean (n) and covariance (n, n) of a function of a Gaussian with mean x and covariance
   P, and the covariance (NX, n) of x and the function. */
static void transform(void (*function)(const double *, const real *, double *), int n, const double x[NX],
                      double P[NX][NX], const real *u, double *mean, double *S, double *across)
{
    double L[NX][NX], s[NX], to[1 + 2 * NX][NX > NY ? NX : NY];
    factorise(P, L);
    for (int p = 0; p <= 2 * NX; p++) {
        int column = p ? (p - 1) / 2 : NX;
        for (int i = 0; i < NX; i++)
            s[i] = i < column ? x[i] : x[i] + (p % 2 ? FAR : -FAR) * L[i][column];
        function(s, u, to[p]);
        for (int i = 0; i < n && function == measure; i++)
            to[p][i] = isfinite(to[p][i]) ? to[p][i] : to[0][i];
    }
    for (int i = 0; i < n; i++) {
        mean[i] = MIDDLE * to[0][i];
        for (int p = 1; p <= 2 * NX; p++)
            mean[i] += OTHER * to[p][i];
        for (int p = 0; p <= 2 * NX; p++)
            to[p][i] -= mean[i];
        for (int j = 0; j <= i; j++) {
            S[i * n + j] = MIDDLE_SQUARES * to[0][i] * to[0][j];
            for (int p = 1; p <= 2 * NX; p++)
                S[i * n + j] += OTHER * to[p][i] * to[p][j];
            S[j * n + i] = S[i * n + j];
        }
        for (int k = 0; k < NX; k++) {
            across[k * n + i] = 0.0;
            for (int j = 0; j <= k; j++)
                across[k * n + i] += OTHER * FAR * L[k][j] * (to[1 + 2 * j][i] - to[2 + 2 * j][i]);
        }
    }
}

typedef struct {
    double x[NX], P[NX][NX], across[NX][NX]; /* mean, covariance, and covariance with the last states */
} prediction;

typedef struct {
    double V[NX][NY], white[NY], expected[NY]; /* the corrected mean is x + V white, the covariance P - V V^T */
} correction;

static prediction predict(const double x[NX], double P[NX][NX], const real *u)
{
    prediction p;
    transform(move, NX, x, P, u, p.x, p.P[0], p.across[0]);
    for (int i = 0; i < NX; i++)
        p.P[i][i] += Q[i];
    return p;
}

/* Returns the correction by a sample, in which NaN marks missing outputs. */
static correction correct(prediction *p, const real y[NY])
{
    correction c;
    double S[NY][NY];
    transform(measure, NY, p->x, p->P, NULL, c.expected, S[0], c.V[0]);
    for (int k = 0; k < NY; k++)
        c.white[k] = y[k] - c.expected[k];
    for (int k = 0; k < NY; k++) {
        double root = sqrt(S[k][k] + R[k]);
        int missing = isnan(y[k]);
        c.white[k] = missing ? 0.0 : c.white[k] / root;
        for (int i = 0; i < NX; i++)
            c.V[i][k] = missing ? 0.0 : c.V[i][k] / root;
        for (int l = k + 1; l < NY && !missing; l++) {
            double share = S[l][k] / root;
            c.white[l] -= share * c.white[k];
            for (int i = 0; i < NX; i++)
                c.V[i][l] -= share * c.V[i][k];
            for (int m = k + 1; m <= l; m++)
                S[l][m] -= share * S[m][k] / root;
        }
    }
    return c;
}

/* Predicts again, with the motion linearised about the last state as smoothed by the sample. */
static void relinearise(NAME_observer *observer, prediction *p, const real y[NY], const real *u)
{
    correction c = correct(p, y);
    prediction start, again;
    double G[NX][NY], D[NX][NY], L[NX][NX], total;
    weigh(p->across, 0, p->P, c.V, G);
    memcpy(start.x, observer->x, sizeof start.x);
    memcpy(start.P, observer->P, sizeof start.P);
    shift(start.x, 1.0, G, c.white);
    add(start.P, -1.0, G, G);
    again = predict(start.x, start.P, u);
    weigh(again.across, 1, start.P, G, D);
    shift(again.x, -1.0, D, c.white);
    add(again.P, 1.0, D, D);
    add(again.across, 1.0, G, D);
    total = factorise(again.P, L);
    for (int i = 0; i < NX; i++)
        total += again.x[i];
    if (isfinite(total))
        *p = again;
}

/* Resets the statistics of the innovations. */
static void restart_watch(NAME_observer *observer)
{
    observer->nis = observer->trend_square = 1.0;
    memset(observer->trend, 0, sizeof observer->trend);
}

/* Corrects a prediction by a sample. If the result is not finite, or at the start not positive definite, the observer
   keeps its last estimate, and an infinite NIS marks a divergence. */
static correction take_in(NAME_observer *observer, prediction *p, const real y[NY], int starts)
{
    correction c = correct(p, y);
    double L[NX][NX], total;
    shift(p->x, 1.0, c.V, c.white);
    add(p->P, -1.0, c.V, c.V);
    total = starts ? factorise(p->P, L) : 0.0;
    for (int i = 0; i < NX; i++) {
        total += p->x[i];
        p->x[i] = within(p->x[i], i);
        for (int j = 0; j < NX; j++)
            total += p->P[i][j];
    }
    if (isfinite(total)) {
        memcpy(observer->x, p->x, sizeof p->x);
        memcpy(observer->P, p->P, sizeof p->P);
    } else {
        observer->nis = INFINITY;
    }
    return c;
}

/* Predicts, and corrects by the sample y. In whole, predicted outputs replace missing ones. */
static void track(NAME_observer *observer, const real y[NY], const real *u, real whole[NY])
{
    double squared = 0.0, raised = 0.0;
    int count = 0;
    prediction p = predict(observer->x, observer->P, u);
    for (int turn = 0; turn < RELINEARISATIONS && observer->seen < WINDOW; turn++)
        relinearise(observer, &p, y, u);
    correction c = take_in(observer, &p, y, 0);
    for (int k = 0; k < NY; k++) {
        whole[k] = !isnan(y[k]) ? y[k] : isfinite(c.expected[k]) ? (real)c.expected[k] : observer->y[k];
        if (isnan(y[k]) || isinf(observer->nis))
            continue;
        observer->trend[k] += TREND_SHARE * (c.white[k] - observer->trend[k]);
        raised += observer->trend[k] * observer->trend[k];
        squared += c.white[k] * c.white[k];
        count++;
    }
    if (!count)
        return;
    observer->nis += SHARE * count / NY * (squared / count - observer->nis);
    observer->trend_square += TREND_SQUARE_SHARE * count / NY * (TREND_GAIN * raised / count - observer->trend_square);
    if (observer->seen < WINDOW)
        observer->seen++;
    if (observer->trend_square > TREND_LIMIT) { /* the innovations are correlated */
        observer->trend_square = 1.0;
        memset(observer->trend, 0, sizeof observer->trend);
        for (int i = 0; i < NX * NX; i++)
            observer->P[i / NX][i % NX] *= INFLATION;
    }
}

/* Replaces the estimate by T_inv's after a divergence, and in the first window if T_inv's covariance is smaller. */
static void supervise(NAME_observer *observer)
{
    int lost = !(observer->nis <= LIMIT); /* also if the NIS is NaN */
    double P[NX][NX], L[NX][NX];
    real x_hat[NX];
    if (!lost && observer->seen >= WINDOW)
        return;
    /* The cause of a divergence may have disturbed z, too: T_inv's covariance is that of an age of at most a window. */
// if free
    if (untouched(observer))
        tabulated(free_covariance, free_ages, (double)observer->seen, P);
    else
// end free
        tabulated(driven_covariance, driven_ages, (double)observer->seen, P);
    if (!lost && !(factorise(P, L) < factorise(observer->P, L)))
        return;
    invert(observer, x_hat);
    for (int i = 0; i < NX; i++)
        observer->x[i] = within((x_hat[i] - x_offset[i]) / x_scale[i], i);
    memcpy(observer->P, P, sizeof P);
    if (lost)
        restart_watch(observer);
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
    memset(observer->z, 0, sizeof observer->z);
    for (int j = 0; j < NY; j++) {
        for (int i = 0; i < NZ; i++)
            observer->z[i] += equilibrium[i][j] * y[j];
        observer->y[j] = y[j];
    }
// if tracks
    prediction start;
    memcpy(start.x, start_mean, sizeof start.x);
    memcpy(start.P, start_covariance, sizeof start.P);
    memcpy(observer->x, start.x, sizeof start.x);
    memcpy(observer->P, start.P, sizeof start.P);
    take_in(observer, &start, y, 1);
    restart_watch(observer);
    observer->seen = 0;
    supervise(observer);
// end tracks
}

/* Multiplies one block of the filter's state by the transition matrix. */
static void advance(double *z)
{
    double next[NZ] = {0.0};
    for (int k = 0; k < TRANSITIONS; k++)
        next[transition_row[k]] += transition[k] * z[transition_column[k]];
    memcpy(z, next, sizeof next);
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
