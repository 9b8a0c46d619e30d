/* See controller.h. */
#define LANES 1
#define GROUPS 1
#include "step.h"

void controller_send(const Controller *c, const double *own, const double *memory,
                     const double *measured, double *message)
{
    (void)own;
    for (int i = 0; i < M; i++)
        message[i] = memory[i];
    for (int i = 0; i < Q; i++) {
        double estimate = 0;
        for (int j = 0; j < M; j++)
            estimate += c->C[i * M + j] * memory[j];
        message[M + i] = measured[i] - estimate;
    }
}

void controller_step(const Controller *c, const double *own, double t, const double *measured,
                     const double *disagreement, const double *silence, const double *memory,
                     double *next, double *u, double *applied)
{
    (void)own, (void)measured, (void)silence;
    const Lanes driven = 1;
    LanesRange range = {.mends = 1};
    step(1, c, t, &driven, (const Lanes(*)[MESSAGE])disagreement, (const Lanes(*)[M])memory,
         (Lanes(*)[M])next, (Lanes(*)[P])u, (Lanes(*)[P])applied, &range);
}

void controller_input(const Controller *c, const double *disagreement, double *u, double *applied)
{
    LanesRange range = {.mends = 1};
    input(c, (const Lanes *)disagreement, (Lanes *)u, (Lanes *)applied, &range);
}

void controller_leader(const Controller *c, double t, const double *memory, double *next)
{
    const Lanes none[1][M] = {{0}};
    LanesRange range = {.mends = 1};
    propagate(1, c, t, (const Lanes(*)[M])memory, none, (Lanes(*)[M])next, &range);
}

void controller_leader_send(const Controller *c, const double *memory, double *message)
{
    (void)c;
    for (int i = 0; i < M; i++)
        message[i] = memory[i];
    for (int i = 0; i < INNOVATION; i++)
        message[M + i] = 0;
}
