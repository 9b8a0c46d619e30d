/* The controller of an agent as a sampled model.
 *
 * What is heard at a communication point acts on u from the next one on: every message takes one
 * period. So no output depends on an input at the same time, and any master that passes values on
 * once in a period gives the same result.
 *
 * The values in the table stand as these structures have them; nothing but doubles. */
#include "model.h"

#include <stddef.h>
#include <string.h>

#include "controller.h"
#include "controller_data.h" /* HEARD, DISTRIBUTED and CONTROLLER, generated */

enum { SENT = M + (DISTRIBUTED ? Q : 0) };

typedef struct {
    double own;                             /* weights of (6), phi included: of the own estimate, */
    double leader;                          /* of the leader (0: not heard), */
    double weight[HEARD];                   /* and of each neighbour (0: there is none) */
#if DISTRIBUTED
    double own_innovation;                  /* weights of (22) */
    double innovation_weight[HEARD];
#endif
} Links;

typedef struct {
    double y[Q];                            /* measured */
    double heard[HEARD][SENT];              /* last message of each neighbour */
    double s[M];                            /* last message of the leader: its state */
} Inputs;

typedef struct {
    double xhat[M];                         /* the estimate */
    double disagreement[M];                 /* from which u follows */
#if DISTRIBUTED
    double innovation[Q];                   /* y - C xhat at the last communication point */
#endif
} Remembered;

typedef struct {
    double u[P];                            /* held over the period that begins */
    double sent[SENT];                      /* xhat, and the innovation where it is distributed */
    double sec_u[P];                        /* what the observer takes u for */
} Outputs;

static void disagree(const Links *links, const Inputs *in, Remembered *x)
{
    for (int j = 0; j < M; j++) {
        double heard = links->leader * in->s[j];
        for (int k = 0; k < HEARD; k++)
            heard += links->weight[k] * in->heard[k][j];
        x->disagreement[j] = links->own * x->xhat[j] - heard;
    }
}

static void innovate(const Inputs *in, const Remembered *x, double *innovation)
{
    double message[MESSAGE];
    controller_send(&CONTROLLER, NULL, x->xhat, in->y, message);
    memcpy(innovation, message + M, Q * sizeof *innovation);
}

const char *model_begin(const double *p, const double *u, double *x)
{
    const Links *links = (const Links *)p;
    const Inputs *in = (const Inputs *)u;
    Remembered *own = (Remembered *)x;
    if (!(links->own != 0))
        return "its parameter own is 0: set the parameters of an agent of the network";
    disagree(links, in, own);
#if DISTRIBUTED
    innovate(in, own, own->innovation);
#endif
    return NULL;
}

void model_sample(double t, const double *p, const double *u, double *x)
{
    const Links *links = (const Links *)p;
    const Inputs *in = (const Inputs *)u;
    Remembered *own = (Remembered *)x;
    const double silence[2] = {0, 0};
    double disagreement[MESSAGE], next[MEMORY], given[P], sec[P];
    double *innovation = disagreement + M; /* as (5) or (22) weights it */
    memcpy(disagreement, own->disagreement, sizeof own->disagreement);
    innovate(in, own, innovation);
#if DISTRIBUTED
    memcpy(own->innovation, innovation, sizeof own->innovation); /* what neighbours hear next */
    for (int j = 0; j < Q; j++) {
        innovation[j] *= links->own_innovation;
        for (int k = 0; k < HEARD; k++)
            innovation[j] -= links->innovation_weight[k] * in->heard[k][M + j];
    }
#endif
    controller_step(&CONTROLLER, NULL, t, in->y, disagreement, silence, own->xhat, next, given, sec);
    memcpy(own->xhat, next, sizeof next);
    disagree(links, in, own);
}

void model_outputs(double t, const double *p, const double *u, const double *x, double *y)
{
    (void)t, (void)p, (void)u;
    const Remembered *own = (const Remembered *)x;
    Outputs *out = (Outputs *)y;
    controller_input(&CONTROLLER, own->disagreement, out->u, out->sec_u);
    memcpy(out->sent, own->xhat, M * sizeof *out->sent);
#if DISTRIBUTED
    memcpy(out->sent + M, own->innovation, Q * sizeof *out->sent);
#endif
}
