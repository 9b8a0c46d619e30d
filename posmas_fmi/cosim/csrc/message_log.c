/* The loggers. A message is kept as it comes, not formatted: its format may not fit its arguments. */
#include "message_log.h"

#include "export.h"

static void keep(const Sender *sender, const char *text)
{
    if (!sender || !sender->log)
        return;
    MessageLog *log = sender->log;
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
