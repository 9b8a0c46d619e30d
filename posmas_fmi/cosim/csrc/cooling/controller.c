/* See controller.h. */
#include "controller.h"

#include <math.h>

enum { RETURN, SUPPLY, POWER, VALVE, WATER }; /* of measured */
enum { X_PLATE, X_RETURN, X_SUPPLY, SHARED }; /* of a message */

/* What a law wants: v = proportional + integral + feedforward, and the growth of the integral. */
typedef struct {
    double proportional; /* [W] */
    double growth;       /* [W/s] */
    double integral;     /* 1: the integral acts, 0: it is forgotten */
} Wish;

static double or_else(double value, double otherwise)
{
    return isnan(value) ? otherwise : value;
}

static double clamp(double value, double low, double high)
{
    return fmin(fmax(value, low), high);
}

static double set_point(const Controller *c, double t)
{
    return t < c->set_at ? c->set_before : c->set_after;
}

/* Heat per kelvin that the exchanger takes at a valve position: ../../../cooling/exchanger.py. */
static double kappa(const Controller *c, double y)
{
    double kv = 1 / sqrt(c->N * exp(2 * c->log_R * (1 - y)) + 1 - c->N);
    double a = 1 / c->ws, b = 1 / (c->water_max * kv), half_q = c->UA * (a - b) / 2;
    double coth = fabs(half_q) < 1e-3 ? 1 + half_q * half_q / 3 : half_q / tanh(half_q);
    return 1 / ((a + b) / 2 + coth / c->UA);
}

/* The v that holds the set-point in the steady state that a load and a water temperature ask for:
 * released heat over the drop to the water is the kappa that it takes. */
static double forward(const Controller *c, double load, double water)
{
    const double high = c->kappa_low + (CURVE - 1) * c->kappa_step;
    double power = clamp(load, 0, c->load_most) * c->nominal;
    double heat = power * (1 + c->leakage * (c->set_before - c->plate0)) /
                  (1 - power * c->leakage * c->path);
    double drop = c->set_before + heat / c->ws - water;
    double wanted = heat < high * drop ? fmax(heat / drop, c->kappa_low) : high;
    double place = (wanted - c->kappa_low) / c->kappa_step;
    int k = (int)fmin(place, CURVE - 2);
    return c->curve[k] + (place - k) * (c->curve[k + 1] - c->curve[k]);
}

static void propagate(const Controller *c, const double *x, const double *held, double *next)
{
    for (int i = 0; i < M; i++) {
        next[i] = 0;
        for (int j = 0; j < M; j++)
            next[i] += c->full[M * i + j] * x[j] + c->gamma[M * i + j] * (c->rest[j] + held[j]);
    }
}

/* IT power over the nominal load. */
static double relative_load(const Controller *c, const double *own, const double *measured)
{
    return or_else(measured[POWER] / (own[OWN_SIZE] * c->nominal), 1);
}

/* The estimate at t + h: model with the measured load and the valve where it is, exact in A. */
static void observe(const Controller *c, const double *own, const double *measured, double v,
                    const double *x, double *next)
{
    double load = relative_load(c, own, measured) - 1;
    double water = or_else(measured[WATER] - c->water0, 0);
    double held[M] = {load * c->heating * (1 + c->leakage * (x[X_PLATE] - c->plate0)), 0, 0};
    double y = clamp(c->y0 - c->gain * v, own[OWN_LOW], own[OWN_HIGH]), k = kappa(c, y);
    held[X_SUPPLY] = (k * water - (k - c->kappa0) * x[X_RETURN]) / c->Cs;
    double innovation[Q] = {measured[RETURN] - x[X_RETURN], measured[SUPPLY] - x[X_SUPPLY]};
    for (int i = 0; i < M; i++)
        for (int j = 0; j < Q; j++)
            held[i] += c->E[Q * i + j] * innovation[j];
    propagate(c, x, held, next);
}

static Wish proportional_integral(const Controller *c, double error)
{
    return (Wish){-c->kp * error, -c->kp * error / c->Ti, 1};
}

static Wish wish(const Controller *c, const double *own, int mode, double t, const double *measured,
                 const double *disagreement, double reference)
{
    const Wish stay = {0, 0, 1};
    const double supply = measured[SUPPLY];
    const int law = (int)c->law;
    int knows = own[OWN_KNOWS] > 0;
    if (law == LAW_FIXED || (law == LAW_LOCAL && !knows))
        return stay;
    if (law == LAW_LOCAL || (law == LAW_TEAM && mode == MODE_FALLBACK))
        return proportional_integral(c, supply - set_point(c, t));
    if (law == LAW_TEAM) /* mean of the team: its digraph is complete */
        return proportional_integral(
            c, supply - disagreement[SHARED] / (own[OWN_DEGREE] + 1) - set_point(c, t));
    if (law == LAW_SET_POINT || mode == MODE_FALLBACK)
        return proportional_integral(c, supply - reference);
    Wish w = {0, law == LAW_INTEGRAL ? c->K_q * disagreement[SHARED] : 0, law == LAW_INTEGRAL};
    for (int j = 0; j < M; j++)
        w.proportional += c->K[j] * disagreement[j];
    return w;
}

/* What the line follows: its estimate of the set-point, or slowly what its neighbours agree on. */
static double next_reference(const Controller *c, const double *own, int mode,
                             const double *measured, const double *disagreement, double reference)
{
    if ((int)c->law == LAW_SET_POINT) /* explicit Euler: consensus x h x degree is kept below 1 */
        return reference -
               fmin(c->h * c->consensus, 1 / fmax(own[OWN_DEGREE], 1e-9)) * disagreement[SHARED];
    if (mode == MODE_FALLBACK || own[OWN_DEGREE] <= 0)
        return reference;
    double agreed = measured[SUPPLY] - disagreement[SHARED] / own[OWN_DEGREE];
    return reference - expm1(-c->h / c->reference_time) * (agreed - reference);
}

static int mode_of(const Controller *c, const double *own, double t, const double *silence)
{
    if (t >= own[OWN_MANUAL_FROM] && t < own[OWN_MANUAL_UNTIL])
        return MODE_MANUAL;
    int listens = (int)c->law != LAW_FIXED && (int)c->law != LAW_LOCAL && (int)c->law != LAW_SET_POINT;
    return listens && silence[0] > c->silence ? MODE_FALLBACK : MODE_LAW;
}

void controller_send(const Controller *c, const double *own, const double *memory,
                     const double *measured, double *message)
{
    (void)own;
    for (int i = 0; i < M; i++)
        message[i] = memory[i];
    message[SHARED] = (int)c->law == LAW_SET_POINT ? memory[MEM_REFERENCE] : measured[SUPPLY];
}

void controller_step(const Controller *c, const double *own, double t, const double *measured,
                     const double *disagreement, const double *silence, const double *memory,
                     double *next, double *u, double *applied)
{
    const int was = (int)memory[MEM_MODE], mode = mode_of(c, own, t, silence);
    const double supply = measured[SUPPLY], low = (c->y0 - own[OWN_HIGH]) / c->gain,
                 high = (c->y0 - own[OWN_LOW]) / c->gain, most = c->h * c->rate / c->gain;
    const double feedback = (c->y0 - measured[VALVE]) / c->gain;
    const double last = was == MODE_START ? clamp(or_else(feedback, 0), low, high) : memory[MEM_LAST];
    const int stuck = fabs(feedback - last) * c->gain > c->tolerance; /* not if it is NaN */

    /* Feedforward of the filtered IT power and water temperature. */
    const double share = -expm1(-c->h / c->ff_time), load_now = relative_load(c, own, measured),
                 water_now = or_else(measured[WATER] - c->water0, 0);
    double load = was == MODE_START ? load_now : memory[MEM_LOAD];
    double water = was == MODE_START ? water_now : memory[MEM_WATER];
    load += share * (load_now - load);
    water += share * (water_now - water);
    const double ahead = c->forward > 0 ? forward(c, load, water) : 0;

    /* The law; a change of mode is bumpless. */
    const double reference = memory[MEM_REFERENCE];
    const Wish w = wish(c, own, mode, t, measured, disagreement, reference);
    double integral = memory[MEM_INTEGRAL];
    if (mode != was && (was != MODE_START || w.integral > 0))
        integral = last - w.proportional - ahead;
    const double wanted = w.proportional + integral + ahead;

    /* Dew point: the larger of two controllers; the override waits at what was applied. */
    const double too_cold = c->floor - supply;
    const double override = memory[MEM_DEW] + c->kp * too_cold;
    const double guarded = was == MODE_START ? wanted : fmax(wanted, override);

    /* Valve. */
    const double asked =
        mode == MODE_MANUAL ? (c->y0 - own[OWN_MANUAL_VALVE]) / c->gain : guarded;
    const double v = clamp(clamp(asked, last - most, last + most), low, high);

    /* The integral follows what really happens. */
    const double real = stuck ? feedback : v;
    if (mode == MODE_MANUAL)
        integral = v - w.proportional - ahead;
    else if (w.integral > 0)
        integral += c->h * w.growth + fmin(c->h / c->tracking, 1) * (real - wanted);
    else
        integral *= 1 - fmin(c->h / c->tracking, 1);

    observe(c, own, measured, stuck ? feedback : (or_else(feedback, v) + v) / 2, memory, next);
    next[MEM_INTEGRAL] = integral;
    next[MEM_DEW] = was != MODE_START && override > wanted && mode != MODE_MANUAL
                        ? clamp(memory[MEM_DEW] + c->h * c->kp / c->Ti * too_cold, low, high)
                        : v;
    next[MEM_REFERENCE] = next_reference(c, own, mode, measured, disagreement, reference);
    next[MEM_LOAD] = load;
    next[MEM_WATER] = water;
    next[MEM_LAST] = v;
    next[MEM_MODE] = mode;
    u[0] = v;
    applied[0] = (c->kappa0 - kappa(c, c->y0 - c->gain * v)) * memory[X_RETURN];
}

/* The leader is the nominal line with a constant input that holds the set-point. */
void controller_leader(const Controller *c, double t, const double *memory, double *next)
{
    const double held[M] = {0, 0, c->lift * (set_point(c, t) - c->supply0)};
    propagate(c, memory, held, next);
    for (int i = M; i < MEMORY; i++)
        next[i] = 0;
    next[MEM_REFERENCE] = set_point(c, t + c->h);
}

void controller_leader_send(const Controller *c, const double *memory, double *message)
{
    (void)c;
    for (int i = 0; i < M; i++)
        message[i] = memory[i];
    message[SHARED] = memory[MEM_REFERENCE];
}
