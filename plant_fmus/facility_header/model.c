/* The facility water that all lines share: header pressure, supply volume, cooler with wet-bulb
 * limit and chiller. Values and their derivatives in a direction are computed side by side. */
#include "model.h"

#include <math.h>

enum { LINES = 64 };
enum {
    P_RESISTANCE,
    P_KV_NOMINAL,
    P_HEADER_TIME,
    P_CAPACITY,
    P_SET_POINT,
    P_CONTROL,
    P_COOLER,
    P_CHILLER
};
enum { U_KV, U_KV_OTHERS = LINES, U_HEAT, U_WET_BULB };
enum { X_HEADER, X_SUPPLY, X_IN, X_OUT };

typedef struct {
    double header; /* where the pressure settles, 1 nominal */
    double heat;   /* [W] from the lines */
    double rejected; /* [W] to the outside */
} Flows;

static void flows(const double *p, const double *u, const double *x, const double *su,
                  const double *sx, Flows *f, Flows *d)
{
    double S = u[U_KV_OTHERS], dS = su[U_KV_OTHERS];
    for (int i = 0; i < LINES; i++) {
        S += u[U_KV + i];
        dS += su[U_KV + i];
    }
    double share = S / p[P_KV_NOMINAL], R = p[P_RESISTANCE];
    f->header = (1 + R) / (1 + R * share * share);
    d->header = -f->header * 2 * R * share / (1 + R * share * share) * dS / p[P_KV_NOMINAL];

    f->heat = u[U_HEAT];
    d->heat = su[U_HEAT];

    /* The control asks for heat in proportion to the deviation; the cooler gives at most what the
     * wet bulb allows, and the chiller its rating on top. */
    double wanted = p[P_CONTROL] * (x[X_SUPPLY] - p[P_SET_POINT]);
    double above = x[X_SUPPLY] - u[U_WET_BULB];
    double most = p[P_COOLER] * fmax(above, 0) + p[P_CHILLER];
    if (wanted <= 0) {
        f->rejected = d->rejected = 0;
    } else if (wanted < most) {
        f->rejected = wanted;
        d->rejected = p[P_CONTROL] * sx[X_SUPPLY];
    } else {
        f->rejected = most;
        d->rejected = above > 0 ? p[P_COOLER] * (sx[X_SUPPLY] - su[U_WET_BULB]) : 0;
    }
}

static void balances(const double *p, const Flows *f, double header, double *dx)
{
    dx[X_HEADER] = (f->header - header) / p[P_HEADER_TIME];
    dx[X_SUPPLY] = (f->heat - f->rejected) / p[P_CAPACITY];
    dx[X_IN] = f->heat;
    dx[X_OUT] = f->rejected;
}

static void outputs(const double *p, const Flows *f, const double *x, double from, double *y)
{
    y[0] = x[X_HEADER];
    y[1] = x[X_SUPPLY];
    y[2] = f->rejected;
    y[3] = p[P_CAPACITY] * (x[X_SUPPLY] - from);
}

static const double nothing_u[MODEL_NU_ROOM], nothing_x[MODEL_NX_ROOM];

void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx)
{
    Flows f, d;
    (void)t;
    flows(p, u, x, nothing_u, nothing_x, &f, &d);
    balances(p, &f, x[X_HEADER], dx);
}

void model_outputs(double t, const double *p, const double *u, const double *x, double *y)
{
    Flows f, d;
    (void)t;
    flows(p, u, x, nothing_u, nothing_x, &f, &d);
    outputs(p, &f, x, 273.15, y);
}

void model_directional(double t, const double *p, const double *u, const double *x,
                       const double *su, const double *sx, double *sdx, double *sy)
{
    Flows f, d;
    (void)t;
    flows(p, u, x, su, sx, &f, &d);
    balances(p, &d, sx[X_HEADER], sdx);
    outputs(p, &d, sx, 0, sy);
}
