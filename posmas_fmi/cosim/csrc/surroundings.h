/* What an FMU may change of the process that it shares with others, put back as it was. */
#ifndef POSMAS_SURROUNDINGS_H
#define POSMAS_SURROUNDINGS_H

/* Before the first FMU is loaded. */
void surroundings_keep(void);
/* Rounding, flushing and traps of floats: after every call that computes. */
void surroundings_put_back_floats(void);
/* All: floats, working directory, locale. */
void surroundings_put_back(void);

#endif
