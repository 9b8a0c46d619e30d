/* Model (1): x' = A x + H g(t, x) + B sec(u), y = C x, with A, H, B, C as parameters.
 *
 * `agent_functions.h` (generated) holds M, P, Q and the functions g, sec and their slopes. */
#include "agent_functions.h"
#include "model.h"

enum { AT_A = 0, AT_H = M * M, AT_B = 2 * M * M, AT_C = 2 * M * M + M * P };

/* to += W from, with W of shape (rows, columns) */
static void add_product(double *to, const double *W, const double *from, int rows, int columns)
{
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++)
            to[i] += W[i * columns + j] * from[j];
}

static void clear(double *values, int n)
{
    for (int i = 0; i < n; i++)
        values[i] = 0;
}

void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx)
{
    double g[M], sec[P];
    agent_g(t, x, g);
    agent_sec(u, sec);
    clear(dx, M);
    add_product(dx, p + AT_A, x, M, M);
    add_product(dx, p + AT_H, g, M, M);
    add_product(dx, p + AT_B, sec, M, P);
}

void model_outputs(double t, const double *p, const double *u, const double *x, double *y)
{
    (void)t;
    (void)u;
    clear(y, Q);
    add_product(y, p + AT_C, x, Q, M);
}

void model_directional(double t, const double *p, const double *u, const double *x,
                       const double *su, const double *sx, double *sdx, double *sy)
{
    double slope_g[M * M], slope_sec[P], sg[M], ssec[P];
    agent_g_slope(t, x, slope_g);
    agent_sec_slope(u, slope_sec);
    clear(sg, M);
    add_product(sg, slope_g, sx, M, M);
    for (int k = 0; k < P; k++)
        ssec[k] = slope_sec[k] * su[k];
    clear(sdx, M);
    add_product(sdx, p + AT_A, sx, M, M);
    add_product(sdx, p + AT_H, sg, M, M);
    add_product(sdx, p + AT_B, ssec, M, P);
    clear(sy, Q);
    add_product(sy, p + AT_C, sx, Q, M);
}
