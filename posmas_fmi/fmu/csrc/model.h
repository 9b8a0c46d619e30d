/* What a model is to the wrapper: sizes, a table of values and three functions.
 *
 * Every value of a model stands in one array of doubles,
 *
 *     time | parameters p | inputs u | states x | derivatives dx | outputs and locals y
 *
 * where a sampled model has no derivatives, and its memory (the last NM of x) with the states,
 *
 * and its value reference is its place in that array: of each element in FMI 2, of the first
 * element in FMI 3, where a variable may be an array. `model_data.h` (generated) holds the sizes,
 * `model_table.c` (generated) the tables, `model.c` the functions. */
#ifndef MODEL_H
#define MODEL_H

#include <stdint.h>

#include "model_data.h" /* MODEL_TOKEN, MODEL_NP, MODEL_NU, MODEL_NX, MODEL_NY,
                           MODEL_NM, MODEL_SAMPLED, MODEL_PERIOD */

enum {
    AT_TIME = 0,
    AT_P = 1,
    AT_U = AT_P + MODEL_NP,
    AT_X = AT_U + MODEL_NU,
    AT_DX = AT_X + MODEL_NX,
    AT_Y = AT_DX + (MODEL_SAMPLED ? 0 : MODEL_NX),
    MODEL_NV = AT_Y + MODEL_NY,
    MODEL_NX_ROOM = MODEL_NX > 0 ? MODEL_NX : 1, /* C has no arrays of length 0 */
    MODEL_NU_ROOM = MODEL_NU > 0 ? MODEL_NU : 1,
    MODEL_NY_ROOM = MODEL_NY > 0 ? MODEL_NY : 1
};

extern const double model_start[MODEL_NV];           /* start values (0 where computed) */
extern const uint32_t model_size[MODEL_NV];          /* elements of the FMI 3 variable that begins
                                                        here, 0 inside an array */
extern const char *const model_name[MODEL_NV];       /* for messages */
extern const double model_nominal[MODEL_NX_ROOM];    /* of the states */

/* y = h(t, p, u, x) */
void model_outputs(double t, const double *p, const double *u, const double *x, double *y);

#if MODEL_SAMPLED

/* What a sampled model remembers at the start. NULL, or why it cannot start. */
const char *model_begin(const double *p, const double *u, double *x);

/* What it does from t on: x at t becomes x at t + MODEL_PERIOD, u is that of t. */
void model_sample(double t, const double *p, const double *u, double *x);

#else

/* dx = f(t, p, u, x) */
void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx);

/* The derivative of (f, h) with respect to (u, x) in the direction (su, sx). */
void model_directional(double t, const double *p, const double *u, const double *x,
                       const double *su, const double *sx, double *sdx, double *sy);

#endif
#endif
