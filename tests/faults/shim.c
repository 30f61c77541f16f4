/* Kills a process at, or fails, the Nth change that it makes to the disk below one folder; writes down all of them.

   Loaded with LD_PRELOAD, so that SQLite, zarr and the interpreter are met alike. Unarmed it passes everything on. What
   is counted: write, pwrite, writev, pwritev, sendfile, copy_file_range, fsync, fdatasync, rename, unlink, rmdir,
   mkdir, truncate, link, symlink, and an open that makes or empties a file. See `fault_shim.py` for the other side. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum mode { PASS, KILL_BEFORE, KILL_AFTER, FAIL_ONCE, FAIL_EVER, SHORT_ONCE };
enum { HALF = 1, WHOLE_THEN_KILL = 2, REFUSE = 3 };

static char folder[PATH_MAX];
static size_t folder_len;
static long at, count;
static int mode, code, fired, log_fd = -1, with_data;
static pthread_mutex_t lock = PTHREAD_RECURSIVE_MUTEX_INITIALIZER_NP;

#define REAL(name) \
    static __typeof__(&name) real; \
    if (!real) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

/* --- what the harness calls ------------------------------------------------------------------------------------- */

void shim_arm(const char *below, long n, int how, int error, int log, int data) {
    pthread_mutex_lock(&lock);
    folder_len = strlen(below);
    memcpy(folder, below, folder_len + 1);
    at = n, mode = how, code = error, count = 0, fired = 0, log_fd = log, with_data = data;
    pthread_mutex_unlock(&lock);
}

void shim_disarm(void) { folder_len = 0; }
long shim_count(void) { return count; }
int shim_fired(void) { return fired; }

/* --- paths ------------------------------------------------------------------------------------------------------ */

static int armed(void) { return folder_len != 0; }

static int below(const char *path) {
    return strncmp(path, folder, folder_len) == 0 && (path[folder_len] == '/' || path[folder_len] == 0);
}

/* The absolute path of a name relative to a folder that is open. */
static int full(int dir, const char *name, char *out) {
    char link[64];
    ssize_t n;
    if (name[0] == '/') return snprintf(out, PATH_MAX, "%s", name) < PATH_MAX;
    if (dir == AT_FDCWD) snprintf(link, sizeof link, "/proc/self/cwd");
    else snprintf(link, sizeof link, "/proc/self/fd/%d", dir);
    n = readlink(link, out, PATH_MAX - 1);
    if (n < 0) return 0;
    snprintf(out + n, PATH_MAX - n, "/%s", name);
    return 1;
}

static int of_fd(int fd, char *out) {
    char link[64];
    ssize_t n;
    if (fd == log_fd) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    n = readlink(link, out, PATH_MAX - 1);
    if (n <= 0 || out[0] != '/') return 0;
    out[n] = 0;
    return below(out);
}

/* --- counting, failing, writing down ---------------------------------------------------------------------------- */

static void put(const void *bytes, size_t n) {
    const char *p = bytes;
    while (n) {
        ssize_t done = syscall(SYS_write, log_fd, p, n);
        if (done <= 0) return;
        p += done, n -= done;
    }
}

/* A record (of '?' where nothing came of a call, so that records and counts agree): kind, three lengths (path, other path, data) and an offset, then these three. */
static void record(char kind, const char *path, const char *other, uint64_t offset, const void *data, uint64_t n) {
    struct { uint64_t kind, path, other, offset, data; } head = {
        (unsigned char)kind, strlen(path), strlen(other), offset, data ? n : 0};
    if (log_fd < 0) return;
    put(&head, sizeof head);
    put(path, head.path);
    put(other, head.other);
    if (head.data) put(data, n);
}

void shim_mark(const char *text) {
    pthread_mutex_lock(&lock);
    record('#', text, "", 0, NULL, 0);
    pthread_mutex_unlock(&lock);
}

static int needs_space(char kind) { return strchr("wcmlsr", kind) != NULL; }

/* One change begins: whether to let it happen (0), to halve it, to refuse it, or to die after it. */
static int gate(char kind, const char *path) {
    int due = ++count >= at && !fired;
    int here;
    if (mode == PASS) return 0;
    if (mode == KILL_BEFORE || mode == KILL_AFTER) {
        if (!due) return 0;
        fired = 1;
        record('!', path, (char[]){kind, 0}, count, NULL, 0);
        if (mode == KILL_BEFORE) kill(getpid(), SIGKILL);
        return kind == 'w' ? HALF : WHOLE_THEN_KILL;
    }
    here = code == ENOSPC ? needs_space(kind) : 1;
    if (mode == SHORT_ONCE) here = kind == 'w';
    if (!here || !(due || (fired && mode == FAIL_EVER))) return 0;
    if (!fired) record('!', path, (char[]){kind, 0}, count, NULL, 0);
    fired = 1;
    if (mode == SHORT_ONCE) return HALF;
    errno = code;
    return REFUSE;
}

static void after(int said) {
    if (said == WHOLE_THEN_KILL || (said == HALF && mode == KILL_AFTER)) kill(getpid(), SIGKILL);
}

/* What a write put into a file, read back, so that any way of writing is written down alike. */
static void record_written(int fd, const char *path, off_t start, ssize_t n) {
    char link[64], *data;
    int reader;
    if (log_fd < 0) return;
    if (n <= 0) {
        record('?', path, "", 0, NULL, 0);
        return;
    }
    if (!with_data) {
        record('w', path, "", start, NULL, 0);
        return;
    }
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    reader = syscall(SYS_openat, AT_FDCWD, link, O_RDONLY | O_CLOEXEC);
    data = malloc(n);
    if (reader >= 0 && data) {
        ssize_t got = pread(reader, data, n, start);
        record('w', path, "", start, data, got > 0 ? got : 0);
    }
    free(data);
    if (reader >= 0) syscall(SYS_close, reader);
}

#define WRITING(fd, size, start_expression, call_whole, call_half) \
    char path[PATH_MAX]; \
    ssize_t done; \
    off_t start; \
    int said; \
    if (!armed() || !of_fd(fd, path)) return call_whole; \
    pthread_mutex_lock(&lock); \
    said = gate('w', path); \
    if (said == REFUSE) { \
        pthread_mutex_unlock(&lock); \
        return -1; \
    } \
    start = start_expression; \
    done = said == HALF && (size) > 1 ? call_half : call_whole; \
    record_written(fd, path, start, done); \
    after(said); \
    pthread_mutex_unlock(&lock); \
    return done

static off_t position(int fd) {
    struct stat st;
    if (fcntl(fd, F_GETFL) & O_APPEND && fstat(fd, &st) == 0) return st.st_size;
    return lseek(fd, 0, SEEK_CUR);
}

ssize_t write(int fd, const void *p, size_t n) {
    REAL(write);
    WRITING(fd, n, position(fd), real(fd, p, n), real(fd, p, n / 2));
}
ssize_t pwrite(int fd, const void *p, size_t n, off_t o) {
    REAL(pwrite);
    WRITING(fd, n, o, real(fd, p, n, o), real(fd, p, n / 2, o));
}
ssize_t pwrite64(int fd, const void *p, size_t n, off64_t o) {
    REAL(pwrite64);
    WRITING(fd, n, o, real(fd, p, n, o), real(fd, p, n / 2, o));
}
ssize_t writev(int fd, const struct iovec *v, int n) {
    REAL(writev);
    WRITING(fd, n, position(fd), real(fd, v, n), real(fd, v, n / 2));
}
ssize_t pwritev(int fd, const struct iovec *v, int n, off_t o) {
    REAL(pwritev);
    WRITING(fd, n, o, real(fd, v, n, o), real(fd, v, n / 2, o));
}
ssize_t pwritev64(int fd, const struct iovec *v, int n, off64_t o) {
    REAL(pwritev64);
    WRITING(fd, n, o, real(fd, v, n, o), real(fd, v, n / 2, o));
}
ssize_t sendfile(int to, int from, off_t *o, size_t n) {
    REAL(sendfile);
    WRITING(to, n, position(to), real(to, from, o, n), real(to, from, o, 1));
}
ssize_t sendfile64(int to, int from, off64_t *o, size_t n) {
    REAL(sendfile64);
    WRITING(to, n, position(to), real(to, from, o, n), real(to, from, o, 1));
}
ssize_t copy_file_range(int from, off64_t *fo, int to, off64_t *o, size_t n, unsigned flags) {
    REAL(copy_file_range);
    WRITING(to, n, o ? *o : position(to), real(from, fo, to, o, n, flags), real(from, fo, to, o, 1, flags));
}

#define CHANGING(known, kind, path, other, value, call) \
    int said, done; \
    if (!armed() || !(known) || !(below(path) || below(other))) return call; \
    pthread_mutex_lock(&lock); \
    said = gate(kind, below(path) ? path : other); \
    if (said == REFUSE) { \
        pthread_mutex_unlock(&lock); \
        return -1; \
    } \
    done = call; \
    record(done >= 0 ? kind : '?', path, other, value, NULL, 0); \
    after(said); \
    pthread_mutex_unlock(&lock); \
    return done

#define NAMED(kind, dir, name, call) \
    char path[PATH_MAX]; \
    CHANGING(full(dir, name, path), kind, path, "", 0, call)
#define OPENED(kind, fd, value, call) \
    char path[PATH_MAX]; \
    CHANGING(of_fd(fd, path), kind, path, "", value, call)
#define TWO(kind, d1, n1, d2, n2, call) \
    char path[PATH_MAX], other[PATH_MAX]; \
    CHANGING(full(d1, n1, path) && full(d2, n2, other), kind, path, other, 0, call)

int fsync(int fd) { REAL(fsync); OPENED('f', fd, 0, real(fd)); }
int fdatasync(int fd) { REAL(fdatasync); OPENED('f', fd, 0, real(fd)); }
int ftruncate(int fd, off_t n) { REAL(ftruncate); OPENED('t', fd, n, real(fd, n)); }
int ftruncate64(int fd, off64_t n) { REAL(ftruncate64); OPENED('t', fd, n, real(fd, n)); }
int truncate(const char *p, off_t n) {
    char path[PATH_MAX];
    REAL(truncate);
    CHANGING(full(AT_FDCWD, p, path), 't', path, "", n, real(p, n));
}
int truncate64(const char *p, off64_t n) {
    char path[PATH_MAX];
    REAL(truncate64);
    CHANGING(full(AT_FDCWD, p, path), 't', path, "", n, real(p, n));
}
int unlink(const char *p) { REAL(unlink); NAMED('u', AT_FDCWD, p, real(p)); }
int unlinkat(int d, const char *p, int flags) {
    REAL(unlinkat);
    NAMED(flags & AT_REMOVEDIR ? 'd' : 'u', d, p, real(d, p, flags));
}
int rmdir(const char *p) { REAL(rmdir); NAMED('d', AT_FDCWD, p, real(p)); }
int mkdir(const char *p, mode_t m) { REAL(mkdir); NAMED('m', AT_FDCWD, p, real(p, m)); }
int mkdirat(int d, const char *p, mode_t m) { REAL(mkdirat); NAMED('m', d, p, real(d, p, m)); }
int rename(const char *a, const char *b) { REAL(rename); TWO('r', AT_FDCWD, a, AT_FDCWD, b, real(a, b)); }
int renameat(int d, const char *a, int e, const char *b) { REAL(renameat); TWO('r', d, a, e, b, real(d, a, e, b)); }
int renameat2(int d, const char *a, int e, const char *b, unsigned flags) {
    REAL(renameat2);
    TWO('r', d, a, e, b, real(d, a, e, b, flags));
}
int link(const char *a, const char *b) { REAL(link); TWO('l', AT_FDCWD, a, AT_FDCWD, b, real(a, b)); }
int linkat(int d, const char *a, int e, const char *b, int flags) {
    REAL(linkat);
    TWO('l', d, a, e, b, real(d, a, e, b, flags));
}
int symlink(const char *a, const char *b) { REAL(symlink); NAMED('s', AT_FDCWD, b, real(a, b)); }
int symlinkat(const char *a, int d, const char *b) { REAL(symlinkat); NAMED('s', d, b, real(a, d, b)); }

/* An open counts where it makes a file or empties one. */
static int changes(int dir, const char *name, int flags) {
    struct stat st;
    if (!(flags & (O_CREAT | O_TRUNC)) || (flags & O_TMPFILE) == O_TMPFILE) return 0;
    if (fstatat(dir, name, &st, 0) != 0) return (flags & O_CREAT) != 0;
    return (flags & O_TRUNC) && !(flags & O_EXCL) && (flags & O_ACCMODE) != O_RDONLY;
}

#define OPENING(dir, name, flags, call) \
    mode_t m = 0; \
    if ((flags) & O_CREAT || ((flags) & O_TMPFILE) == O_TMPFILE) { \
        va_list more; \
        va_start(more, flags); \
        m = va_arg(more, mode_t); \
        va_end(more); \
    } \
    if (!armed() || !changes(dir, name, flags)) return call; \
    NAMED('c', dir, name, call)

int open(const char *p, int flags, ...) { REAL(open); OPENING(AT_FDCWD, p, flags, real(p, flags, m)); }
int open64(const char *p, int flags, ...) { REAL(open64); OPENING(AT_FDCWD, p, flags, real(p, flags, m)); }
int openat(int d, const char *p, int flags, ...) { REAL(openat); OPENING(d, p, flags, real(d, p, flags, m)); }
int openat64(int d, const char *p, int flags, ...) { REAL(openat64); OPENING(d, p, flags, real(d, p, flags, m)); }
int creat(const char *p, mode_t m) { REAL(creat); NAMED('c', AT_FDCWD, p, real(p, m)); }
