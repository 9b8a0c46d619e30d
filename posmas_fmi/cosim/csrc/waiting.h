/* Processes that wait for each other: they look for a while, for a processor that sleeps takes long
 * to wake, and then sleep on a word in shared memory. */
#ifndef WAITING_H
#define WAITING_H

#include <stdint.h>

/* Time [ns], from anywhen. */
int64_t clock_now(void);
/* Between two looks: let others have this processor. */
void look_away(void);
/* Sleep while *word is `seen`, for at most so long [ns]; may return early. */
void word_wait(uint32_t *word, uint32_t seen, int64_t most);
/* Wake all that sleep on it. */
void word_wake(uint32_t *word);

#endif
