#define _GNU_SOURCE
#include "surroundings.h"

#include <fcntl.h>
#include <fenv.h>
#include <locale.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "export.h"

static fenv_t floats;
static int folder = -1;
static char place[1024]; /* the locale, as setlocale tells and takes it */

EXPORT void surroundings_keep(void)
{
    fegetenv(&floats);
    folder = open(".", O_RDONLY | O_CLOEXEC);
    const char *name = setlocale(LC_ALL, NULL);
    snprintf(place, sizeof place, "%s", name ? name : "C");
}

void surroundings_put_back_floats(void)
{
    if (folder >= 0)
        fesetenv(&floats);
}

EXPORT void surroundings_put_back(void)
{
    if (folder < 0)
        return;
    fesetenv(&floats);
    if (fchdir(folder)) {
        /* it was closed: the worker sees to that */
    }
    const char *name = setlocale(LC_ALL, NULL);
    if (!name || strcmp(name, place))
        setlocale(LC_ALL, place);
}
