/* What all loops share: types, arguments, neighbours, components. */
#ifndef TACTFLOW_LOOP_H
#define TACTFLOW_LOOP_H

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_MSC_VER)
#define restrict __restrict
#endif
/* One version for processors with AVX2 and FMA, one for all others; the loader takes the right one. */
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12
#define LOOP __attribute__((target_clones("arch=x86-64-v3", "default"))) static int
#else
#define LOOP static int
#endif
/* Read ahead. */
#if defined(__GNUC__)
#define PREFETCH(address) __builtin_prefetch(address)
#else
#define PREFETCH(address) (void)(address)
#endif
/* Compiled into the loop that calls it, and so in both its versions. */
#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static __forceinline
#endif

#if defined(__clang__) || (defined(__GNUC__) && __GNUC__ >= 12)
#define SHUFFLES
typedef uint8_t Bytes16 __attribute__((vector_size(16)));
#endif

typedef uint8_t u8;
typedef uint16_t u16;
typedef uint32_t u32;
typedef int16_t i16;
typedef int32_t i32;
typedef int64_t i64;
typedef uint64_t u64;

/* An argument: an array, or a number. */
typedef struct {
    void *data;
    i64 shape[4];
    double number;
    i64 whole;
} Arg;

#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))
#define OUT_OF_MEMORY (-1)

/* Neighbours of a pixel along a line of `count`, reflected about the last one. */
#define BEFORE(at, count) ((at) > 0 ? (at) - 1 : MIN(1, (count) - 1))
#define AFTER(at, count) ((at) < (count) - 1 ? (at) + 1 : MAX((count) - 2, 0))

/* Combine a cell with its eight neighbours in a grid of rows that are `stride` apart. */
#define AROUND(cell, stride, with)                                                                                    \
    ((cell)[-(stride) - 1] with (cell)[-(stride)] with (cell)[1 - (stride)] with (cell)[-1] with (cell)[0] with       \
     (cell)[1] with (cell)[(stride) - 1] with (cell)[stride] with (cell)[(stride) + 1])

/* The upper one of the middle values, which are reordered (Hoare's selection). */
INLINE double upper_median_of(double *values, i64 count)
{
    const i64 upper = count / 2;
    i64 first = 0, last = count - 1;
    while (first < last) {
        const double middle = values[upper];
        i64 i = first, j = last;
        while (i <= j) {
            while (values[i] < middle)
                i++;
            while (values[j] > middle)
                j--;
            if (i <= j) {
                const double kept = values[i];
                values[i++] = values[j];
                values[j--] = kept;
            }
        }
        if (j < upper)
            first = i;
        if (i > upper)
            last = j;
    }
    return values[upper];
}

/* The median of values, which are reordered. */
INLINE double median_of(double *values, i64 count)
{
    const i64 upper = count / 2;
    const double middle = upper_median_of(values, count);
    if (count % 2)
        return middle;
    double below = values[0];
    for (i64 k = 1; k < upper; k++)
        below = MAX(below, values[k]);
    return (below + middle) / 2;
}

/* Neighbouring pixels of a row, from `first` up to `end`, all of which are set or not. At the root of its component,
 * whether that has been `found`. */
typedef struct {
    i32 first, end, root;
    u8 found;
} Run;

INLINE i64 root_of_run(Run *runs, i64 run)
{
    while (runs[run].root != run)
        run = runs[run].root = runs[runs[run].root].root; /* path halving */
    return run;
}

INLINE void unite(Run *runs, i64 one, i64 other)
{
    const i64 first = root_of_run(runs, one), second = root_of_run(runs, other);
    runs[MAX(first, second)].root = (i32)MIN(first, second);
}

/* Divide each row of a grid of 0 and 1 into runs, of which every second one is set, and unite those that touch those
 * of the row above: set ones by sides or corners, others by sides. Around the grid nothing is set: that is the
 * component of run 0. rows : (high + 1,), filled with the first run of each row. runs : up to wide + 3 a row. */
INLINE void join_runs(const u8 *grid, i64 high, i64 wide, Run *runs, i64 *rows)
{
    i64 count = 0;
    rows[0] = 0;
    for (i64 y = 0; y < high; y++) {
        const u8 *row = grid + y * wide;
        i64 x = -1, above = y > 0 ? rows[y - 1] : 0;
        for (u8 set = 0; x <= wide; set = !set) {
            const i64 from = MAX(x, 0);
            const u8 *next = from < wide ? memchr(row + from, !set, wide - from) : NULL;
            const i64 end = next ? next - row : set ? wide : wide + 1;
            runs[count] = (Run){(i32)x, (i32)end, (i32)count, 0};
            if (!set && (x < 0 || end > wide || y == 0 || y == high - 1))
                unite(runs, count, 0);
            for (i64 k = above + (set ? 1 : 0); y > 0 && k < rows[y]; k += 2)
                if (runs[k].first < end + set && runs[k].end > x - set)
                    unite(runs, count, k);
            count++;
            x = end;
        }
        rows[y + 1] = count;
    }
}

#endif
