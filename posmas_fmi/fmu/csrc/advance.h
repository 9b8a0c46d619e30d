/* What happens inside a step of the Co-Simulation interface: `solver.c` integrates a model that has
 * derivatives, `sampled.c` lets one that is sampled act. A model is compiled with one of them. */
#ifndef ADVANCE_H
#define ADVANCE_H

#include "instance.h"

/* Tolerance where the importer names none, and the range in which the solver can keep one. */
#define TOLERANCE_DEFAULT 1e-10
#define TOLERANCE_MIN 1e-13
#define TOLERANCE_MAX 1e-2

/* Brings the instance to `end` exactly. NULL, or why that cannot be done; then the state is as it
 * was before. */
const char *instance_advance(Instance *c, double end);

#endif
