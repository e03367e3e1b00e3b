/* A reader that knows the header alone: prints the layout, then pictures until the port has no more. */
#include "tactflow_shm.h"

#define PLACE(kind, field) printf("%s %zu\n", #kind "." #field, offsetof(struct tactflow_##kind, field))

int main(int argc, char **argv) {
    struct tactflow_shm reader;
    struct tactflow_picture p;
    if (argc < 4) return 2;
    PLACE(ring, magic); PLACE(ring, generation); PLACE(ring, slots); PLACE(ring, slot_bytes);
    PLACE(ring, message_offset); PLACE(ring, newest);
    PLACE(slot, stamp); PLACE(slot, seq); PLACE(slot, t); PLACE(slot, data_bytes); PLACE(slot, message_bytes);
    PLACE(slot, ndim); PLACE(slot, shape); PLACE(slot, dtype);
    if (tactflow_shm_init(&reader, argv[1], argv[2], argc > 4 ? argv[4] : NULL)) return 2;
    for (int count = atoi(argv[3]); count > 0;) {
        int news = tactflow_shm_wait(&reader, 300000);
        if (news < 0) { printf("refused %s\n", reader.refusal); break; }
        if (news == 0) return 1;
        if (!tactflow_shm_newest(&reader, &p)) continue;
        unsigned long long sum = 0;
        for (size_t i = 0; i < p.data_bytes; i++) sum += ((const unsigned char *)p.data)[i];
        printf("picture %lld %.3f %s %zu %llu %d %.*s\n", (long long)p.seq, p.t, p.dtype[0] ? p.dtype : "absent",
               p.ndim ? p.shape[0] : 0, sum, tactflow_shm_valid(&p), (int)p.message_bytes, p.message);
        fflush(stdout);
        count--;
    }
    tactflow_shm_close(&reader);
    return 0;
}
