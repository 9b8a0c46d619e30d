/* controller_block in pieces of LANES agents; BLOCK_FUNCTION is its name. */
#include <string.h>

#include "step.h"

static inline void load(Lanes *to, const double *from, int rows)
{
    for (int i = 0; i < rows; i++)
        memcpy(&to[i], from + i * CONTROLLER_BLOCK, sizeof(Lanes));
}

static inline void store(double *to, const Lanes *from, int rows)
{
    for (int i = 0; i < rows; i++)
        memcpy(to + i * CONTROLLER_BLOCK, &from[i], sizeof(Lanes));
}

void BLOCK_FUNCTION(const Controller *c, double t, const double *disagreement,
                    const double *memory, double *next, double *u, double *applied);

void BLOCK_FUNCTION(const Controller *c, double t, const double *disagreement,
                    const double *memory, double *next, double *u, double *applied)
{
    for (int first = 0; first < CONTROLLER_BLOCK; first += LANES) {
        Lanes all[MESSAGE], before[MEMORY], after[MEMORY], input[P], taken[P];
        load(all, disagreement + first, MESSAGE);
        load(before, memory + first, MEMORY);
        step(c, t, all, before, after, input, taken);
        store(next + first, after, MEMORY);
        store(u + first, input, P);
        store(applied + first, taken, P);
    }
}
