/* The controller of an agent as a sampled model: the values in the table stand as agent.h has them. */
#include "model.h"

#include "agent.h"

const char *model_begin(const double *p, const double *u, double *x)
{
    return agent_begin((const AgentLinks *)p, (const AgentInputs *)u, (AgentState *)x);
}

void model_sample(double t, const double *p, const double *u, double *x)
{
    agent_act((const AgentLinks *)p, (const AgentInputs *)u, t, (AgentState *)x);
}

void model_outputs(double t, const double *p, const double *u, const double *x, double *y)
{
    (void)t, (void)p, (void)u;
    agent_show((const AgentState *)x, (AgentOutputs *)y);
}
