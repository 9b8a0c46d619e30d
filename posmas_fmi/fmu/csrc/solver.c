/* Dormand and Prince's explicit Runge-Kutta pair of order 5(4) with error control per step
 * (J. Comput. Appl. Math. 6 (1980) 19-26; Hairer, Norsett, Wanner: Solving ODEs I, II.4-II.5).
 *
 * The seventh slope of an accepted step is the first of the next, so a step costs six evaluations,
 * and a seventh where an input or parameter changed in between. */
#include "advance.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum { MAX_STEPS = 10000000 };

#define NX MODEL_NX

static const double C[7] = {0, 1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1, 1};
static const double A[7][6] = {
    {0},
    {1.0 / 5},
    {3.0 / 40, 9.0 / 40},
    {44.0 / 45, -56.0 / 15, 32.0 / 9},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
    {35.0 / 384, 0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84},
};
/* Difference of the two solutions. */
static const double E[7] = {71.0 / 57600,      0,          -71.0 / 16695, 71.0 / 1920,
                            -17253.0 / 339200, 22.0 / 525, -1.0 / 40};

static int all_finite(const double *x)
{
    for (int i = 0; i < NX; i++)
        if (!isfinite(x[i]))
            return 0;
    return 1;
}

static double scale(const State *s, int i, double x)
{
    return s->tolerance * (model_nominal[i] + fabs(x));
}

/* A first step size from the sizes of x, f and the change of f along an Euler step. */
static double first_step(Instance *c, double end)
{
    const State *s = &c->state;
    const double t = s->v[AT_TIME], *x = s->v + AT_X;
    double d0 = 0, d1 = 0, d2 = 0;
    for (int i = 0; i < NX; i++) {
        d0 = fmax(d0, fabs(x[i]) / scale(s, i, x[i]));
        d1 = fmax(d1, fabs(c->k[0][i]) / scale(s, i, x[i]));
    }
    double h0 = d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1;
    h0 = fmin(h0, end - t);
    for (int i = 0; i < NX; i++)
        c->xs[i] = x[i] + h0 * c->k[0][i];
    model_derivatives(t + h0, s->v + AT_P, s->v + AT_U, c->xs, c->k[1]);
    for (int i = 0; i < NX; i++)
        d2 = fmax(d2, fabs(c->k[1][i] - c->k[0][i]) / scale(s, i, x[i]) / h0);
    double steepest = fmax(d1, d2);
    double h1 = steepest <= 1e-15 ? fmax(1e-6, 1e-3 * h0) : pow(0.01 / steepest, 0.2);
    double h = fmin(100 * h0, h1);
    return isfinite(h) && h > 0 ? h : h0; /* not finite: leave it to error control */
}

/* One trial step of length h from time t: the new state in xs, its slope in k[6]. Returns the
 * largest error estimate over its allowance: at most 1 is good, NaN means not finite. */
static double trial(Instance *c, double t, double h)
{
    const State *s = &c->state;
    const double *x = s->v + AT_X;
    for (int stage = 1; stage < 7; stage++) {
        for (int i = 0; i < NX; i++) {
            double slope = 0;
            for (int j = 0; j < stage; j++)
                slope += A[stage][j] * c->k[j][i];
            c->xs[i] = x[i] + h * slope;
        }
        model_derivatives(t + C[stage] * h, s->v + AT_P, s->v + AT_U, c->xs, c->k[stage]);
    }
    double worst = 0;
    for (int i = 0; i < NX; i++) {
        double error = 0;
        for (int j = 0; j < 7; j++)
            error += E[j] * c->k[j][i];
        error = fabs(h * error) / scale(s, i, fmax(fabs(x[i]), fabs(c->xs[i])));
        if (!(error <= worst))
            worst = error; /* keeps NaN: a comparison with it is false */
        if (worst != worst)
            return worst;
    }
    return all_finite(c->k[6]) ? worst : NAN;
}

/* By which factor the step may grow (or must shrink) after this error, order 5. */
static double growth(double error)
{
    if (error < 1e-4)
        return 5;
    return fmin(5, fmax(0.2, 0.9 * pow(error, -0.2)));
}

const char *instance_advance(Instance *c, double end)
{
    State *s = &c->state;
    double *x = s->v + AT_X, t = s->v[AT_TIME];
    const double begin = t;
    if (NX == 0) {
        s->v[AT_TIME] = end;
        return NULL;
    }
    if (!s->dx_known)
        model_derivatives(t, s->v + AT_P, s->v + AT_U, x, s->v + AT_DX);
    memcpy(c->k[0], s->v + AT_DX, sizeof c->k[0]);
    memcpy(c->x0, x, sizeof c->x0);
    if (!all_finite(c->k[0]))
        return "the derivatives are not finite";
    const double kept = s->step;
    if (s->step <= 0)
        s->step = first_step(c, end);

    const char *why = NULL;
    int stuck_on_nan = 0;
    for (int n = 0; n < MAX_STEPS; n++) {
        double left = end - t, h = s->step;
        int last = h >= left * (1 - 1e-9);
        if (last)
            h = left;
        else if (h > 0.5 * left)
            h = 0.5 * left; /* two even steps instead of one and a sliver */
        if (!last && h <= 4 * DBL_EPSILON * fmax(fabs(t), fabs(end))) {
            why = stuck_on_nan ? "the states or derivatives become infinite or undefined"
                               : "the step size fell below the resolution of time";
            break;
        }
        double error = trial(c, t, h);
        if (!(error <= 1)) {
            stuck_on_nan = !isfinite(error);
            s->step = h * (stuck_on_nan ? 0.1 : growth(error));
            continue;
        }
        t = last ? end : t + h;
        memcpy(x, c->xs, sizeof c->xs);
        memcpy(c->k[0], c->k[6], sizeof c->k[0]);
        double factor = growth(error);
        if (factor < 1 || h * factor > s->step)
            s->step = h * factor; /* a step cut short by `end` says nothing against a longer one */
        if (last) {
            s->v[AT_TIME] = end;
            memcpy(s->v + AT_DX, c->k[6], sizeof c->k[6]);
            s->dx_known = 1;
            return NULL;
        }
    }
    memcpy(x, c->x0, sizeof c->x0);
    s->v[AT_TIME] = begin;
    s->step = kept;
    return why ? why : "the step needs more than ten million solver steps";
}
