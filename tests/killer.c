/* Preloaded into a process: it kills itself at the n-th change of a file of results. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

enum { PAGE = 4096 };

static long seen, last = -1, torn, partial;

/* Arm it: die at change `at`, before it, or, if `torn`, after its first page. Changes of files that
 * do not have their name yet count only if they are to. */
void kill_at(long at, long after_a_page, long also_partial)
{
    seen = 0;
    last = at;
    torn = after_a_page;
    partial = also_partial;
}

static int is_result(const char *path)
{
    const char *name = strstr(path, ".nc");
    return name && (partial || !strstr(name, ".partial"));
}

static int due(int file)
{
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    const ssize_t n = last > 0 ? readlink(link, path, sizeof path - 1) : -1;
    if (n < 0)
        return 0;
    path[n] = 0;
    return is_result(path) && ++seen == last;
}

static void die(void)
{
    kill(getpid(), SIGKILL);
    for (;;)
        pause();
}

/* A signal ends a write between two pages at the earliest. */
static size_t first_page(size_t size, off_t at)
{
    const size_t room = PAGE - (size_t)(at % PAGE);
    return size > room ? room : 0;
}

ssize_t pwrite64(int file, const void *data, size_t size, off64_t at)
{
    ssize_t (*real)(int, const void *, size_t, off64_t) = dlsym(RTLD_NEXT, "pwrite64");
    if (due(file)) {
        if (torn && first_page(size, at))
            real(file, data, first_page(size, at), at);
        die();
    }
    return real(file, data, size, at);
}

ssize_t pwrite(int file, const void *data, size_t size, off_t at)
{
    return pwrite64(file, data, size, at);
}

ssize_t write(int file, const void *data, size_t size)
{
    ssize_t (*real)(int, const void *, size_t) = dlsym(RTLD_NEXT, "write");
    if (due(file)) {
        const size_t part = first_page(size, lseek(file, 0, SEEK_CUR));
        if (torn && part)
            real(file, data, part);
        die();
    }
    return real(file, data, size);
}

int ftruncate64(int file, off64_t size)
{
    int (*real)(int, off64_t) = dlsym(RTLD_NEXT, "ftruncate64");
    if (due(file))
        die();
    return real(file, size);
}

int ftruncate(int file, off_t size)
{
    return ftruncate64(file, size);
}

int rename(const char *from, const char *to)
{
    int (*real)(const char *, const char *) = dlsym(RTLD_NEXT, "rename");
    if (last > 0 && is_result(to) && ++seen == last)
        die();
    return real(from, to);
}

int unlink(const char *path)
{
    int (*real)(const char *) = dlsym(RTLD_NEXT, "unlink");
    if (last > 0 && is_result(path) && ++seen == last)
        die();
    return real(path);
}
