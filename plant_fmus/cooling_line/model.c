/* A liquid-cooling line: cold plates, rack and pipe volumes, pump, CDU heat exchanger, valve.
 *
 * Heat and coolant flows are computed once, with their derivatives in a direction beside them; the
 * balances are linear in them. Every coefficient between two temperatures is non-negative for every
 * flow and valve position: the plate's by `contact`, the exchanger's since kappa <= coolant flow. */
#include "model.h"

#include <math.h>

enum {
    P_UA,
    P_PLATE_UA,
    P_COOLANT_FLOW,
    P_WATER_FLOW,
    P_WATER_HEAT,
    P_C_PLATE,
    P_C_RETURN,
    P_C_RETURN_PIPE,
    P_C_SUPPLY,
    P_C_SUPPLY_PIPE,
    P_LEAKAGE,
    P_LEAKAGE_FROM,
    P_RANGEABILITY,
    P_AUTHORITY,
    P_STROKE_TIME,
    P_POSITIONER_TIME,
    P_PUMP_TIME
};
enum { U_HEAT, U_VALVE, U_PUMP, U_HEADER, U_FACILITY };
enum { X_PLATE, X_RETURN, X_RETURN_PIPE, X_SUPPLY, X_SUPPLY_PIPE, X_VALVE, X_PUMP, X_IN, X_OUT };

typedef struct {
    double released;        /* [W] by the electronics, leakage included */
    double picked_up;       /* [W] plate to coolant */
    double cooled;          /* [W] coolant to facility water */
    double to_return;       /* [W] carried by the coolant into each volume */
    double to_return_pipe;
    double to_supply;
    double to_supply_pipe;
    double valve_rate;      /* [1/s] */
    double pump_rate;       /* [1/s] */
    double kv;              /* flow coefficient of the primary circuit, 1 when the valve is open */
    double water_flow;      /* [kg/s] */
} Flows;

static double x_coth_x(double x)
{
    return fabs(x) < 1e-3 ? 1 + x * x / 3 : x / tanh(x);
}

static double x_coth_x_slope(double x)
{
    if (fabs(x) < 1e-3)
        return 2 * x / 3;
    if (fabs(x) > 300) /* sinh overflows later than this */
        return x > 0 ? 1 : -1;
    return 1 / tanh(x) - x / (sinh(x) * sinh(x));
}

/* Counterflow heat exchanger (epsilon-NTU): heat per kelvin between the inlets of two streams,
 * 1/kappa = (1/a + 1/b)/2 + (q/2) coth(q/2)/UA with q = UA (1/a - 1/b). */
static double exchanger(double UA, double a, double b, double *by_a, double *by_b)
{
    const double none = 1e-12; /* [W/K] */
    if (a <= none || b <= none) { /* a stream stands still */
        *by_a = b > none ? 1 : 0;
        *by_b = a > none ? 1 : 0;
        return 0;
    }
    double half_q = UA * (1 / a - 1 / b) / 2, slope = x_coth_x_slope(half_q);
    double kappa = 1 / ((1 / a + 1 / b) / 2 + x_coth_x(half_q) / UA);
    *by_a = (kappa / a) * (kappa / a) * (1 + slope) / 2;
    *by_b = (kappa / b) * (kappa / b) * (1 - slope) / 2;
    return kappa;
}

/* Isothermal plate: heat per kelvin between it and the mean coolant temperature; at most twice the
 * coolant's capacity flow, so that no more is picked up than the coolant can take. */
static double contact(double UA, double flow, double *by_flow)
{
    if (flow <= 0) {
        *by_flow = 2;
        return 0;
    }
    double z = UA / (2 * flow), t = tanh(z);
    *by_flow = 2 * t - 2 * z * (1 - t * t);
    return 2 * flow * t;
}

/* Heat that a coolant flow brings into one volume from the one before it, net. */
static double carried(double flow, const double *x, int from, int into)
{
    return flow * (x[from] - x[into]);
}

/* The flows in f, and in d their derivative in the direction (su, sx). */
static void flows(const double *p, const double *u, const double *x, const double *su,
                  const double *sx, Flows *f, Flows *d)
{
    double by_a, by_b, by_flow;

    /* Coolant, by the pump's speed. */
    double w = p[P_COOLANT_FLOW] * fmax(x[X_PUMP], 0);
    double dw = x[X_PUMP] >= 0 ? p[P_COOLANT_FLOW] * sx[X_PUMP] : 0;
    f->pump_rate = (fmax(u[U_PUMP], 0) - x[X_PUMP]) / p[P_PUMP_TIME];
    d->pump_rate = ((u[U_PUMP] >= 0 ? su[U_PUMP] : 0) - sx[X_PUMP]) / p[P_PUMP_TIME];

    /* Valve: limited in its range and in its speed. */
    double inside = u[U_VALVE] >= 0 && u[U_VALVE] <= 1;
    double fastest = 1 / p[P_STROKE_TIME];
    double wanted = (fmin(fmax(u[U_VALVE], 0), 1) - x[X_VALVE]) / p[P_POSITIONER_TIME];
    f->valve_rate = fmin(fmax(wanted, -fastest), fastest);
    d->valve_rate =
        fabs(wanted) < fastest ? (inside * su[U_VALVE] - sx[X_VALVE]) / p[P_POSITIONER_TIME] : 0;

    /* Facility water: equal-percentage valve in series with the rest of the circuit. */
    double log_r = log(p[P_RANGEABILITY]);
    double closing = p[P_AUTHORITY] * exp(2 * log_r * (1 - x[X_VALVE])); /* N/phi^2 */
    f->kv = 1 / sqrt(closing + 1 - p[P_AUTHORITY]);
    d->kv = f->kv * f->kv * f->kv * closing * log_r * sx[X_VALVE];
    double root = sqrt(fmax(u[U_HEADER], 0));
    double droot = root > 0 ? su[U_HEADER] / (2 * root) : 0;
    f->water_flow = p[P_WATER_FLOW] * f->kv * root;
    d->water_flow = p[P_WATER_FLOW] * (d->kv * root + f->kv * droot);

    /* Heat exchanger, from the return pipe's temperature to the facility's. */
    double water = p[P_WATER_HEAT] * f->water_flow, dwater = p[P_WATER_HEAT] * d->water_flow;
    double kappa = exchanger(p[P_UA], w, water, &by_a, &by_b);
    double dkappa = by_a * dw + by_b * dwater;
    double drop = x[X_RETURN_PIPE] - u[U_FACILITY];
    f->cooled = kappa * drop;
    d->cooled = dkappa * drop + kappa * (sx[X_RETURN_PIPE] - su[U_FACILITY]);

    /* Electronics and cold plates. */
    double leak = 1 + p[P_LEAKAGE] * (x[X_PLATE] - p[P_LEAKAGE_FROM]);
    f->released = u[U_HEAT] * leak;
    d->released = su[U_HEAT] * leak + u[U_HEAT] * p[P_LEAKAGE] * sx[X_PLATE];
    double G = contact(p[P_PLATE_UA], w, &by_flow), dG = by_flow * dw;
    double over = x[X_PLATE] - (x[X_RETURN] + x[X_SUPPLY_PIPE]) / 2;
    f->picked_up = G * over;
    d->picked_up = dG * over + G * (sx[X_PLATE] - (sx[X_RETURN] + sx[X_SUPPLY_PIPE]) / 2);

    /* Coolant from volume to volume. */
    f->to_return = carried(w, x, X_SUPPLY_PIPE, X_RETURN);
    d->to_return = carried(dw, x, X_SUPPLY_PIPE, X_RETURN) + carried(w, sx, X_SUPPLY_PIPE, X_RETURN);
    f->to_return_pipe = carried(w, x, X_RETURN, X_RETURN_PIPE);
    d->to_return_pipe = carried(dw, x, X_RETURN, X_RETURN_PIPE) + carried(w, sx, X_RETURN, X_RETURN_PIPE);
    f->to_supply = carried(w, x, X_RETURN_PIPE, X_SUPPLY);
    d->to_supply = carried(dw, x, X_RETURN_PIPE, X_SUPPLY) + carried(w, sx, X_RETURN_PIPE, X_SUPPLY);
    f->to_supply_pipe = carried(w, x, X_SUPPLY, X_SUPPLY_PIPE);
    d->to_supply_pipe = carried(dw, x, X_SUPPLY, X_SUPPLY_PIPE) + carried(w, sx, X_SUPPLY, X_SUPPLY_PIPE);
}

/* Balances: linear in the flows, so they serve derivatives and directions alike. */
static void balances(const double *p, const Flows *f, double *dx)
{
    dx[X_PLATE] = (f->released - f->picked_up) / p[P_C_PLATE];
    dx[X_RETURN] = (f->picked_up + f->to_return) / p[P_C_RETURN];
    dx[X_RETURN_PIPE] = f->to_return_pipe / p[P_C_RETURN_PIPE];
    dx[X_SUPPLY] = (f->to_supply - f->cooled) / p[P_C_SUPPLY];
    dx[X_SUPPLY_PIPE] = f->to_supply_pipe / p[P_C_SUPPLY_PIPE];
    dx[X_VALVE] = f->valve_rate;
    dx[X_PUMP] = f->pump_rate;
    dx[X_IN] = f->released;
    dx[X_OUT] = f->cooled;
}

static double stored(const double *p, const double *x, double from)
{
    return p[P_C_PLATE] * (x[X_PLATE] - from) + p[P_C_RETURN] * (x[X_RETURN] - from) +
           p[P_C_RETURN_PIPE] * (x[X_RETURN_PIPE] - from) + p[P_C_SUPPLY] * (x[X_SUPPLY] - from) +
           p[P_C_SUPPLY_PIPE] * (x[X_SUPPLY_PIPE] - from);
}

static void outputs(const double *p, const Flows *f, const double *x, double from, double *y)
{
    y[0] = x[X_SUPPLY];
    y[1] = x[X_RETURN_PIPE];
    y[2] = x[X_PLATE];
    y[3] = x[X_VALVE];
    y[4] = f->kv;
    y[5] = f->cooled;
    y[6] = f->water_flow;
    y[7] = f->released;
    y[8] = stored(p, x, from);
}

static const double nothing_u[MODEL_NU_ROOM], nothing_x[MODEL_NX_ROOM];

void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx)
{
    Flows f, d;
    (void)t;
    flows(p, u, x, nothing_u, nothing_x, &f, &d);
    balances(p, &f, dx);
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
    balances(p, &d, sdx);
    outputs(p, &d, sx, 0, sy);
}
