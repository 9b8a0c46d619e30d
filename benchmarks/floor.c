/* The floor: the FMUs alone. Set u, step, get y, for every agent; nothing else. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef int Get2(void *, const uint32_t[], size_t, double[]);
typedef int Set2(void *, const uint32_t[], size_t, const double[]);
typedef int Step2(void *, double, double, int);
typedef int Get3(void *, const uint32_t[], size_t, double[], size_t);
typedef int Set3(void *, const uint32_t[], size_t, const double[], size_t);
typedef int Step3(void *, double, double, bool, bool *, bool *, bool *, double *);

/* From point `from` up to `to`. The inputs from there on, (points, n, nu), are those that a controller gave: so the solvers inside the FMUs have
 * the same work as in a controlled run. Returns the number of calls that were not OK. */
__attribute__((visibility("default"))) int64_t
floor_run(int fmi, void (*set)(void), void (*step)(void), void (*get)(void), void **component,
          int64_t n, const uint32_t *ur, size_t nur, size_t nu, const uint32_t *yr, size_t nyr,
          size_t ny, double h, const double *u, int64_t from, int64_t to)
{
    double y[16];
    int64_t bad = 0;
    for (int64_t k = from; k < to; k++)
        for (int64_t i = 0; i < n; i++, u += nu) {
            double t = (double)k * h;
            if (fmi == 2) {
                bad += ((Set2 *)set)(component[i], ur, nur, u) != 0;
                bad += ((Step2 *)step)(component[i], t, h, 0) != 0;
                bad += ((Get2 *)get)(component[i], yr, nyr, y) != 0;
            } else {
                bool event, terminate, early;
                double last;
                bad += ((Set3 *)set)(component[i], ur, nur, u, nu) != 0;
                bad += ((Step3 *)step)(component[i], t, h, false, &event, &terminate, &early,
                                       &last) != 0;
                bad += ((Get3 *)get)(component[i], yr, nyr, y, ny) != 0;
            }
        }
    return bad;
}
