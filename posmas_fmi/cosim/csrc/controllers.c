/* The controllers of many agents in one call each: for a loop that is not in C. */
#include <stddef.h>
#include <stdint.h>

#include "controller.h"
#include "export.h"

/* The sizes, so that the caller can lay out memory: MEMORY, MEASURED, MESSAGE, INNOVATION, OWN. */
EXPORT int64_t controllers_size(int64_t which)
{
    const int64_t sizes[] = {MEMORY, MEASURED, MESSAGE, INNOVATION, OWN};
    return which >= 0 && which < 5 ? sizes[which] : -1;
}

EXPORT void controllers_send(const Controller *c, int64_t n, const double *own,
                             const double *memory, const double *measured, double *message)
{
    for (int64_t i = 0; i < n; i++)
        controller_send(c, OWN ? own + i * OWN : NULL, memory + i * MEMORY,
                        measured + i * MEASURED, message + i * MESSAGE);
}

EXPORT void controllers_step(const Controller *c, int64_t n, const double *own, double t,
                             const double *measured, const double *disagreement,
                             const double *silence, const double *memory, double *next, double *u,
                             double *applied)
{
    for (int64_t i = 0; i < n; i++)
        controller_step(c, OWN ? own + i * OWN : NULL, t, measured + i * MEASURED,
                        disagreement + i * MESSAGE, silence + i * 2, memory + i * MEMORY,
                        next + i * MEMORY, u + i * P, applied + i * P);
}

EXPORT void controllers_leader(const Controller *c, double t, const double *memory, double *next)
{
    controller_leader(c, t, memory, next);
}

EXPORT void controllers_leader_send(const Controller *c, const double *memory, double *message)
{
    controller_leader_send(c, memory, message);
}
