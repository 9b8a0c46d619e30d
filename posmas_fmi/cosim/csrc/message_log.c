/* The loggers. A message is kept as it comes, not formatted: its format may not fit its arguments. */
#include "message_log.h"

#include <stddef.h>

#include "export.h"

/* Some FMUs give back another environment than they were given, so it is looked up. */
static Sender *known;
static int64_t looking;

static void lock(void)
{
    while (__atomic_exchange_n(&looking, 1, __ATOMIC_ACQUIRE))
        ; /* held for a short walk */
}

static void unlock(void)
{
    __atomic_store_n(&looking, 0, __ATOMIC_RELEASE);
}

EXPORT void message_log_enter(Sender *sender)
{
    lock();
    sender->next = known;
    known = sender;
    unlock();
}

EXPORT void message_log_leave(Sender *sender)
{
    lock();
    for (Sender **at = &known; *at; at = &(*at)->next)
        if (*at == sender) {
            *at = sender->next;
            break;
        }
    unlock();
}

/* Who it is; if there is only one, it is that one whatever it gives. */
static Sender found(const void *environment)
{
    Sender one = {NULL, 0, NULL};
    lock();
    if (known && !known->next)
        one = *known;
    for (const Sender *at = known; at; at = at->next)
        if (at == environment) {
            one = *at;
            break;
        }
    unlock();
    return one;
}

static void keep(const void *environment, const char *text)
{
    const Sender one = found(environment), *sender = &one;
    MessageLog *log = sender->log;
    if (!log)
        return;
    while (__atomic_exchange_n(&log->busy, 1, __ATOMIC_ACQUIRE))
        ; /* held for one short copy */
    Message *message = &log->message[log->written % MESSAGES_KEPT];
    message->sender = sender->key;
    int length = 0;
    for (; text && text[length] && length < LONGEST_MESSAGE - 1; length++)
        message->text[length] = text[length];
    message->text[length] = 0;
    __atomic_store_n(&log->written, log->written + 1, __ATOMIC_RELEASE);
    __atomic_store_n(&log->busy, 0, __ATOMIC_RELEASE);
}

EXPORT void message_log_fmi2(void *environment, const char *name, int status, const char *category,
                             const char *message, ...)
{
    (void)name;
    (void)status;
    (void)category;
    keep(environment, message);
}

EXPORT void message_log_fmi3(void *environment, int status, const char *category,
                             const char *message)
{
    (void)status;
    (void)category;
    keep(environment, message);
}
