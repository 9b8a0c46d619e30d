/* controller_block in pieces of GROUPS * LANES agents; BLOCK_FUNCTION is its name. */
#include <string.h>

#include "step.h"

/* Columns first … first + LANES - 1 of a matrix with CONTROLLER_BLOCK columns. */
LANES_INLINE void load(Lanes *to, const double *from, int first, int rows)
{
    for (int i = 0; i < rows; i++)
        memcpy(&to[i], from + i * CONTROLLER_BLOCK + first, sizeof(Lanes));
}

LANES_INLINE void store(double *to, const Lanes *from, int first, int rows)
{
    for (int i = 0; i < rows; i++)
        memcpy(to + i * CONTROLLER_BLOCK + first, &from[i], sizeof(Lanes));
}

void BLOCK_FUNCTION(const Controller *c, int agents, double t, const double *driven,
                    const double *disagreement, const double *memory, double *next, double *u,
                    double *applied);

void BLOCK_FUNCTION(const Controller *c, int agents, double t, const double *driven,
                    const double *disagreement, const double *memory, double *next, double *u,
                    double *applied)
{
    for (int first = 0; first < agents; first += GROUPS * LANES) {
        Lanes all[GROUPS][MESSAGE], before[GROUPS][M], after[GROUPS][M];
        Lanes input[GROUPS][P], taken[GROUPS][P], counts[GROUPS];
        for (int k = 0; k < GROUPS; k++) {
            load(&counts[k], driven, first + k * LANES, 1);
            load(all[k], disagreement, first + k * LANES, MESSAGE);
            load(before[k], memory, first + k * LANES, M);
        }
        step(c, t, counts, (const Lanes(*)[MESSAGE])all, (const Lanes(*)[M])before, after, input,
             taken);
        for (int k = 0; k < GROUPS; k++) {
            store(next, after[k], first + k * LANES, M);
            store(u, input[k], first + k * LANES, P);
            store(applied, taken[k], first + k * LANES, P);
        }
    }
}
