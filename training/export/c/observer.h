/*
 * NAME: a learned KKL observer of SYSTEM, for samples every SECONDS s.
 *
 * Written by kkl-gym VERSION from SOURCE, SHA-256
 * CHECKSUM
 *
 * y:     OUTPUTS
// if inputs
 * u:     INPUTS
// end inputs
 * x_hat: ESTIMATES
 *
 * NAME_reset takes the first sample, NAME_step every later sample.
// if static
 * Samples and inputs must be finite: after a NaN, all estimates are NaN until the next reset.
// end static
// if tracks
 * Pass NaN for a missing output: the observer predicts it. The first sample and all inputs must be finite. Compile
 * without -ffast-math, which assumes that there is no NaN.
// end tracks
 * The functions allocate no memory, and use no variables but constants and the observer that is passed to them.
 * The observer assumes measurement noise of standard deviation LEVELS and process noise of level PROCESS.
 */
#ifndef MACRO_H
#define MACRO_H

#ifdef __cplusplus
extern "C" {
#endif

#define MACRO_NX COUNT_X /* estimates */
#define MACRO_NY COUNT_Y /* outputs */
#define MACRO_NU COUNT_U /* inputs */
#define MACRO_DT SECONDS /* seconds from sample to sample */

typedef PRECISION NAME_real;

typedef struct {
    double z[COUNT_Z]; /* the filter's state */
    NAME_real y[MACRO_NY]; /* the last sample */
    unsigned long age; /* samples since reset, counted up to the largest age that T_inv distinguishes */
// if tracks
    double x[MACRO_NX], P[MACRO_NX][MACRO_NX]; /* the estimate and its covariance, in scaled states */
    double nis; /* running mean square of the whitened innovations */
    double trend[MACRO_NY]; /* running mean of the whitened innovations */
    double trend_square; /* scaled running mean square of the trend, on average 1 if the innovations are white */
    unsigned long seen; /* samples with at least one output, counted up to the averaging window of nis */
// end tracks
} NAME_observer;

/* Starts, or starts again, at a first sample. */
void NAME_reset(NAME_observer *observer, const NAME_real y[MACRO_NY]);

// if inputs
/* Processes the next sample and the input that was held since the last sample, and writes the estimate to x_hat. */
void NAME_step(NAME_observer *observer, const NAME_real y[MACRO_NY], const NAME_real u[MACRO_NU],
               NAME_real x_hat[MACRO_NX]);
// end inputs
// if autonomous
/* Processes the next sample, and writes the estimate to x_hat. */
void NAME_step(NAME_observer *observer, const NAME_real y[MACRO_NY], NAME_real x_hat[MACRO_NX]);
// end autonomous

/* Writes the current estimate to x_hat, such as the first estimate after a reset. */
void NAME_estimate(const NAME_observer *observer, NAME_real x_hat[MACRO_NX]);

#ifdef __cplusplus
}
#endif

#endif
