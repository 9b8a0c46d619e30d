/* Messages of FMUs, kept without a way through Python: the loggers of FMI 2 and FMI 3. */
#ifndef MESSAGE_LOG_H
#define MESSAGE_LOG_H

#include <stdint.h>

enum { MESSAGES_KEPT = 64, LONGEST_MESSAGE = 1016 };

typedef struct {
    int64_t sender;
    char text[LONGEST_MESSAGE]; /* as the FMU gave it, cut off */
} Message;

/* The newest messages of all instances; zero it before use. */
typedef struct {
    int64_t written; /* so many so far; message k stands at k % MESSAGES_KEPT */
    int64_t busy;    /* a lock: FMUs may log from any thread */
    Message message[MESSAGES_KEPT];
} MessageLog;

/* What an instance is given as its environment. */
typedef struct Sender {
    MessageLog *log;
    int64_t key;
    struct Sender *next; /* of those that are known */
} Sender;

#endif
