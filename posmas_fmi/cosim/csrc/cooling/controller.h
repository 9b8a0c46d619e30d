/* Controllers of a liquid-cooling line: seven laws inside one shell.
 *
 * The interface is that of ../protocol/controller.h: pure functions of one agent, no memory of their
 * own, no library but math.h. Temperatures are theta = T - water0; v [W] is the heat that the valve
 * retains relative to its nominal position, per nominal line: valve = y0 - gain v. A line of another
 * size retains in proportion, so all lines share the gains and differ in `own`.
 *
 * The law gives v_wanted = proportional + integral + feedforward. The shell around it is the same for
 * all: dew-point override, limits and rate of the valve, back-calculation of the integral from what
 * was applied (or from the feedback of a valve that does not follow), manual positions, and a local PI
 * controller while the neighbours are silent. Each change of mode is bumpless: the integral takes over
 * what was applied last. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

enum {
    M = 3,          /* xhat: plate, return, supply [K] */
    P = 1,          /* v [W] */
    Q = 2,          /* y: return, supply [K] */
    MEASURED = 5,   /* y, IT power [W], valve position, facility water [K]; NaN: not measured */
    MEMORY = 10,
    MESSAGE = 4,    /* xhat, and what is shared: the supply temperature or an estimate of the set-point */
    INNOVATION = 0,
    OWN = 8,
    CURVE = 129
};

enum { /* of Controller.law */
    LAW_FIXED,        /* the valve stays */
    LAW_PROPORTIONAL, /* (6): K disagreement of the estimates; printed or corrected is in the weights */
    LAW_INTEGRAL,     /* (6) + integral of the disagreement of the measured supply temperatures */
    LAW_SET_POINT,    /* consensus on the set-point, PI of each line to its estimate of it */
    LAW_LOCAL,        /* PI of each line that knows the set-point; the others stay */
    LAW_TEAM          /* PI of each line to the mean deviation of its team */
};

enum { /* of own */
    OWN_SIZE,         /* nominal load of the line over that of the nominal line */
    OWN_LOW,          /* least and largest valve position */
    OWN_HIGH,
    OWN_KNOWS,        /* 1: knows the set-point (LAW_LOCAL, LAW_TEAM) */
    OWN_DEGREE,       /* sum of the weights of its arcs and of its pin */
    OWN_MANUAL_FROM,  /* [s] when the valve is under manual control */
    OWN_MANUAL_UNTIL,
    OWN_MANUAL_VALVE  /* position then */
};

enum { /* of memory, after xhat */
    MEM_INTEGRAL = M, /* [W] */
    MEM_DEW,          /* [W] integral of the override */
    MEM_REFERENCE,    /* [K] estimate of the set-point, or what the neighbours agreed on */
    MEM_LOAD,         /* filtered IT power over the nominal load */
    MEM_WATER,        /* [K] filtered temperature of the facility water */
    MEM_LAST,         /* [W] what was applied last */
    MEM_MODE
};

enum { MODE_START, MODE_LAW, MODE_FALLBACK, MODE_MANUAL };

typedef struct {
    double h;             /* communication step [s] */
    double law;
    /* set-point [K], before and after a time [s] */
    double set_before, set_after, set_at;
    /* gains */
    double K[M];          /* [W/K] of the disagreement */
    double K_q;           /* [W/(K s)] of its integral */
    double consensus;     /* [1/s] of the set-points */
    double kp, Ti;        /* PI: [W/K], [s] */
    /* feedforward: 1 or 0, its filter [s], largest load it is for, over the nominal one */
    double forward, ff_time, load_most;
    double path;          /* [K/W] plate above supply, per released heat */
    double kappa_low, kappa_step; /* [W/K] */
    double curve[CURVE];  /* [W] v that gives kappa_low, kappa_low + kappa_step, ... */
    /* shell */
    double tracking;      /* [s] of the back-calculation, and of forgetting where there is no integral */
    double rate;          /* valve [1/s] */
    double tolerance;     /* valve position: feedback further away is a valve that does not follow */
    double floor;         /* [K] least supply temperature, from the dew point */
    double silence;       /* [s] longest silence of the neighbours before the fallback */
    double reference_time; /* [s] filter of what the neighbours agree on */
    /* valve */
    double y0, gain;
    /* observer and leader: x' = A x + rest + ..., sampled; E (M, Q) is the innovation's gain */
    double full[M * M], gamma[M * M], rest[M], E[M * Q];
    double heating;       /* P0/Cp [K/s] */
    double leakage, plate0; /* [1/K], [K] */
    double nominal;       /* P0 [W] */
    double Cs, ws, UA, water_max, log_R, N, kappa0; /* exchanger and valve, see cooling_line */
    double water0;        /* [K] facility water of theta = 0 */
    double lift;          /* [1/s] drive of the leader per kelvin of set-point above the nominal one */
    double supply0;       /* [K] supply temperature of the operating point */
} Controller;

/* u: v within the limits, for the valve. applied: sec(v) at the estimated return temperature [W]. */
void controller_send(const Controller *c, const double *own, const double *memory,
                     const double *measured, double *message);
void controller_step(const Controller *c, const double *own, double t, const double *measured,
                     const double *disagreement, const double *silence, const double *memory,
                     double *next, double *u, double *applied);
void controller_leader(const Controller *c, double t, const double *memory, double *next);
void controller_leader_send(const Controller *c, const double *memory, double *message);

#endif
