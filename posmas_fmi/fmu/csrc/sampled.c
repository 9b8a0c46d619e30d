/* One step of a sampled model: one period. */
#include "advance.h"

#include <math.h>
#include <string.h>

#define TEXT(number) #number
#define WRITTEN(number) TEXT(number)

const char *instance_advance(Instance *c, double end)
{
    State *s = &c->state;
    const double t = s->v[AT_TIME];
    double x[MODEL_NX_ROOM];
    if (!(fabs(end - t - MODEL_PERIOD) <= 1e-6 * MODEL_PERIOD))
        return "it is sampled: every step takes " WRITTEN(MODEL_PERIOD) " s";
    memcpy(x, s->v + AT_X, MODEL_NX * sizeof *x);
    model_sample(t, s->v + AT_P, s->v + AT_U, x);
    for (int i = 0; i < MODEL_NX; i++)
        if (!isfinite(x[i]))
            return "what it remembers becomes infinite or undefined";
    memcpy(s->v + AT_X, x, MODEL_NX * sizeof *x);
    s->v[AT_TIME] = end;
    return NULL;
}
