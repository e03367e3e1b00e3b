/* Read the pictures of a running tactflow (sink `shm`) from shared memory. C11 or C++, Linux and macOS.
 *
 *     struct tactflow_shm reader;
 *     struct tactflow_picture picture;
 *     tactflow_shm_init(&reader, "main", "image", NULL);
 *     while (tactflow_shm_wait(&reader, 5000) == 1)
 *         if (tactflow_shm_newest(&reader, &picture)) {
 *             use(picture.data, picture.shape);
 *             if (!tactflow_shm_valid(&picture)) ignore_what_was_computed();
 *         }
 *     tactflow_shm_close(&reader);
 *
 * The layout: a header, and from TACTFLOW_FIRST_SLOT on `slots` slots of `slot_bytes` bytes. A slot holds its own
 * header, the array (row by row) at TACTFLOW_DATA, and the message (JSON, UTF-8) at `message_offset`. Picture
 * n = 1, 2, ... is in slot n % slots, whose stamp is 2 n while the picture is whole; an odd stamp says that the
 * slot is being overwritten, or will be in the next frame. Numbers have the byte order of the machine.
 *
 * The socket: the reader sends the name of a port and a line end. Each byte that comes back says that there is a
 * new picture; one of them carries the descriptor of the memory (SCM_RIGHTS), again where a larger one was needed.
 * `!` and a message refuse the port. The end of the stream is the end of the run.
 */
#ifndef TACTFLOW_SHM_H
#define TACTFLOW_SHM_H

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#ifdef __cplusplus
extern "C" {
#endif

#define TACTFLOW_MAGIC "TACTSHM1"
#define TACTFLOW_FIRST_SLOT 4096
#define TACTFLOW_DATA 128

struct tactflow_ring {
    char magic[8];
    uint64_t generation;     /* another one for each ring: changes when tactflow is restarted */
    uint64_t slots;
    uint64_t slot_bytes;
    uint64_t message_offset; /* from the begin of the slot */
    uint64_t newest;         /* number of the newest picture, from 1; 0 before the first */
};

struct tactflow_slot {
    uint64_t stamp;
    int64_t seq;             /* index of the frame at the source */
    double t;                /* capture time, s: from the start of a recording, or Unix time of a live source */
    uint64_t data_bytes;     /* 0 if the port is absent in this frame */
    uint64_t message_bytes;
    uint64_t ndim;
    uint64_t shape[4];
    char dtype[8];           /* of NumPy: |u1 <f4 <f8 ...; empty if the port is absent */
};

struct tactflow_picture {
    int64_t seq;
    double t;
    uint64_t generation;
    const void *data;        /* in the shared memory, until the next tactflow_shm_wait or _close; NULL if absent */
    size_t data_bytes;
    const char *message;     /* in the shared memory, not terminated by 0 */
    size_t message_bytes;
    unsigned ndim;
    size_t shape[4];
    char dtype[9];
    const struct tactflow_slot *slot;
    uint64_t stamp;
};

struct tactflow_shm {
    struct sockaddr_un address;
    socklen_t address_bytes;
    char port[128];
    char refusal[256];       /* why the run does not share this port; else empty */
    int socket;              /* -1 while the run is not there */
    const unsigned char *memory;
    size_t size;
    uint64_t last;           /* number of the picture that was read last */
};

/* Prepare; nothing is connected yet. path: `sinks.shm.socket`, or NULL. Returns 0, or -1 if a name is too long. */
static inline int tactflow_shm_init(struct tactflow_shm *r, const char *sensor, const char *port, const char *path) {
    char name[sizeof r->address.sun_path];
    int n;
    memset(r, 0, sizeof *r);
    r->socket = -1;
    r->address.sun_family = AF_UNIX;
    if (snprintf(r->port, sizeof r->port, "%s\n", port) >= (int)sizeof r->port) return -1;
    if (path)
        n = snprintf(name, sizeof name, "%s", path);
    else {
#ifdef __linux__
        n = snprintf(name, sizeof name, "_tactflow-%u-%s", (unsigned)getuid(), sensor);
#else
        const char *folder = getenv("TMPDIR");
        int length = folder ? (int)strlen(folder) : 0;
        while (length > 1 && folder[length - 1] == '/') length--;
        n = snprintf(name, sizeof name, "%.*s/tactflow-%u-%s.sock", folder ? length : 4, folder ? folder : "/tmp",
                     (unsigned)getuid(), sensor);
#endif
    }
    if (n >= (int)sizeof name) return -1;
    memcpy(r->address.sun_path, name, (size_t)n + 1);
    r->address_bytes = (socklen_t)(offsetof(struct sockaddr_un, sun_path) + (size_t)n + 1);
#ifdef __linux__
    if (!path) { /* a name that needs no file begins with 0 and does not end with it */
        r->address.sun_path[0] = 0;
        r->address_bytes--;
    }
#endif
    return 0;
}

static inline void tactflow_shm_unmap(struct tactflow_shm *r) {
    if (r->memory) munmap((void *)r->memory, r->size);
    r->memory = NULL;
    r->last = 0;
}

static inline void tactflow_shm_disconnect(struct tactflow_shm *r) {
    if (r->socket >= 0) close(r->socket);
    r->socket = -1;
}

static inline void tactflow_shm_close(struct tactflow_shm *r) {
    tactflow_shm_disconnect(r);
    tactflow_shm_unmap(r);
}

/* Connect if the run is there and is ours. */
static inline void tactflow_shm_connect(struct tactflow_shm *r) {
    int flags = 0;
#ifdef MSG_NOSIGNAL
    flags = MSG_NOSIGNAL;
#endif
    r->socket = socket(AF_UNIX, SOCK_STREAM, 0);
    if (r->socket < 0) return;
    fcntl(r->socket, F_SETFD, FD_CLOEXEC);
#ifdef SO_NOSIGPIPE
    int on = 1;
    setsockopt(r->socket, SOL_SOCKET, SO_NOSIGPIPE, &on, sizeof on);
#endif
    if (connect(r->socket, (struct sockaddr *)&r->address, r->address_bytes)) {
        tactflow_shm_disconnect(r);
        return;
    }
#if defined(__linux__) && defined(SO_PEERCRED)
    if (!r->address.sun_path[0]) { /* names without a file have no permissions: only our processes and root's */
        struct { int pid; unsigned uid, gid; } peer;
        socklen_t size = sizeof peer;
        if (getsockopt(r->socket, SOL_SOCKET, SO_PEERCRED, &peer, &size) || (peer.uid && peer.uid != getuid())) {
            snprintf(r->refusal, sizeof r->refusal, "the run belongs to another user");
            tactflow_shm_disconnect(r);
            return;
        }
    }
#endif
    if (send(r->socket, r->port, strlen(r->port), flags) < 0 || fcntl(r->socket, F_SETFL, O_NONBLOCK))
        tactflow_shm_disconnect(r);
}

/* Map a ring in place of the last one. */
static inline void tactflow_shm_map(struct tactflow_shm *r, int descriptor) {
    struct stat about;
    void *memory = MAP_FAILED;
    tactflow_shm_unmap(r);
    if (!fstat(descriptor, &about))
        memory = mmap(NULL, (size_t)about.st_size, PROT_READ, MAP_SHARED, descriptor, 0);
    close(descriptor);
    if (memory == MAP_FAILED) return;
    r->memory = (const unsigned char *)memory;
    r->size = (size_t)about.st_size;
    if (memcmp(r->memory, TACTFLOW_MAGIC, 8)) tactflow_shm_unmap(r);
}

/* Take what the run has sent. */
static inline void tactflow_shm_hear(struct tactflow_shm *r) {
    char data[4096];
    union { char room[CMSG_SPACE(sizeof(int))]; struct cmsghdr aligned; } control;
    while (r->socket >= 0) {
        struct iovec piece = {data, sizeof data - 1};
        struct msghdr head;
        struct cmsghdr *c;
        ssize_t n;
        memset(&head, 0, sizeof head);
        head.msg_iov = &piece;
        head.msg_iovlen = 1;
        head.msg_control = control.room;
        head.msg_controllen = sizeof control.room;
        n = recvmsg(r->socket, &head, 0);
        if (n < 0 && errno == EINTR) continue;
        if (n < 0 && (errno == EAGAIN || errno == EWOULDBLOCK)) return;
        for (c = n > 0 ? CMSG_FIRSTHDR(&head) : NULL; c; c = CMSG_NXTHDR(&head, c))
            if (c->cmsg_level == SOL_SOCKET && c->cmsg_type == SCM_RIGHTS) {
                int descriptor;
                memcpy(&descriptor, CMSG_DATA(c), sizeof descriptor);
                tactflow_shm_map(r, descriptor);
            }
        if (n > 0 && data[0] == '!') snprintf(r->refusal, sizeof r->refusal, "%.*s", (int)n - 1, data + 1);
        if (n <= 0 || data[0] == '!') tactflow_shm_disconnect(r);
    }
}

static inline uint64_t tactflow_shm_number(const struct tactflow_shm *r) {
    return r->memory ? __atomic_load_n(&((const struct tactflow_ring *)r->memory)->newest, __ATOMIC_ACQUIRE) : 0;
}

/* Wait for a picture that was not read yet: 1 if there is one, 0 after `milliseconds` without, -1 if the run does
 * not share this port (`refusal` says why). The run may start before or after, and be started again. */
static inline int tactflow_shm_wait(struct tactflow_shm *r, int milliseconds) {
    const int step = 100; /* ms between two attempts to connect */
    for (;;) {
        struct pollfd news;
        int pause = milliseconds, ready;
        if (r->socket < 0 && !r->refusal[0]) tactflow_shm_connect(r);
        tactflow_shm_hear(r);
        if (r->refusal[0]) return -1;
        if (tactflow_shm_number(r) > r->last) return 1;
        if (milliseconds <= 0) return 0;
        if (r->socket < 0 && pause > step) pause = step;
        news.fd = r->socket; /* poll ignores -1 */
        news.events = POLLIN;
        news.revents = 0;
        ready = poll(&news, 1, pause);
        if (ready == 0) milliseconds -= pause;
    }
}

/* Whether the picture is still whole; ask after use. */
static inline int tactflow_shm_valid(const struct tactflow_picture *p) {
    __atomic_thread_fence(__ATOMIC_ACQUIRE);
    return __atomic_load_n(&p->slot->stamp, __ATOMIC_RELAXED) == p->stamp;
}

/* The newest picture: 1, or 0 if there is none. It counts as read. */
static inline int tactflow_shm_newest(struct tactflow_shm *r, struct tactflow_picture *p) {
    uint64_t number;
    while ((number = tactflow_shm_number(r)) > 0) {
        const struct tactflow_ring *ring = (const struct tactflow_ring *)r->memory;
        const unsigned char *place = r->memory + TACTFLOW_FIRST_SLOT + (number % ring->slots) * ring->slot_bytes;
        unsigned i;
        p->slot = (const struct tactflow_slot *)place;
        p->stamp = 2 * number;
        if (__atomic_load_n(&p->slot->stamp, __ATOMIC_ACQUIRE) != p->stamp) continue;
        p->seq = p->slot->seq;
        p->t = p->slot->t;
        p->generation = ring->generation;
        p->data_bytes = (size_t)p->slot->data_bytes;
        p->message = (const char *)place + ring->message_offset;
        p->message_bytes = (size_t)p->slot->message_bytes;
        p->ndim = (unsigned)p->slot->ndim;
        for (i = 0; i < 4; i++) p->shape[i] = (size_t)p->slot->shape[i];
        memcpy(p->dtype, p->slot->dtype, 8);
        p->dtype[8] = 0;
        p->data = p->dtype[0] ? place + TACTFLOW_DATA : NULL;
        if (!tactflow_shm_valid(p)) continue;
        r->last = number;
        return 1;
    }
    return 0;
}

#ifdef __cplusplus
}
#endif
#endif
