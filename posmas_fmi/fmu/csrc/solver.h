/* The solver inside the Co-Simulation interface. */
#ifndef SOLVER_H
#define SOLVER_H

#include "instance.h"

/* Tolerance where the importer names none, and the range in which the solver can keep one. */
#define TOLERANCE_DEFAULT 1e-10
#define TOLERANCE_MIN 1e-13
#define TOLERANCE_MAX 1e-2

/* Brings the instance to `end` exactly. NULL, or why that cannot be done; then the state is as it
 * was before. */
const char *solver_advance(Instance *c, double end);

#endif
