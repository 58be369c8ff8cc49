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
 * NAME_reset takes in the first sample, NAME_step every later one.
// if static
 * Samples and inputs must be finite: a NaN stays until the next reset.
// end static
// if tracks
 * Where an output is missing, pass NaN: it is predicted. The first sample and inputs must be finite, and the compiler
 * must know NaN, as it does without -ffast-math.
// end tracks
 * Nothing is allocated, and observers share constants alone.
 * It assumes measurement noise of standard deviation LEVELS and process noise of level PROCESS.
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
    unsigned long age; /* samples since the first, as far as that matters */
// if tracks
    double x[MACRO_NX], P[MACRO_NX][MACRO_NX]; /* the estimate and its covariance, in scaled states */
    double nis; /* mean square of the innovations in units of their standard deviations */
    double trend[MACRO_NY], trend_square; /* their running mean, and its mean square: 1 where they are white */
    unsigned long seen; /* samples of which anything was there, as far as that matters */
// end tracks
} NAME_observer;

/* Forget the past and take in the first sample. */
void NAME_reset(NAME_observer *observer, const NAME_real y[MACRO_NY]);

// if inputs
/* Take in the next sample and the input that was held since the last, and estimate. */
void NAME_step(NAME_observer *observer, const NAME_real y[MACRO_NY], const NAME_real u[MACRO_NU],
               NAME_real x_hat[MACRO_NX]);
// end inputs
// if autonomous
/* Take in the next sample, and estimate. */
void NAME_step(NAME_observer *observer, const NAME_real y[MACRO_NY], NAME_real x_hat[MACRO_NX]);
// end autonomous

/* The estimate as things stand, which is what step gives too: after reset, the first. */
void NAME_estimate(const NAME_observer *observer, NAME_real x_hat[MACRO_NX]);

#ifdef __cplusplus
}
#endif

#endif
