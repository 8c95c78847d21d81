/* Lets writes to one folder fail on demand: preloaded, it stands before the C library.
 *
 * FAULTY_FOLDER names the folder, absolute.  From Python:
 *   ctypes.CDLL(None).faulty_fail(kind, after, count, errno)
 *                                       the call of a kind after `after` more, and the following
 *                                       ones, `count` in all; 0: what writes to a log, 1: to any
 *                                       other file, 2: what waits for the disk
 *   ctypes.CDLL(None).faulty_failed()   how many calls were made to fail so far
 *   ctypes.CDLL(None).faulty_struck()   the first of the latest: its call and its file
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

enum { LOG, FILE_ITSELF, SYNC, KINDS };

static atomic_long calls[KINDS], failed, first = -1, last = -1;
static atomic_int wanted, error;
static char struck[4200];

long faulty_failed(void) { return failed; }
const char *faulty_struck(void) { return struck; }

void faulty_fail(int kind, long after, long count, int number) {
    first = last = -1;
    wanted = kind;
    error = number;
    last = calls[kind] + after + count;
    first = calls[kind] + after + 1;
}

static int fails(int fd, const char *call) {
    static const char *folder;
    char link[64], path[4096];
    if (!folder && !(folder = getenv("FAULTY_FOLDER"))) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0 || strncmp(path, folder, strlen(folder)) != 0) return 0;
    path[length] = 0;
    int is_log = length > 4 && strcmp(path + length - 4, "-wal") == 0;
    int kind = strstr(call, "sync") ? SYNC : is_log ? LOG : FILE_ITSELF;
    long number = ++calls[kind];
    if (kind != wanted || number < first || number > last) return 0;
    if (number == first) snprintf(struck, sizeof struck, "%s %s", call, path);
    ++failed;
    errno = error;
    return 1;
}

#define REAL(name) __typeof__(&name) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

ssize_t write(int fd, const void *data, size_t size) {
    REAL(write);
    return fails(fd, __func__) ? -1 : real(fd, data, size);
}

ssize_t pwrite(int fd, const void *data, size_t size, off_t at) {
    REAL(pwrite);
    return fails(fd, __func__) ? -1 : real(fd, data, size, at);
}

ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at) {
    REAL(pwrite64);
    return fails(fd, __func__) ? -1 : real(fd, data, size, at);
}

int fsync(int fd) {
    REAL(fsync);
    return fails(fd, __func__) ? -1 : real(fd);
}

int fdatasync(int fd) {
    REAL(fdatasync);
    return fails(fd, __func__) ? -1 : real(fd);
}

int ftruncate(int fd, off_t size) {
    REAL(ftruncate);
    return fails(fd, __func__) ? -1 : real(fd, size);
}

int ftruncate64(int fd, off64_t size) {
    REAL(ftruncate64);
    return fails(fd, __func__) ? -1 : real(fd, size);
}
