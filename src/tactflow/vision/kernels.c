/* Loops over pixels and markers, for tactflow.vision.compiled: one function for each `@kernel` in Python.
 *
 * What a loop computes, and the shapes of its arguments, stand at its Python namesake, whose body does the same
 * in NumPy. Arrays are C-contiguous; a loop may rely on the shapes that its callers in Python make. Loops run
 * without Python's lock, and keep nothing between two calls.
 *
 * The module uses only the stable interface of Python 3.11, so that one file serves that and all later versions.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
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

/* ---- picture: geometry/downsample.py, contact/background_kernels.py, change/rest.py ------------------------ */

/* Means of 2 x 2 px, rounded, of two rows of 2 `count` interleaved BGR px. sums : scratch, 6 count. means : scratch,
 * 6 count + 8. out : 3 count. */
INLINE void halve_rows(const u8 *restrict upper, const u8 *restrict lower, i64 count, u16 *restrict sums,
                              u8 *restrict means, u8 *restrict out)
{
    i64 x = 0;
    /* One row after the other, in the order of memory; and at all px, also those that are then left out, for these
     * loops become whole vectors. */
    for (i64 i = 0; i < 6 * count - 3; i++)
        sums[i] = (u16)(upper[i] + upper[i + 3]);
    for (i64 i = 0; i < 6 * count - 3; i++)
        means[i] = (u8)((u16)(sums[i] + (u16)(lower[i] + lower[i + 3]) + 2) >> 2);
#if defined(SHUFFLES)
    for (; x + 8 < count; x += 5) {
        Bytes16 first, second;
        memcpy(&first, means + 6 * x, 16);
        memcpy(&second, means + 6 * x + 14, 16);
        first = __builtin_shufflevector(first, second, 0, 1, 2, 6, 7, 8, 12, 13, 14, 20, 21, 22, 26, 27, 28, 0);
        memcpy(out + 3 * x, &first, 16); /* Five px; the next ones overwrite the last byte. */
    }
#endif
    for (; x < count; x++)
        for (int c = 0; c < 3; c++)
            out[3 * x + c] = means[6 * x + c];
}

LOOP halve(const Arg *a, double *out)
{
    const u8 *picture = a[0].data;
    u8 *half = a[3].data;
    const i64 stride = a[0].shape[1], top = a[1].whole, left = a[2].whole, high = a[3].shape[0], count = a[3].shape[1] / 3;
    u16 *sums = malloc(3 * (6 * count + 8));
    (void)out;
    if (!sums)
        return OUT_OF_MEMORY;
    for (i64 y = 0; y < high; y++) {
        const u8 *upper = picture + (top + 2 * y) * stride + left;
        halve_rows(upper, upper + stride, count, sums, (u8 *)(sums + 6 * count + 8), half + y * 3 * count);
    }
    free(sums);
    return 0;
}

LOOP smooth_cells(const Arg *a, double *out)
{
    const u8 *half = a[0].data;
    float *smooth = a[1].data;
    const i64 high = a[1].shape[1], wide = a[1].shape[2], row_bytes = 6 * wide, long_ = 3 * wide;
    const float weight = 1.0f / 9;
    u8 *means = malloc(row_bytes + 3 * (long_ + 16) + 64);
    u16 *sums = malloc((row_bytes + 16) * sizeof(u16));
    (void)out;
    if (!means || !sums) {
        free(means);
        free(sums);
        return OUT_OF_MEMORY;
    }
    u8 *ring[3];
    for (int i = 0; i < 3; i++)
        ring[i] = means + row_bytes + 16 + i * (long_ + 16);
    u16 *squares = sums + long_ + 8;
    for (i64 row = 0; row <= high; row++) {
        if (row < high)
            halve_rows(half + 2 * row * row_bytes, half + (2 * row + 1) * row_bytes, wide, sums, means,
                       ring[row % 3]);
        if (row == 0)
            continue;
        const i64 y = row - 1;
        const u8 *restrict above = ring[(y == 0 ? MIN(1, high - 1) : y - 1) % 3];
        const u8 *restrict here = ring[y % 3];
        const u8 *restrict below = ring[(y == high - 1 ? MAX(high - 2, 0) : y + 1) % 3];
        u16 *restrict line = sums + 3;
        for (i64 i = 0; i < long_; i++)
            line[i] = (u16)(above[i] + here[i] + below[i]);
        for (int c = 0; c < 3; c++) {
            sums[c] = sums[3 * MIN(2, wide) + c];
            sums[long_ + 3 + c] = sums[3 * MAX(wide - 1, 1) + c];
        }
        for (i64 i = 0; i < long_; i++)
            squares[i] = (u16)(sums[i] + sums[i + 3] + sums[i + 6]);
        for (int c = 0; c < 3; c++) {
            float *restrict plane = smooth + (c * high + y) * wide;
            for (i64 x = 0; x < wide; x++)
                plane[x] = (float)squares[3 * x + c] * weight;
        }
    }
    free(means);
    free(sums);
    return 0;
}

#define SLOPE_STEPS_PER_GREY 8

LOOP sum_tiles(const Arg *a, double *out)
{
    const u8 *picture = a[0].data;
    const i64 left = a[1].whole, *used = a[2].data, *at_rest = a[4].data, stride = a[0].shape[1];
    const i16 *slopes = a[3].data;
    const float *px_per_edge = a[5].data;
    float *light = a[6].data, *shift = a[7].data;
    const i64 rows = a[6].shape[1], columns = a[6].shape[2], high = a[2].shape[0], width = a[3].shape[2];
    const i64 thick = high / rows, wide = width / columns, tiles = rows * columns;
    const float pixels = (float)(thick * wide);
    /* Sums with one tile of 0 more on all sides. */
    const i64 padded = columns + 2, plane = (rows + 2) * padded;
    float *moved = calloc(2 * (plane + width) + 3 * width, sizeof(float));
    (void)out;
    if (!moved)
        return OUT_OF_MEMORY;
    i32 *restrict moved_x = (i32 *)(moved + 2 * plane), *restrict moved_y = moved_x + width;
    u16 *restrict total = (u16 *)(moved_y + width);
    for (i64 row = 0; row < rows; row++) {
        memset(moved_x, 0, 2 * width * sizeof(i32));
        memset(total, 0, 3 * width * sizeof(u16));
        for (i64 y = row * thick; y < (row + 1) * thick; y++) {
            const u8 *restrict line = picture + used[y] * stride + left;
            const i16 *restrict along = slopes + y * width, *restrict down = slopes + (high + y) * width;
            /* The lines lie apart in memory, so that the processor does not read ahead by itself. */
            const u8 *next = picture + used[MIN(y + 4, high - 1)] * stride + left;
            for (i64 x = 0; x < 3 * width; x += 64)
                PREFETCH(next + x);
            for (i64 x = 0; x < 3 * width; x++)
                total[x] = (u16)(total[x] + line[x]);
            for (i64 x = 0; x < width; x++) {
                const i32 green = line[3 * x + 1];
                moved_x[x] += along[x] * green;
                moved_y[x] += down[x] * green;
            }
        }
        for (i64 column = 0; column < columns; column++) {
            const i64 tile = row * columns + column;
            const u16 *restrict levels = total + 3 * column * wide;
            i32 blue = 0, green = 0, red = 0, sum_x = 0, sum_y = 0;
            for (i64 x = 0; x < wide; x++) {
                blue += levels[3 * x];
                green += levels[3 * x + 1];
                red += levels[3 * x + 2];
            }
            for (i64 x = column * wide; x < (column + 1) * wide; x++) {
                sum_x += moved_x[x];
                sum_y += moved_y[x];
            }
            light[tile] = (float)blue / pixels;
            light[tiles + tile] = (float)green / pixels;
            light[2 * tiles + tile] = (float)red / pixels;
            moved[(row + 1) * padded + column + 1] = (float)(sum_x - at_rest[tile]);
            moved[plane + (row + 1) * padded + column + 1] = (float)(sum_y - at_rest[tiles + tile]);
        }
    }
    for (i64 row = 0; row < 2 * rows; row++) {
        const float *restrict sums = moved + row / rows * plane + row % rows * padded;
        const float *restrict factor = px_per_edge + row * columns;
        for (i64 x = 0; x < columns; x++) {
            float total = 0;
            for (int y = 0; y < 3; y++)
                total += sums[y * padded + x] + sums[y * padded + x + 1] + sums[y * padded + x + 2];
            shift[row * columns + x] = total * factor[x] / (9 * SLOPE_STEPS_PER_GREY);
        }
    }
    free(moved);
    return 0;
}

LOOP find_excess(const Arg *a, double *out)
{
    const float *departure = a[0].data, *allowed = a[1].data, *shift = a[3].data, *followed = a[4].data;
    const float *bound = a[5].data, growth = (float)a[2].number;
    const i64 tiles = a[0].shape[0] * a[0].shape[1];
    float departed = -INFINITY, moved = -INFINITY;
    for (i64 i = 0; i < tiles; i++) {
        const float excess = departure[i] - MAX(allowed[i] + growth, 1);
        departed = MAX(departed, excess);
    }
    for (i64 i = 0; i < 2 * tiles; i++) {
        const float excess = fabsf(shift[i] - followed[i]) - bound[i];
        moved = MAX(moved, excess);
    }
    out[0] = departed;
    out[1] = moved;
    return 0;
}

/* ---- contact/background_kernels.py ------------------------------------------------------------------------- */

#define SATURATION_GREY 255.0f

/* Position of a pixel along a line, as `positions`. */
INLINE float position(i64 pixel, i64 count)
{
    return (float)((double)pixel / (double)MAX(count - 1, 1) - 0.5);
}

LOOP weigh_change(const Arg *a, double *out)
{
    const float *cells = a[0].data, *coefficients = a[1].data, *untouched = a[2].data, *before = a[3].data;
    float *change = a[4].data, *squared = a[5].data;
    const i64 high = a[0].shape[1], wide = a[0].shape[2], size = high * wide;
    const float *mean = untouched, *weight = mean + 3 * size, *brightness = weight + 3 * size;
    const float *factor = brightness + size, *scale = factor + size;
    float *colour = squared + size, *evidence = colour + size;
    float *restrict along = malloc(4 * wide * sizeof(float)), *restrict across = along + wide;
    float *restrict most = across + wide, *restrict most_colour = most + wide;
    double now = 0, was = 0;
    if (!along)
        return OUT_OF_MEMORY;
    for (i64 x = 0; x < wide; x++) {
        across[x] = position(x, wide);
        most[x] = most_colour[x] = -INFINITY;
    }
    for (i64 y = 0; y < high; y++) {
        float *restrict total = squared + y * wide, *restrict rest = colour + y * wide;
        float *restrict both = evidence + y * wide;
        const float *restrict unit = scale + y * wide;
        for (int c = 0; c < 3; c++) {
            const float *f = coefficients + 4 * c;
            const float gain = f[0] + f[2] * position(y, high), slope = f[1], offset = f[3];
            const float *restrict line = cells + c * size + y * wide, *restrict usual = mean + c * size + y * wide;
            const float *restrict part = weight + c * size + y * wide;
            float *restrict signed_ = change + c * size + y * wide;
            if (c == 0)
                for (i64 x = 0; x < wide; x++)
                    total[x] = along[x] = 0;
            for (i64 x = 0; x < wide; x++) {
                const float light = usual[x] * (gain + slope * across[x]) + offset;
                const float more = line[x] - usual[x] - light, least = line[x] - SATURATION_GREY;
                const float shift = more > least ? more : least, deviation = shift * part[x];
                signed_[x] = shift * unit[x];
                total[x] += deviation * deviation;
                along[x] += deviation * part[x] * usual[x];
            }
        }
        const float *restrict bright = brightness + y * wide, *restrict counts = factor + y * wide;
        const float *restrict last = before + y * wide;
        float row_now = 0, row_was = 0;
        for (i64 x = 0; x < wide; x++) {
            const float light = total[x], hue = (light - along[x] * along[x] * bright[x]) * counts[x];
            rest[x] = hue;
            both[x] = light > hue ? light : hue;
            most[x] = most[x] > light ? most[x] : light;
            most_colour[x] = most_colour[x] > hue ? most_colour[x] : hue;
        }
        for (i64 x = 0; x < wide; x++) {
            row_now += last[x] > 0 ? both[x] : 0;
            row_was += last[x];
        }
        now += row_now;
        was += row_was;
    }
    out[0] = out[1] = -INFINITY;
    for (i64 x = 0; x < wide; x++) {
        out[0] = MAX(out[0], most[x]);
        out[1] = MAX(out[1], most_colour[x]);
    }
    out[2] = now;
    out[3] = was;
    free(along);
    return 0;
}

LOOP window_change(const Arg *a, double *out)
{
    const u8 *picture = a[0].data, *inside = a[5].data;
    const i64 top = a[1].whole, left = a[2].whole, stride = a[0].shape[1], high = a[7].shape[1], wide = a[7].shape[2];
    const i64 count = a[6].shape[0];
    const float *coefficients = a[3].data, *untouched = a[4].data, *mixtures = a[6].data;
    const float beside = (float)a[8].number, center = 1 - 2 * beside;
    float *shown = a[7].data;
    float *gain = malloc((12 * wide + 3 * count * wide + wide + 2) * sizeof(float));
    (void)out;
    if (!gain)
        return OUT_OF_MEMORY;
    /* Gain in the middle row, its slope along y, offset; a line; and three lines of each mixture, smoothed. */
    float *restrict slope = gain + 3 * wide, *restrict offset = slope + 3 * wide, *restrict line = offset + 3 * wide;
    float *restrict mixed = line + 3 * wide + 1, *ring = mixed + wide + 1;
    for (i64 i = 0; i < 3 * wide; i++) {
        const float *f = coefficients + 4 * (i % 3);
        gain[i] = f[0] + f[1] * position(left + i / 3, stride / 3);
        slope[i] = f[2];
        offset[i] = f[3];
    }
    for (i64 row = 0; row <= high; row++) {
        if (row < high) {
            const i64 first = (top + row) * stride + 3 * left;
            const u8 *restrict values = picture + first;
            const float *restrict usual = untouched + first, *restrict unit = usual + a[0].shape[0] * stride;
            const float place = position(top + row, a[0].shape[0]);
            for (i64 i = 0; i < 3 * wide; i++) {
                const float value = values[i], light = usual[i] * (gain[i] + slope[i] * place) + offset[i];
                const float more = value - usual[i] - light, least = value - SATURATION_GREY;
                line[i] = (more > least ? more : least) * unit[i];
            }
            for (i64 k = 0; k < count; k++) {
                const float *m = mixtures + 3 * k, m0 = m[0], m1 = m[1], m2 = m[2];
                float *restrict smooth = ring + (3 * k + row % 3) * wide;
                for (i64 x = 0; x < wide; x++)
                    mixed[x] = m0 * line[3 * x] + m1 * line[3 * x + 1] + m2 * line[3 * x + 2];
                mixed[-1] = mixed[BEFORE(0, wide)];
                mixed[wide] = mixed[AFTER(wide - 1, wide)];
                for (i64 x = 0; x < wide; x++)
                    smooth[x] = (mixed[x - 1] + mixed[x + 1]) * beside + mixed[x] * center;
            }
        }
        for (i64 k = 0, y = row - 1; k < count && y >= 0; k++) {
            const float *restrict above = ring + (3 * k + BEFORE(y, high) % 3) * wide;
            const float *restrict here = ring + (3 * k + y % 3) * wide;
            const float *restrict below = ring + (3 * k + AFTER(y, high) % 3) * wide;
            const u8 *counts = inside + y / 2 * (wide / 2);
            float *restrict into = shown + (k * high + y) * wide;
            for (i64 x = 0; x < wide; x++)
                into[x] = (above[x] + below[x]) * beside + here[x] * center;
            for (i64 x = 0; x < wide / 2; x++)
                if (!counts[x])
                    into[2 * x] = into[2 * x + 1] = 0;
        }
    }
    free(gain);
    return 0;
}

/* ---- contact/components.py --------------------------------------------------------------------------------- */

LOOP contact_cells(const Arg *a, double *out)
{
    const float *squared = a[0].data, weak = (float)a[1].number, start = (float)a[2].number;
    const float stay = (float)a[3].number;
    const u8 *before = a[4].data;
    u8 *found = a[6].data;
    const i64 least = a[5].whole, high = a[0].shape[0], wide = a[0].shape[1], stride = wide + 2;
    u8 *changed = calloc(2 * (high + 2), stride), *wider = changed + (high + 2) * stride;
    Run *runs = malloc(high * (wide + 3) * sizeof(Run));
    i64 *rows = malloc((high + 1) * sizeof(i64)), *cells = calloc(high * (wide + 3), sizeof(i64));
    u8 *peaks = calloc(high * (wide + 3), 1);
    int result = OUT_OF_MEMORY;
    if (!changed || !runs || !rows || !cells || !peaks)
        goto done;
    result = 0;
    for (i64 y = 0; y < high; y++)
        for (i64 x = 0; x < wide; x++)
            changed[(y + 1) * stride + x + 1] = squared[y * wide + x] > weak;
    /* Closing: what lies outside of the picture changes nothing. */
    memset(wider, 1, (high + 2) * stride);
    for (i64 y = 1; y <= high; y++)
        for (i64 x = 1; x <= wide; x++)
            wider[y * stride + x] = AROUND(changed + y * stride + x, stride, |);
    for (i64 y = 0; y < high; y++)
        for (i64 x = 0; x < wide; x++)
            found[y * wide + x] = AROUND(wider + (y + 1) * stride + x + 1, stride, &);
    join_runs(found, high, wide, runs, rows);
    for (i64 y = 0; y < high; y++)
        for (i64 run = rows[y] + 1; run < rows[y + 1]; run += 2) {
            const i64 root = root_of_run(runs, run);
            cells[root] += runs[run].end - runs[run].first;
            for (i64 i = y * wide + runs[run].first; i < y * wide + runs[run].end; i++)
                peaks[root] |= (squared[i] >= start) | (squared[i] >= stay) << 1 | before[i] << 2;
        }
    for (i64 y = 0; y < high; y++)
        for (i64 run = rows[y] + 1; run < rows[y + 1]; run += 2) {
            const i64 root = root_of_run(runs, run), length = runs[run].end - runs[run].first;
            const int touched = cells[root] >= least && (peaks[root] & 1 || (peaks[root] & 6) == 6);
            memset(found + y * wide + runs[run].first, touched, length);
            out[0] += (double)(touched * length);
        }
done:
    free(changed);
    free(rows);
    free(cells);
    free(peaks);
    free(runs);
    return result;
}

/* ---- contact/contact_outline.py ---------------------------------------------------------------------------- */

/* Sums of three neighbours in each row. */
INLINE void sum_neighbours(const float *restrict values, i64 high, i64 wide, float *restrict sums)
{
    for (i64 y = 0; y < high; y++, values += wide, sums += wide) {
        for (i64 x = 1; x < wide - 1; x++)
            sums[x] = values[x - 1] + values[x] + values[x + 1];
        sums[0] = values[0] + 2 * values[MIN(1, wide - 1)];
        sums[wide - 1] = values[wide - 1] + 2 * values[MAX(wide - 2, 0)];
    }
}

LOOP smooth_range(const Arg *a, double *out)
{
    const i64 high = a[0].shape[0], wide = a[0].shape[1];
    float *sums = malloc(high * wide * sizeof(float)), most = -INFINITY, least = INFINITY;
    if (!sums)
        return OUT_OF_MEMORY;
    sum_neighbours(a[0].data, high, wide, sums);
    for (i64 y = 0; y < high; y++) {
        const float *restrict here = sums + y * wide, *restrict above = sums + BEFORE(y, high) * wide;
        const float *restrict below = sums + AFTER(y, high) * wide;
        for (i64 x = 0; x < wide; x++) {
            const float sum = above[x] + here[x] + below[x];
            most = MAX(most, sum);
            least = MIN(least, sum);
        }
    }
    free(sums);
    out[0] = least / 9;
    out[1] = most / 9;
    return 0;
}

/* Double the length of a line by linear interpolation. */
INLINE void double_line(const float *restrict line, i64 count, float *restrict out)
{
    out[0] = line[0];
    for (i64 x = 0; x < count - 1; x++) {
        out[2 * x + 1] = 0.75f * line[x] + 0.25f * line[x + 1];
        out[2 * x + 2] = 0.25f * line[x] + 0.75f * line[x + 1];
    }
    out[2 * count - 1] = line[count - 1];
}

/* Maximum of each value and the `side` - 1 that follow it at a distance of `step` each; wrong for the last ones. */
INLINE void slide_maximum(float *restrict values, i64 size, i64 step, i64 side)
{
    for (i64 done = 1, more; done < side; done += more) {
        more = MIN(done, side - done);
        const float *next = values + more * step;
        for (i64 i = 0; i < size - more * step; i++)
            values[i] = MAX(values[i], next[i]);
    }
}

/* The sum instead of the maximum; the values are lost. */
INLINE void slide_sum(float *restrict values, i64 size, i64 step, i64 side, float *restrict total)
{
    memset(total, 0, size * sizeof(float));
    for (i64 block = 1, done = 0; block <= side; block *= 2) {
        if (side & block) {
            for (i64 i = 0; i < size - done * step; i++)
                total[i] += values[i + done * step];
            done += block;
        }
        for (i64 i = 0; i < size - block * step; i++)
            values[i] += values[i + block * step];
    }
}

LOOP largest_nearby(const Arg *a, double *out)
{
    const float *values = a[0].data;
    float *nearby = a[2].data;
    const double share = a[1].number;
    const i64 high = a[0].shape[0], wide = a[0].shape[1], rows = high / 2, columns = wide / 2;
    float *sums = malloc((high * wide + rows * columns) * sizeof(float)), *coarse = sums + high * wide, peak = 0;
    (void)out;
    if (!sums)
        return OUT_OF_MEMORY;
    sum_neighbours(values, high, wide, sums);
    for (i64 row = 0; row < rows; row++) {
        const float *restrict first = sums + BEFORE(2 * row, high) * wide, *restrict second = sums + 2 * row * wide;
        const float *restrict third = second + wide, *restrict fourth = sums + AFTER(2 * row + 1, high) * wide;
        float *restrict mean = coarse + row * columns;
        for (i64 x = 0; x < columns; x++) {
            float sum = 0;
            for (int k = 0; k < 2; k++) {
                const float both = second[2 * x + k] + third[2 * x + k];
                const float upper = first[2 * x + k] + both, lower = both + fourth[2 * x + k];
                peak = MAX(peak, MAX(upper, lower));
                sum += upper + lower;
            }
            mean[x] = sum / 36;
        }
    }
    peak = (float)MAX(peak / 9, 1e-9);
    const float clear = (float)(share * peak), least = 1e-3f * peak;
    i64 changed = 0;
    for (i64 i = 0; i < high * wide; i++)
        changed += values[i] > clear;
    /* Largest, and the mean of that, over squares; what lies outside is 0. */
    const i64 reach = (i64)rint(sqrt((double)changed / 3.141592653589793) / 2), side = 2 * reach + 1;
    const i64 padded = columns + 4 * reach, size = padded * (rows + 4 * reach);
    float *grid = calloc(2 * size + columns, sizeof(float)), *total = grid + size, *between = total + size;
    if (!grid) {
        free(sums);
        return OUT_OF_MEMORY;
    }
    for (i64 y = 0; y < rows; y++)
        memcpy(grid + (y + 2 * reach) * padded + 2 * reach, coarse + y * columns, columns * sizeof(float));
    slide_maximum(grid, size, 1, side);
    slide_maximum(grid, size, padded, side);
    slide_sum(grid, size, 1, side, total);
    slide_sum(total, size, padded, side, grid);
    const float weight = 1 / (float)(side * side);
    for (i64 y = 0; y < rows; y++)
        for (i64 x = 0; x < columns; x++)
            coarse[y * columns + x] = MAX(grid[y * padded + x] * weight, least);
    for (i64 y = 0; y < high; y++) {
        const float *restrict near = coarse + y / 2 * columns;
        const float *restrict far = coarse + MIN(MAX(y / 2 + (y % 2 ? 1 : -1), 0), rows - 1) * columns;
        for (i64 x = 0; x < columns; x++)
            between[x] = 0.75f * near[x] + 0.25f * far[x];
        double_line(between, columns, nearby + y * wide);
    }
    free(grid);
    free(sums);
    return 0;
}

LOOP outline_level(const Arg *a, double *out)
{
    const float *values = a[0].data, fraction = (float)a[1].number;
    const u8 *core = a[2].data;
    float *level = a[3].data;
    const i64 high = a[0].shape[0], wide = a[0].shape[1], columns = a[2].shape[1], side = wide / MAX(columns, 1);
    u8 *inside = malloc(high * wide);
    Run *runs = malloc(high * (wide + 3) * sizeof(Run));
    i64 *rows = malloc((high + 1) * sizeof(i64));
    (void)out;
    if (!inside || !runs || !rows) {
        free(inside);
        free(runs);
        free(rows);
        return OUT_OF_MEMORY;
    }
    for (i64 y = 0; y < high; y++) {
        u8 *restrict row = inside + y * wide;
        for (i64 x = 0; x < wide; x++)
            row[x] = values[y * wide + x] - fraction > 0;
        for (i64 column = 0; column < columns; column++)
            if (core[y / side * columns + column])
                memset(row + column * side, 1, side);
    }
    join_runs(inside, high, wide, runs, rows);
    /* Holes belong to what is around them. */
    for (i64 y = 0; y < high; y++)
        for (i64 run = rows[y]; run < rows[y + 1]; run += 2)
            if (root_of_run(runs, run) != 0) {
                unite(runs, run, run - 1);
                unite(runs, run, run + 1);
            }
    for (i64 y = 0; y < high; y++)
        for (i64 run = rows[y] + 1; run < rows[y + 1]; run += 2)
            for (i64 column = runs[run].first / side; column <= (runs[run].end - 1) / side; column++)
                runs[root_of_run(runs, run)].found |= core[y / side * columns + column];
    for (i64 y = 0; y < high; y++)
        for (i64 run = rows[y]; run < rows[y + 1]; run++) {
            const i64 root = root_of_run(runs, run);
            if (root != 0)
                memset(inside + y * wide + runs[run].first, runs[root].found, runs[run].end - runs[run].first);
        }
    for (i64 i = 0; i < high * wide; i++) {
        const float more = values[i] - fraction;
        /* Pixels that are filled in or removed get the extreme values of the level. */
        const float clipped = MIN(MAX(more, -0.5f), 0.5f);
        level[i] = (more > 0) == inside[i] ? clipped : (float)inside[i] - 0.5f;
    }
    free(inside);
    free(runs);
    free(rows);
    return 0;
}

LOOP draw_level(const Arg *a, double *out)
{
    const float *level = a[0].data;
    const i64 top = a[1].whole, left = a[2].whole, high = a[0].shape[0], wide = a[0].shape[1], stride = a[3].shape[1];
    const i64 count = MIN(2 * wide, stride - left);
    u8 *mask = a[3].data;
    float *line = malloc(3 * wide * sizeof(float)), *pixels = line + wide;
    (void)out;
    if (!line)
        return OUT_OF_MEMORY;
    for (i64 y = 0; y < MIN(2 * high, a[3].shape[0] - top); y++) {
        const float *restrict near = level + y / 2 * wide;
        const float *restrict far = level + MIN(MAX(y / 2 + (y % 2 ? 1 : -1), 0), high - 1) * wide;
        u8 *restrict into = mask + (top + y) * stride + left;
        for (i64 x = 0; x < wide; x++)
            line[x] = 0.75f * near[x] + 0.25f * far[x];
        double_line(line, wide, pixels);
        for (i64 x = 0; x < count; x++)
            into[x] |= pixels[x] > 0 ? 255 : 0;
    }
    free(line);
    return 0;
}

/* ---- contact/certainty.py ---------------------------------------------------------------------------------- */

LOOP largest_deviations(const Arg *a, double *out)
{
    const float *light = a[0].data, *colour = light + a[0].shape[1] * a[0].shape[2];
    const u8 *mask = a[1].data;
    const double *hull = a[2].data;
    const i64 wide = a[0].shape[2], stride = a[1].shape[1], count = a[2].shape[0], side = a[3].whole;
    double left = INFINITY, top = INFINITY, right = 0, bottom = 0;
    for (i64 i = 0; i < count; i++) {
        left = MIN(left, hull[2 * i]);
        right = MAX(right, hull[2 * i]);
        top = MIN(top, hull[2 * i + 1]);
        bottom = MAX(bottom, hull[2 * i + 1]);
    }
    for (i64 y = side * (i64)ceil(top / (double)side); count && y <= (i64)bottom; y += side)
        for (i64 x = side * (i64)ceil(left / (double)side); x <= (i64)right; x += side) {
            const i64 cell = y / side * wide + x / side;
            if (!mask[y * stride + x] || (light[cell] <= out[0] && colour[cell] <= out[1]))
                continue;
            i64 at = 0;
            for (; at < count; at++) {
                /* No pixel is to the left of a side of the hull. */
                const double *one = hull + 2 * at, *next = hull + 2 * ((at + 1) % count);
                if ((next[0] - one[0]) * ((double)y - one[1]) < (next[1] - one[1]) * ((double)x - one[0]))
                    break;
            }
            if (at < count) /* outside */
                continue;
            out[0] = MAX(out[0], light[cell]);
            out[1] = MAX(out[1], colour[cell]);
        }
    return 0;
}

/* ---- contact/illumination.py ------------------------------------------------------------------------------- */

/* The value that is larger than half of them. */
INLINE float upper_median(const float *restrict values, i64 count)
{
    for (i64 i = 0; i < count; i++) {
        i32 less = 0, equal = 0;
        for (i64 k = 0; k < count; k++) {
            less += values[k] < values[i];
            equal += values[k] == values[i];
        }
        if (less <= count / 2 && count / 2 < less + equal)
            return values[i];
    }
    return NAN;
}

LOOP fit_light(const Arg *a, double *out)
{
    const float *cells = a[0].data, *row_weights = a[1].data, *column_weights = a[2].data, *blocks = a[3].data;
    const float *basis = a[4].data, *step = a[5].data, *shrink = a[6].data, *center = a[7].data;
    float *coefficients = a[8].data;
    const i64 high = a[0].shape[1], wide = a[0].shape[2], down = a[1].shape[0], across = a[2].shape[0], n = down * across;
    const i64 most_steps = a[10].whole;
    const float saturated = (float)a[9].number, least_step = (float)a[11].number;
    const float rejections[2] = {INFINITY, (float)a[12].number};
    const float *reference = blocks, *per_brightness = blocks + 3 * n, *usual_limit = blocks + 6 * n;
    float *restrict line = malloc((wide + 7 * n) * sizeof(float));
    (void)out;
    if (!line)
        return OUT_OF_MEMORY;
    float *ratios = line + wide, *excess = ratios + n, *limit = excess + 3 * n;
    for (int c = 0; c < 3; c++) {
        i64 count = 0;
        float most = 0;
        for (i64 row = 0; row < down; row++) {
            memset(line, 0, wide * sizeof(float));
            /* Only the lines and columns of the block have a weight. */
            for (i64 y = row * high / down; y < ((row + 1) * high + down - 1) / down; y++) {
                const float part = row_weights[row * high + y];
                const float *restrict values = cells + (c * high + y) * wide;
                for (i64 x = 0; x < wide; x++)
                    line[x] += part * values[x];
            }
            for (i64 column = 0; column < across; column++) {
                const i64 at = c * n + row * across + column;
                float mean = 0;
                for (i64 x = column * wide / across; x < ((column + 1) * wide + across - 1) / across; x++)
                    mean += line[x] * column_weights[column * wide + x];
                excess[at] = mean - reference[at];
                limit[at] = mean < saturated ? usual_limit[at] : 0;
                if (per_brightness[at] > 0) {
                    ratios[count] = excess[at] * per_brightness[at];
                    most = MAX(most, ratios[count]);
                    count += limit[at] > 0;
                }
            }
        }
        coefficients[4 * c] = count ? upper_median(ratios, count) : most;
    }
    for (int pass = 0; pass < 2; pass++)
        for (i64 turn = 0; turn < most_steps; turn++) {
            float longest = 0;
            for (int c = 0; c < 3; c++) {
                float *f = coefficients + 4 * c;
                const float f0 = f[0], f1 = f[1], f2 = f[2], f3 = f[3], reject = rejections[pass];
                const float *restrict b0 = basis + 4 * c * n, *restrict b1 = b0 + n, *restrict b2 = b1 + n;
                const float *restrict b3 = b2 + n, *restrict s0 = step + 4 * c * n, *restrict s1 = s0 + n;
                const float *restrict s2 = s1 + n, *restrict s3 = s2 + n;
                const float *restrict data = excess + c * n, *restrict most = limit + c * n;
                float t0 = 0, t1 = 0, t2 = 0, t3 = 0;
                for (i64 i = 0; i < n; i++) {
                    const float beyond = data[i] - (f0 * b0[i] + f1 * b1[i] + f2 * b2[i] + f3 * b3[i]);
                    const float raised = beyond > -most[i] ? beyond : -most[i];
                    const float clipped = raised < most[i] ? raised : most[i];
                    const float residual = fabsf(beyond) < reject * most[i] ? clipped : 0;
                    t0 += residual * s0[i];
                    t1 += residual * s1[i];
                    t2 += residual * s2[i];
                    t3 += residual * s3[i];
                }
                float change[4] = {t0, t1, t2, t3};
                const float was[4] = {f0, f1, f2, f3};
                for (int k = 0; k < 4; k++) {
                    for (int j = 0; j < 4; j++)
                        change[k] -= was[j] * shrink[(c * 4 + j) * 4 + k];
                    f[k] += change[k];
                    longest = MAX(longest, fabsf(change[k]));
                }
            }
            if (longest < least_step)
                break;
        }
    for (int c = 0; c < 3; c++)
        for (int k = 0; k < 3; k++)
            coefficients[4 * c + k] /= center[c];
    free(line);
    return 0;
}

/* ---- contact/level_tree.py --------------------------------------------------------------------------------- */

INLINE i32 root_of(i32 *root, i32 cell)
{
    while (root[cell] != cell) {
        root[cell] = root[root[cell]]; /* path halving */
        cell = root[cell];
    }
    return cell;
}

INLINE i64 level_of(float value, const float *levels, i64 count)
{
    i64 level = 0;
    while (level < count && value > levels[level])
        level++;
    return level;
}

/* What is known of a component at its root: cells, marked cells, sides along its line and along the border. */
typedef struct {
    i32 cells, marked, sides, border;
    float drop;
} Component;

/* Unite a cell with the components beside it; their common sides no longer belong to a line. */
INLINE void join(i32 cell, const float *z, i64 high, i64 wide, i32 *root, Component *known)
{
    static const int steps[4][2] = {{-1, 0}, {0, -1}, {0, 1}, {1, 0}};
    const i64 y = cell / wide, x = cell % wide;
    root[cell] = cell;
    for (int k = 0; k < 4; k++) {
        const i64 v = y + steps[k][0], u = x + steps[k][1];
        const i32 here = root_of(root, cell);
        if (v < 0 || v >= high || u < 0 || u >= wide) {
            known[here].border++;
            continue;
        }
        const i32 beside = (i32)(v * wide + u);
        const float fall = z[cell] - z[beside];
        if (root[beside] < 0) {
            known[here].sides++;
            known[here].drop += fall;
            continue;
        }
        const i32 there = root_of(root, beside);
        Component *into = known + there, *from = known + here;
        into->sides--;
        into->drop += fall;
        if (there != here) {
            root[here] = there;
            into->drop += from->drop;
            into->cells += from->cells;
            into->marked += from->marked;
            into->sides += from->sides;
            into->border += from->border;
        }
    }
}

/* Cells from the highest level down, and the number of cells above each level. Holes are filled: the picture is
 * flooded from its border, over linked lists of the cells that are reached at each level. */
INLINE void order_by_level(const float *z, i64 high, i64 wide, const float *levels, i64 count, i32 *above, i32 *order,
                           i32 *ends, i32 *first, i32 *after)
{
#define REACH(cell, at)                                                                                              \
    do {                                                                                                             \
        above[cell] = (i32)(at);                                                                                     \
        after[cell] = first[at];                                                                                     \
        first[at] = (i32)(cell);                                                                                     \
    } while (0)
    i64 last = high * wide;
    for (i64 i = 0; i < high * wide; i++)
        above[i] = -1;
    for (i64 level = 0; level <= count; level++)
        first[level] = -1;
    for (i64 y = 0; y < high; y++)
        for (i64 x = 0; x < wide; x += y == 0 || y == high - 1 ? 1 : MAX(wide - 1, 1)) {
            const i64 level = level_of(z[y * wide + x], levels, count);
            REACH(y * wide + x, level);
        }
    ends[count] = 0;
    for (i64 level = 0; level <= count; level++) {
        if (level > 0)
            ends[level - 1] = (i32)last;
        while (first[level] >= 0) {
            const i32 cell = first[level];
            const i64 y = cell / wide, x = cell % wide;
            first[level] = after[cell];
            order[--last] = cell;
            for (i64 v = MAX(y - 1, 0); v < MIN(y + 2, high); v++)
                for (i64 u = MAX(x - 1, 0); u < MIN(x + 2, wide); u++)
                    if (above[v * wide + u] < 0) {
                        const i64 own = level_of(z[v * wide + u], levels, count), up = MAX(level, own);
                        REACH(v * wide + u, up);
                    }
        }
    }
#undef REACH
}

/* The smallest window that holds all values above a level, with one more cell around where the plane has one: its
 * `top`, `left`, and (exclusive) `bottom`, `right`. Returns 0 if there are none. */
INLINE int window_above(const float *z, i64 high, i64 wide, float level, i64 window[4])
{
    i64 top = high, bottom = 0, left = wide, right = 0;
    for (i64 y = 0; y < high; y++) {
        const float *restrict row = z + y * wide;
        int any = 0;
        for (i64 x = 0; x < wide; x++)
            any |= row[x] > level;
        if (!any)
            continue;
        top = MIN(top, y);
        bottom = y + 1;
        for (i64 x = 0; x < left; x++)
            if (row[x] > level)
                left = x;
        for (i64 x = wide; x > right; x--)
            if (row[x - 1] > level)
                right = x;
    }
    window[0] = MAX(top - 1, 0);
    window[1] = MAX(left - 1, 0);
    window[2] = MIN(bottom + 1, high);
    window[3] = MIN(right + 1, wide);
    return bottom > 0;
}

LOOP grow_level_lines(const Arg *a, double *out)
{
    const float *levels = a[2].data;
    const u8 *marked = a[1].data;
    i32 *within = a[4].data, *lines = a[6].data;
    float *drops = a[5].data;
    const i64 most = a[2].shape[0], least = a[3].whole, columns = a[0].shape[1];
    i64 window[4];
    memset(within, 0xff, a[0].shape[0] * columns * sizeof(i32));
    /* All lines lie in the window, and touch its border only where it is the picture's. */
    if (!most || !window_above(a[0].data, a[0].shape[0], columns, levels[0], window))
        return 0;
    const i64 high = window[2] - window[0], wide = window[3] - window[1], size = high * wide;
    within += window[0] * columns + window[1];
    marked += window[0] * columns + window[1];
    float *z = malloc(size * sizeof(float));
    i32 *root = malloc((5 * size + 2 * most + 4) * sizeof(i32));
    Component *known = calloc(size, sizeof(Component));
    if (!z || !root || !known) {
        free(z);
        free(root);
        free(known);
        return OUT_OF_MEMORY;
    }
    for (i64 y = 0; y < high; y++)
        memcpy(z + y * wide, (float *)a[0].data + (window[0] + y) * columns + window[1], wide * sizeof(float));
    i32 *line_of = root + size, *order = line_of + size, *after = order + size, *above = after + size;
    i32 *ends = above + size;
    i64 count = 0, inner = 0, pending = 0;
    order_by_level(z, high, wide, levels, most, above, order, ends, ends + most + 1, after);
    for (i64 i = 0; i < size; i++)
        root[i] = line_of[i] = -1;
    for (i64 level = most - 1; level >= 0; level--) {
        const i64 outer = count;
        for (i64 i = ends[level + 1]; i < ends[level]; i++) {
            const i32 cell = order[i];
            known[cell].cells = 1;
            known[cell].marked = marked[cell / wide * columns + cell % wide] != 0;
            join(cell, z, high, wide, root, known);
        }
        for (i64 i = 0; i < ends[level]; i++) {
            const i32 cell = order[i];
            if (root[cell] != cell || known[cell].cells < least)
                continue;
            const i32 line[7] = {(i32)level, cell, known[cell].cells, known[cell].marked, known[cell].sides,
                                 known[cell].border, -1};
            memcpy(lines + 7 * count, line, sizeof line);
            drops[count] = known[cell].drop;
            line_of[cell] = (i32)count++;
        }
        for (i64 line = inner; line < outer; line++)
            lines[7 * line + 6] = line_of[root_of(root, lines[7 * line + 1])];
        /* Cells that no line is around so far; the order by level is no longer linked. */
        i32 *cells = after;
        memcpy(cells + pending, order + ends[level + 1], (ends[level] - ends[level + 1]) * sizeof(i32));
        const i64 waiting = pending + ends[level] - ends[level + 1];
        pending = 0;
        for (i64 i = 0; i < waiting; i++) {
            const i32 cell = cells[i], line = line_of[root_of(root, cell)];
            within[cell / wide * columns + cell % wide] = line;
            if (line < 0)
                cells[pending++] = cell;
        }
        inner = outer;
    }
    for (i64 line = 0; line < count; line++) {
        i32 *cell = lines + 7 * line + 1;
        *cell = (i32)((window[0] + *cell / wide) * columns + window[1] + *cell % wide);
    }
    free(z);
    free(root);
    free(known);
    out[0] = (double)count;
    return 0;
}

/* ---- contact/level_lines.py -------------------------------------------------------------------------------- */

LOOP fill_region(const Arg *a, double *out)
{
    const i32 *contacts = a[0].data, near = (i32)a[1].whole;
    const i64 top = a[2].whole, left = a[3].whole, margin = a[4].whole, stride = a[0].shape[1];
    const i64 high = a[5].shape[0], wide = a[5].shape[1], size = high * wide;
    u8 *inside = a[5].data, *core = a[6].data, *inner = core + size;
    i64 count = 0;
    (void)out;
    memset(inside, 0, size);
    memset(inner, 0, size);
    for (i64 y = 0; y < high; y++)
        for (i64 x = 0; x < wide; x++) {
            const i32 *cell = contacts + (top + y) * stride + left + x;
            core[y * wide + x] = *cell == near + 1;
            if (*cell != near && *cell != near + 1)
                continue;
            const i64 from = MAX(x - margin, 0), length = MIN(x + margin + 1, wide) - from;
            for (i64 v = MAX(y - margin, 0); v < MIN(y + margin + 1, high); v++)
                memset(inside + v * wide + from, 1, length);
            int around = *cell == near + 1;
            for (i64 v = MAX(y - 1, 0); v < MIN(y + 2, high); v++)
                for (i64 u = MAX(x - 1, 0); u < MIN(x + 2, wide); u++)
                    around &= cell[(v - y) * stride + u - x] == near + 1;
            inner[y * wide + x] = (u8)around;
            count += around;
        }
    if (!count)
        memcpy(inner, core, size);
    return 0;
}

LOOP select_contacts(const Arg *a, double *out)
{
    const i32 *lines = a[0].data, *within = a[2].data;
    const float *drops = a[1].data, climb = (float)a[5].number;
    const double most_border = a[6].number, most_area = a[7].number, least_ratio = a[8].number;
    i32 *contacts = a[3].data, *box = a[4].data;
    const i64 count = a[0].shape[0], wide = a[2].shape[1], size = a[2].shape[0] * wide;
    float *slope = malloc((2 * count + 1) * sizeof(float)), *salience = slope + count, first = 0;
    u8 *taken = calloc(2 * count + 1, 1), *inside = taken + count;
    i32 number = 0;
    if (!slope || !taken) {
        free(slope);
        free(taken);
        return OUT_OF_MEMORY;
    }
    for (i64 i = 0; i < count; i++) {
        const i32 *line = lines + 7 * i, sides = line[4], border = line[5];
        const double length = 0.7853981633974483 * sides;
        const int possible = sides >= (1 - most_border) * (sides + border) && line[2] <= most_area * (double)size;
        slope[i] = possible ? (float)(drops[i] / MAX(length, 1)) : 0;
        salience[i] = (float)(slope[i] * sqrt(length));
    }
    memset(contacts, 0, size * sizeof(i32));
    for (;;) {
        i64 steepest = 0;
        for (i64 i = 1; i < count; i++)
            if (salience[i] > salience[steepest])
                steepest = i;
        if (!count || !(salience[steepest] > 0) || salience[steepest] < least_ratio * first)
            break;
        i64 core = steepest, last = steepest;
        for (i64 outer; (outer = lines[7 * last + 6]) >= 0; last = outer) {
            if (taken[outer] || slope[outer] < climb * slope[steepest])
                break;
            if (last == steepest)
                core = outer;
        }
        if (!lines[7 * last + 3]) {
            salience[steepest] = 0;
            continue;
        }
        if (!number) {
            first = salience[steepest];
            out[1] = slope[steepest];
        }
        for (i64 i = last; i >= 0; i--) {
            const i64 outer = lines[7 * i + 6];
            inside[i] = i == core ? 2 : i == last ? 1 : outer >= 0 && outer <= last ? inside[outer] : 0;
            taken[i] |= inside[i] > 0;
        }
        box[0] = box[1] = INT32_MAX;
        box[2] = box[3] = 0;
        for (i64 i = 0; i < size; i++)
            if (within[i] >= 0 && within[i] <= last && inside[within[i]]) {
                const i32 y = (i32)(i / wide), x = (i32)(i % wide);
                contacts[i] = 2 * number + inside[within[i]];
                box[0] = MIN(box[0], y);
                box[1] = MIN(box[1], x);
                box[2] = y + 1;
                box[3] = MAX(box[3], x + 1);
            }
        box += 4;
        for (; last >= 0; last = lines[7 * last + 6])
            taken[last] = 1;
        for (i64 i = 0; i < count; i++)
            salience[i] = taken[i] ? 0 : salience[i];
        number++;
    }
    free(slope);
    free(taken);
    out[0] = number;
    return 0;
}

/* ---- geometry/region.py, geometry/hull.py, geometry/direction.py ------------------------------------------- */

LOOP sum_pixels(const Arg *a, double *out)
{
    const u8 *mask = a[0].data;
    i64 *box = a[1].data, *sums = box + 4;
    const i64 high = a[0].shape[0], wide = a[0].shape[1];
    (void)out;
    memset(box, 0, 10 * sizeof(i64));
    for (i64 y = 0; y < high; y++) {
        const u8 *restrict row = mask + y * wide;
        u8 any = 0;
        for (i64 x = 0; x < wide; x++)
            any |= row[x];
        if (!any)
            continue;
        i64 count = 0, along = 0, squares = 0;
        box[1] = sums[0] ? box[1] : y;
        box[3] = y + 1;
        for (i64 x = 0; x < wide; x++) {
            for (u64 eight; x + 8 <= wide; x += 8) {
                memcpy(&eight, row + x, 8);
                if (eight)
                    break;
            }
            while (x < wide && !row[x])
                x++;
            if (x == wide)
                break;
            /* Sums over the pixels of a run. */
            const u8 *next = memchr(row + x, 0, wide - x);
            const i64 end = next ? next - row : wide;
            box[0] = sums[0] || count ? MIN(box[0], x) : x;
            box[2] = MAX(box[2], end);
            count += end - x;
            along += (end - x) * (x + end - 1) / 2;
            squares += (end * (end - 1) * (2 * end - 1) - x * (x - 1) * (2 * x - 1)) / 6;
            x = end;
        }
        sums[0] += count;
        sums[1] += along;
        sums[2] += y * count;
        sums[3] += squares;
        sums[4] += y * along;
        sums[5] += y * y * count;
    }
    return 0;
}

LOOP row_ends(const Arg *a, double *out)
{
    const u8 *mask = a[0].data;
    const i64 high = a[0].shape[0], wide = a[0].shape[1];
    i32 *points = a[1].data;
    i64 count = 0;
    for (i64 y = 0; y < high; y++) {
        const u8 *row = mask + y * wide;
        i64 first = 0, last = wide - 1;
        while (first < wide && !row[first])
            first++;
        if (first == wide)
            continue;
        while (!row[last])
            last--;
        const i32 ends[4] = {(i32)first, (i32)y, (i32)last, (i32)y};
        memcpy(points + 2 * count, ends, sizeof ends);
        count += 2;
    }
    out[0] = (double)count;
    return 0;
}

LOOP convex_hull(const Arg *a, double *out)
{
    const i32 *points = a[0].data;
    i32 top = INT32_MAX, bottom = INT32_MIN;
    const i64 count = a[0].shape[0];
    for (i64 i = 0; i < count; i++) {
        top = MIN(top, points[2 * i + 1]);
        bottom = MAX(bottom, points[2 * i + 1]);
    }
    if (!count)
        return 0;
    const i64 rows = (i64)bottom - top + 1;
    i32 *ends = malloc(10 * rows * sizeof(i32)), *corners = ends + 2 * rows;
    if (!ends)
        return OUT_OF_MEMORY;
    for (i64 row = 0; row < rows; row++) {
        ends[2 * row] = INT32_MAX;
        ends[2 * row + 1] = INT32_MIN;
    }
    for (i64 i = 0; i < count; i++) {
        i32 *end = ends + 2 * (points[2 * i + 1] - top);
        end[0] = MIN(end[0], points[2 * i]);
        end[1] = MAX(end[1], points[2 * i]);
    }
    /* Both ends of each row, down along the right side of the hull, then up along its left side. */
    i64 number = 0, base = 0;
    for (i64 step = 0; step < 4 * rows; step++) {
        const i64 at = step < 2 * rows ? step : 4 * rows - 1 - step;
        const i32 x = ends[at], y = (i32)(top + at / 2);
        if (step == 2 * rows)
            base = number - 1;
        if (ends[at / 2 * 2] > ends[at / 2 * 2 + 1] ||
            (number > 0 && x == corners[2 * number - 2] && y == corners[2 * number - 1]))
            continue;
        while (number - base >= 2) {
            const i32 *last = corners + 2 * number - 2, *before = last - 2;
            if ((i64)(last[0] - before[0]) * (y - last[1]) - (i64)(last[1] - before[1]) * (x - last[0]) > 0)
                break;
            number--;
        }
        if (step >= 2 * rows && x == corners[0] && y == corners[1])
            break;
        corners[2 * number] = x;
        corners[2 * number + 1] = y;
        number++;
    }
    /* Pick's theorem, with the pixels on the border. */
    i64 twice = 2;
    for (i64 i = 0; i < number; i++) {
        const i32 *one = corners + 2 * i, *next = corners + 2 * ((i + 1) % number);
        i64 step = llabs((i64)next[0] - one[0]), rest = llabs((i64)next[1] - one[1]);
        twice += (i64)one[0] * next[1] - (i64)one[1] * next[0];
        while (rest) {
            const i64 left = step % rest;
            step = rest;
            rest = left;
        }
        twice += step;
    }
    memcpy(a[1].data, corners, 2 * number * sizeof(i32));
    free(ends);
    out[0] = (double)number;
    out[1] = (double)twice / 2;
    return 0;
}

LOOP sum_harmonics(const Arg *a, double *out)
{
    const i32 *outline = a[0].data;
    const double *to_circle = a[1].data, least = a[2].number;
    const i64 count = a[0].shape[0], power = a[3].whole, number = a[4].shape[0];
    double *sums = a[4].data, *turns = malloc((3 * count + 1) * sizeof(double));
    (void)out;
    if (!turns)
        return OUT_OF_MEMORY;
    for (i64 i = 0; i < count; i++) {
        const double x = (outline[2 * i] - to_circle[0]) / to_circle[2];
        const double y = (outline[2 * i + 1] - to_circle[1] - to_circle[3] * x) / to_circle[4];
        const double length = sqrt(x * x + y * y), distance = MAX(length, least);
        turns[3 * i] = x / distance;
        turns[3 * i + 1] = y / distance;
        turns[3 * i + 2] = distance;
    }
    for (i64 i = 0; i < count; i++) {
        const double *before = turns + 3 * (i ? i - 1 : count - 1), *here = turns + 3 * i;
        const double *after = turns + 3 * (i < count - 1 ? i + 1 : 0);
        const double part = (before[0] * after[1] - before[1] * after[0]) / (4 * 3.141592653589793);
        double real = (here[2] / 2 - 1) * part, imaginary = 0;
        for (i64 k = 0; k < power + number; k++) {
            if (k >= power) {
                sums[2 * (k - power)] += real;
                sums[2 * (k - power) + 1] += imaginary;
            }
            const double turned = real * here[0] - imaginary * here[1];
            imaginary = real * here[1] + imaginary * here[0];
            real = turned;
        }
    }
    free(turns);
    return 0;
}

/* ---- markers/mask.py --------------------------------------------------------------------------------------- */

LOOP cover_spots(const Arg *a, double *out)
{
    const u8 *contrast = a[0].data, least = (u8)a[1].whole;
    const i64 high = a[0].shape[0], wide = a[0].shape[1], corner = a[2].whole;
    u8 *mask = a[3].data;
    /* One more px on all sides. */
    u8 *spots = calloc((high + 3) * (wide + 2), 1);
    (void)out;
    if (!spots)
        return OUT_OF_MEMORY;
    u8 *restrict line = spots + (high + 2) * (wide + 2);
    for (i64 y = 0; y < high; y++) {
        u8 *restrict row = spots + (y + 1) * (wide + 2) + 1;
        const u8 *restrict values = contrast + 3 * y * wide;
        for (i64 x = 0; x < wide; x++) {
            const u8 first = values[3 * x], second = values[3 * x + 1], third = values[3 * x + 2];
            const u8 low = MIN(first, second), top = MAX(first, second), less = MIN(top, third);
            row[x] = MAX(low, less) > least ? 255 : 0;
        }
        if (MIN(y, high - 1 - y) < corner)
            for (i64 x = 0; x < MIN(corner, wide); x++)
                row[x] = row[wide - 1 - x] = 0;
    }
    for (i64 y = 0; y < high; y++) {
        const u8 *restrict upper = spots + y * (wide + 2), *restrict here = upper + wide + 2;
        const u8 *restrict lower = here + wide + 2;
        u16 *restrict pairs = (u16 *)(mask + 4 * y * wide);
        for (i64 x = 0; x < wide + 2; x++)
            line[x] = upper[x] | here[x] | lower[x];
        for (i64 x = 0; x < wide; x++) {
            const u16 near = line[x] | line[x + 1] | line[x + 2];
            pairs[x] = (u16)(near | near << 8);
        }
        memcpy(pairs + wide, pairs, 2 * wide);
    }
    free(spots);
    return 0;
}

/* ---- markers/inpaint.py ------------------------------------------------------------------------------------ */

/* A line of cells has four sections: the sums of the three channels, and the weight. Each has `reach` cells more on
 * either side, and is padded to whole vector registers, so that one loop runs over all sections. */

/* Write each of `count` bytes three times. */
INLINE void triple(const u8 *restrict bytes, i64 count, u8 *restrict out)
{
    i64 x = 0;
#if defined(SHUFFLES)
    for (; x + 16 <= count; x += 16) {
        Bytes16 b, one, two, three;
        memcpy(&b, bytes + x, 16);
        one = __builtin_shufflevector(b, b, 0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5);
        two = __builtin_shufflevector(b, b, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8, 9, 9, 9, 10, 10);
        three = __builtin_shufflevector(b, b, 10, 11, 11, 11, 12, 12, 12, 13, 13, 13, 14, 14, 14, 15, 15, 15);
        memcpy(out + 3 * x, &one, 16);
        memcpy(out + 3 * x + 16, &two, 16);
        memcpy(out + 3 * x + 32, &three, 16);
    }
#endif
    for (; x < count; x++)
        out[3 * x] = out[3 * x + 1] = out[3 * x + 2] = bytes[x];
}

/* Sums over the valid ones of the 2 x 2 values of each cell of a line; returns whether a px is masked. A value is
 * valid where none of its 2 x 2 px is masked. valid : scratch, 12 width. sums : scratch, 6 width. */
INLINE int sum_valid_line(const u8 *mask, const u8 *half, i64 width, i64 section, i64 reach,
                                 const i64 *columns, u16 *line, u8 *valid, u16 *restrict sums)
{
    u16 any = 0;
    for (int part = 0; part < 2; part++) {
        const u8 *restrict first = mask + 8 * part * width, *restrict second = first + 4 * width;
        u8 *restrict kept = valid + 6 * part * width, *restrict shown = (u8 *)sums;
        for (i64 x = 0; x < 2 * width; x++) {
            u16 one, other;
            memcpy(&one, first + 2 * x, 2);
            memcpy(&other, second + 2 * x, 2);
            one |= other;
            any |= one;
            shown[x] = one ? 0 : 255;
        }
        triple(shown, 2 * width, kept);
    }
    const u8 *restrict upper = half, *restrict lower = half + 6 * width;
    const u8 *restrict shown = valid, *restrict below = valid + 6 * width;
    for (i64 i = 0; i < 6 * width; i++)
        sums[i] = (u16)((upper[i] & shown[i]) + (lower[i] & below[i]));
    u16 *restrict blue = line + reach, *restrict green = blue + section, *restrict red = green + section;
    u16 *restrict weight = red + section;
    for (i64 x = 0; x < width; x++) {
        blue[x] = (u16)(sums[6 * x] + sums[6 * x + 3]);
        green[x] = (u16)(sums[6 * x + 1] + sums[6 * x + 4]);
        red[x] = (u16)(sums[6 * x + 2] + sums[6 * x + 5]);
        weight[x] = (u16)(shown[6 * x] + shown[6 * x + 3] + below[6 * x] + below[6 * x + 3]);
    }
    for (int s = 0; s < 4; s++) {
        u16 *part = line + s * section;
        for (i64 x = 0; x < reach; x++) {
            part[x] = part[columns[x]];
            part[reach + width + x] = part[columns[reach + width + x]];
        }
    }
    return any != 0;
}

/* Binomial windows of 3 x 3 cells plus `far` times windows of 2 reach + 1 cells each way, in masked lines and those
 * beside them; returns whether a weight there is below `least`. */
INLINE int sum_windows(const u16 *cells, const u8 *masked, const i64 *rows, i64 high, i64 width, i64 length, i64 reach,
                              float far, float least, float *windows, u16 *restrict tall, u16 *restrict near)
{
    int few = 0;
    memset(tall, 0, (length + 2 * reach) * sizeof(u16));
    memset(near, 0, (length + 2 * reach) * sizeof(u16));
    for (i64 y = 0; y < 2 * reach + 1; y++) {
        const u16 *restrict line = cells + rows[y] * length;
        for (i64 x = 0; x < length; x++)
            tall[x] = (u16)(tall[x] + line[x]);
    }
    for (i64 y = 0; y < high; y++) {
        const u16 *restrict before = cells + rows[y] * length, *restrict line = cells + rows[y + 2 * reach + 1] * length;
        for (i64 x = 0; x < length; x++)
            tall[x] = (u16)(tall[x] + line[x] - before[x]);
        if (!(masked[MAX(y - 1, 0)] || masked[y] || masked[MIN(y + 1, high - 1)]))
            continue;
        float *restrict out = windows + y * length;
        for (i64 x = 0; x < length; x++)
            out[x] = tall[x];
        /* Sums of integers below 2^24 are exact in any order. */
        for (i64 step = 1; step < 2 * reach; step += 2) {
            const u16 *restrict first = tall + step, *restrict second = tall + step + 1;
            for (i64 x = 0; x < length; x++)
                out[x] += (float)(first[x] + second[x]);
        }
        const u16 *restrict above = cells + rows[y + reach] * length, *restrict here = cells + y * length;
        const u16 *restrict below = cells + rows[y + reach + 2] * length;
        for (i64 x = 0; x < length; x++)
            near[x] = (u16)(above[x] + 2 * here[x] + below[x]);
        for (i64 x = 0; x < length; x++)
            out[x] = (float)(u16)(near[x + reach - 1] + 2 * near[x + reach] + near[x + reach + 1]) + far * out[x];
        const float *restrict weight = out + 3 * length / 4;
        for (i64 x = 0; x < width; x++)
            few |= weight[x] < least;
    }
    return few;
}

/* Where a window has no valid px, the mean of the whole picture decides, if it has any; returns whether it has. */
INLINE int add_everywhere(const u16 *cells, i64 high, i64 width, i64 length, i64 reach, float share, float *windows)
{
    const i64 section = length / 4;
    for (int s = 3; s >= 0; s--) {
        double total = 0;
        for (i64 y = 0; y < high; y++)
            for (i64 x = 0; x < width; x++)
                total += cells[y * length + s * section + reach + x];
        if (s == 3 && total == 0)
            return 0;
        const float mean = share * (float)(total / (double)(high * width));
        for (i64 y = 0; y < high; y++)
            for (i64 x = 0; x < section; x++)
                windows[y * length + s * section + x] += mean;
    }
    return 1;
}

/* Set the masked px of two lines to the quotients, interpolated between the centres of cells. here, beyond : the
 * quotients of the cells that the lines belong to, and of those across the nearest border. fill : scratch, 6 width. */
INLINE void fill_lines(const float *here, const float *beyond, i64 width, i64 section, const u8 *mask, u8 *picture,
                       float *restrict line, u8 *fill)
{
    for (int c = 0; c < 3; c++) {
        const float *restrict near = here + c * section, *restrict other = beyond + c * section;
        u8 *restrict left = fill + 2 * c * width, *restrict right = left + width;
        for (i64 x = 0; x < width; x++)
            line[x + 1] = 0.75f * near[x] + 0.25f * other[x];
        line[0] = line[1];
        line[width + 1] = line[width];
        for (i64 x = 0; x < width; x++) {
            left[x] = (u8)(i32)rintf(0.25f * line[x] + 0.75f * line[x + 1]);
            right[x] = (u8)(i32)rintf(0.75f * line[x + 1] + 0.25f * line[x + 2]);
        }
    }
    for (int row = 0; row < 2; row++) {
        const u8 *hidden = mask + row * 4 * width;
        u8 *values = picture + row * 12 * width;
        for (i64 x = 0; x < width; x++) {
            u32 four;
            memcpy(&four, hidden + 4 * x, 4);
            for (i64 k = 4 * x; four && k < 4 * x + 4; k++)
                if (hidden[k]) {
                    const u8 *from = fill + (k & 2 ? width : 0) + x;
                    values[3 * k] = from[0];
                    values[3 * k + 1] = from[2 * width];
                    values[3 * k + 2] = from[4 * width];
                }
        }
    }
}

LOOP fill_masked(const Arg *a, double *out)
{
    u8 *picture = a[0].data;
    const u8 *mask = a[1].data, *half = a[2].data;
    const i64 *rows = a[3].data, *columns = a[4].data, reach = a[5].whole;
    const float far = (float)a[6].number, least = (float)a[7].number, share = (float)a[8].number;
    const i64 high = a[1].shape[0] / 4, width = a[1].shape[1] / 4, section = (width + 2 * reach + 31) / 32 * 32;
    const i64 length = 4 * section;
    u16 *cells = calloc(high * length + 2 * (length + 2 * reach) + 6 * width, sizeof(u16));
    float *windows = calloc(high * length + width + 2, sizeof(float));
    u8 *masked = malloc(high + 18 * width);
    (void)out;
    if (!cells || !windows || !masked) {
        free(cells);
        free(windows);
        free(masked);
        return OUT_OF_MEMORY;
    }
    u16 *tall = cells + high * length, *near = tall + length + 2 * reach;
    float *line = windows + high * length;
    u8 *fill = masked + high, *valid = fill + 6 * width;
    for (i64 y = 0; y < high; y++)
        masked[y] = (u8)sum_valid_line(mask + 16 * y * width, half + 12 * y * width, width, section, reach, columns,
                                       cells + y * length, valid, near + length + 2 * reach);
    int known = 1;
    if (sum_windows(cells, masked, rows, high, width, length, reach, far, least, windows, tall, near))
        known = add_everywhere(cells, high, width, length, reach, share, windows);
    for (i64 y = 0; known && y < high; y++) {
        if (!(masked[MAX(y - 1, 0)] || masked[y] || masked[MIN(y + 1, high - 1)]))
            continue;
        float *restrict sums = windows + y * length;
        const float *restrict weight = sums + 3 * section;
        for (int c = 0; c < 3; c++)
            for (i64 x = 0; x < width; x++)
                sums[c * section + x] *= 255 / weight[x];
    }
    for (i64 y = 0; known && y < 2 * high; y++) {
        const i64 cell = y / 2, other = y % 2 ? MIN(cell + 1, high - 1) : MAX(cell - 1, 0);
        if (masked[cell])
            fill_lines(windows + cell * length, windows + other * length, width, section, mask + 8 * y * width,
                      picture + 24 * y * width, line, fill);
    }
    free(cells);
    free(windows);
    free(masked);
    return 0;
}

/* ---- markers/motion.py ------------------------------------------------------------------------------------- */

LOOP weigh_motion(const Arg *a, double *out)
{
    const double *displacement = a[0].data, *share = a[4].data, rest = a[5].number;
    const float *stderr_ = a[1].data;
    const u8 *seen = a[2].data;
    const i64 *around = a[3].data, count = a[0].shape[0], near = a[3].shape[1], nearest = MIN(a[7].whole, near);
    double *against = a[6].data;
    const double least_known = a[8].number, scatter = a[9].number;
    u8 *moves = malloc(count + 1);
    int moving = 0;
    if (!moves)
        return OUT_OF_MEMORY;
    for (i64 n = 0; n < count; n++) {
        moves[n] = MAX(fabs(displacement[2 * n]), fabs(displacement[2 * n + 1])) > rest;
        moving |= moves[n];
    }
    for (i64 n = 0; moving && n < count; n++) {
        int beside = 0;
        for (i64 k = 0; k < nearest; k++)
            beside |= moves[around[n * near + k]] && seen[around[n * near + k]];
        if (moves[n] || !seen[n] || !beside)
            continue;
        double total = 0, mean_x = 0, mean_y = 0, squares = 0;
        for (i64 k = 0; k < near; k++) {
            const i64 other = around[n * near + k];
            if (seen[other]) {
                const double x = displacement[2 * other], y = displacement[2 * other + 1], part = share[n * near + k];
                total += part;
                squares += part * (x * x + y * y);
                mean_x += part * x;
                mean_y += part * y;
            }
        }
        if (total < least_known)
            continue;
        mean_x /= total;
        mean_y /= total;
        const double length = mean_x * mean_x + mean_y * mean_y, error = stderr_[n];
        const double expected = (squares / total - length) / 2 + error * error + scatter * scatter * length;
        const double along = mean_x * displacement[2 * n] + mean_y * displacement[2 * n + 1];
        against[n] = MAX(against[n], (length / 2 - along) / expected);
    }
    free(moves);
    out[0] = moving;
    return 0;
}

/* ---- markers/template.py ----------------------------------------------------------------------------------- */

#define PHASES 4

/* Fill `levels` with grey levels minus 128; BGR is converted as in OpenCV. */
INLINE void to_gray(const u8 *restrict pixels, i64 channels, i64 count, float *restrict levels)
{
    if (channels == 1)
        for (i64 x = 0; x < count; x++)
            levels[x] = (float)pixels[x] - 128;
    else
        for (i64 x = 0; x < count; x++) {
            const i32 level = 3735 * pixels[3 * x] + 19235 * pixels[3 * x + 1] + 9798 * pixels[3 * x + 2] + 16384;
            levels[x] = (float)(level >> 15) - 128;
        }
}

/* Fill `patch` with the grey levels of a disc around a px, the border replicated; returns the sum of squares about
 * the mean. */
INLINE double read_patch(const u8 *image, const i64 *shape, i64 left, i64 top, const i64 *widths, i64 rows,
                                float *restrict patch, i64 size)
{
    const i64 high = shape[0], wide = shape[1], channels = shape[2], reach = rows / 2;
    const int inside = left >= reach && top >= reach && left + reach < wide && top + reach < high;
    float *line = patch;
    for (i64 row = 0; row < rows; row++) {
        const i64 count = widths[row], begin = left - count / 2;
        if (inside)
            to_gray(image + ((top - reach + row) * wide + begin) * channels, channels, count, line);
        else {
            const i64 y = MIN(MAX(top - reach + row, 0), high - 1);
            for (i64 k = 0; k < count; k++)
                to_gray(image + (y * wide + MIN(MAX(begin + k, 0), wide - 1)) * channels, channels, 1, line + k);
        }
        line += count;
    }
    float total = 0, squares = 0;
    for (i64 p = 0; p < size; p++) {
        total += patch[p];
        squares += patch[p] * patch[p];
    }
    return (double)squares - (double)total * total / (double)size;
}

/* The nearest phase to a coordinate: PHASES times the px plus the phase. NaN becomes a point inside. */
INLINE i64 nearest_phase(double x, i64 extent)
{
    const double inside = x > 0 ? MIN(x, (double)extent - 1) : 0;
    return (i64)(inside * PHASES + PHASES / 2.0);
}

typedef struct {
    float gain, shift_x, shift_y;
    double r_squared, rest;
} Fit;

INLINE Fit fit_template(const i16 *weight, const float *term, const float *restrict patch, i64 size,
                               double varies)
{
    const i16 *restrict w0 = weight, *restrict w1 = w0 + size, *restrict w2 = w1 + size, *restrict w3 = w2 + size;
    const i16 *restrict w4 = w3 + size;
    float sum[5] = {0, 0, 0, 0, 0};
    for (i64 p = 0; p < size; p++) {
        sum[0] += (float)w0[p] * patch[p];
        sum[1] += (float)w1[p] * patch[p];
        sum[2] += (float)w2[p] * patch[p];
        sum[3] += (float)w3[p] * patch[p];
        sum[4] += (float)w4[p] * patch[p];
    }
    for (int k = 0; k < 5; k++)
        sum[k] *= term[10 + k];
    float explained = 0;
    for (int k = 0; k < 3; k++)
        explained += sum[k] * (term[3 * k] * sum[0] + term[3 * k + 1] * sum[1] + term[3 * k + 2] * sum[2]);
    const double contrast = varies - (double)(sum[3] * sum[3]) - (double)(sum[4] * sum[4]);
    const double tiny = 1.1754943508222875e-38, rest = MAX(contrast - explained, tiny);
    return (Fit){sum[0], sum[1], sum[2], explained / (explained + rest), rest};
}

LOOP align_marks(const Arg *a, double *out)
{
    const u8 *image = a[0].data;
    const double *start = a[1].data;
    const i64 *marks = a[2].data, *places = a[3].data, *widths = a[6].data, rows = a[6].shape[0];
    const i16 *weights = a[4].data;
    const float *terms = a[5].data, longest = (float)a[7].number;
    double *position = a[8].data;
    float *error = a[9].data;
    u8 *seen = a[10].data;
    const float least_gain = (float)a[11].number, least_fit = (float)a[12].number, sampling = (float)a[13].number;
    const i64 most_steps = a[14].whole, size = a[4].shape[2], count = a[4].shape[0] / (PHASES * PHASES);
    const i64 high = a[0].shape[0], wide = a[0].shape[1];
    float *patch = malloc((size + 1) * sizeof(float));
    (void)out;
    if (!patch)
        return OUT_OF_MEMORY;
    for (i64 number = 0; number < a[2].shape[0]; number++) {
        const i64 n = marks[number];
        double x = start[2 * n], y = start[2 * n + 1], varies = 0, noise = 0;
        i64 seen_left = -1, seen_top = -1, before_x = -1, before_y = -1;
        i64 phase_x = nearest_phase(x, wide), phase_y = nearest_phase(y, high);
        for (i64 step = 0; step <= most_steps; step++) {
            const i64 left = phase_x / PHASES, top = phase_y / PHASES;
            const i64 which = (phase_x % PHASES + phase_y % PHASES * PHASES) * count + places[number];
            const float *term = terms + 15 * which;
            /* A step of less than a pixel often needs the same patch at another phase. */
            if (left != seen_left || top != seen_top) {
                seen_left = left;
                seen_top = top;
                varies = read_patch(image, a[0].shape, left, top, widths, rows, patch, size);
            }
            const Fit fit = fit_template(weights + 5 * size * which, term, patch, size, varies);
            seen[n] = fit.gain > least_gain && fit.r_squared > least_fit;
            const float safe = MAX(fit.gain, least_gain), move_x = fit.shift_x / safe, move_y = fit.shift_y / safe;
            const double now_x = ((double)phase_x + 0.5) / PHASES - 0.5 + MIN(MAX(move_x, -longest), longest);
            const double now_y = ((double)phase_y + 0.5) / PHASES - 0.5 + MIN(MAX(move_y, -longest), longest);
            const i64 next_x = nearest_phase(now_x, wide), next_y = nearest_phase(now_y, high);
            noise = fit.rest * term[9] / ((double)safe * safe);
            if (next_x == before_x && next_y == before_y) {
                /* Two phases lead to each other: average, so that the result does not depend on the start. */
                x = (x + now_x) / 2;
                y = (y + now_y) / 2;
                break;
            }
            x = now_x;
            y = now_y;
            if (!seen[n] || (next_x == phase_x && next_y == phase_y))
                break;
            before_x = phase_x;
            before_y = phase_y;
            phase_x = next_x;
            phase_y = next_y;
        }
        position[2 * n] = x;
        position[2 * n + 1] = y;
        error[n] = (float)sqrt(noise + (double)(sampling * sampling));
    }
    free(patch);
    return 0;
}

/* ---- flow/motion.py ---------------------------------------------------------------------------------------- */

/* The upper one of the middle values, which are reordered (Hoare's selection). */
static double upper_median_of(double *values, i64 count)
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
static double median_of(double *values, i64 count)
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

LOOP rate_motion(const Arg *a, double *out)
{
    const double *position = a[0].data, *error = a[2].data, *rest = a[3].data;
    const u8 *tracked = a[1].data;
    const i64 *links = a[4].data, n = a[0].shape[0];
    const double limit = a[5].number, variance = a[6].number, resting = a[7].number;
    double *left = a[8].data, *bound = a[9].data;
    const double *rest_x = rest, *rest_y = rest + n, *arm_x = rest + 2 * n, *arm_y = rest + 3 * n, *lever_x = rest + 4 * n,
                 *lever_y = rest + 5 * n;
    double shift[3] = {0, 0, 0}, most = 0, second = 0, third = 0, chain = 0;
    i64 count = 0;
    /* The ratio of each marker, and the two largest ones among its neighbours. */
    double *ratio = calloc(3 * n + 1, sizeof(double)), *largest = ratio + n, *second_largest = largest + n;
    if (!ratio)
        return OUT_OF_MEMORY;
    /* The shift by x and by y, then the turn: each marker's motion across its arm, over the arm's length. */
    for (int part = 0; part < 3; part++) {
        count = 0;
        for (i64 i = 0; i < n; i++)
            if (tracked[i]) {
                const double x = position[2 * i] - rest_x[i] - shift[0], y = position[2 * i + 1] - rest_y[i] - shift[1];
                bound[count++] = part == 0 ? x : part == 1 ? y : y * lever_x[i] - x * lever_y[i];
            }
        shift[part] = count ? median_of(bound, count) : 0;
    }
    for (i64 i = 0; i < n; i++) {
        if (tracked[i] && count >= a[10].whole) {
            const double x = position[2 * i] - rest_x[i] - shift[0] + shift[2] * arm_y[i];
            const double y = position[2 * i + 1] - rest_y[i] - shift[1] - shift[2] * arm_x[i];
            left[i] = sqrt(x * x + y * y);
        }
        third = MAX(third, MIN(left[i], second));
        second = MAX(second, MIN(left[i], most));
        most = MAX(most, left[i]);
        bound[i] = limit * sqrt(error[i] * error[i] + variance);
        /* Nothing exceeds an unknown standard error, NaN. */
        if (left[i] > resting && bound[i] > 0)
            ratio[i] = left[i] / bound[i];
    }
    for (i64 k = 0; k < a[4].shape[0]; k++)
        for (int end = 0; end < 2; end++) {
            const i64 i = links[2 * k + end];
            const double other = ratio[links[2 * k + 1 - end]];
            second_largest[i] = MAX(second_largest[i], MIN(other, largest[i]));
            largest[i] = MAX(largest[i], other);
        }
    for (i64 i = 0; i < n; i++)
        chain = MAX(chain, MIN(ratio[i], second_largest[i]));
    free(ratio);
    out[0] = third;
    out[1] = chain;
    return 0;
}

/* ---- flow/displacement_field.py ---------------------------------------------------------------------------- */

LOOP sum_cells(const Arg *a, double *out)
{
    const double *weight = a[0].data, *moved = a[1].data, spacing = a[2].number, *to_markers = a[3].data;
    const double *between = a[5].data;
    double *products = a[6].data, *to_region = a[7].data, *prior = a[8].data;
    const i64 rows = a[0].shape[0], columns = a[0].shape[1], all_columns = a[3].shape[1], markers = a[3].shape[2];
    const i64 first_column = a[4].whole, size = rows * columns, high = a[5].shape[0], wide = a[5].shape[1];
    double *planes = calloc(3 * size + 1, sizeof(double)), x = 0, y = 0;
    (void)out;
    if (!planes)
        return OUT_OF_MEMORY;
    for (i64 row = 0; row < rows; row++)
        for (i64 column = 0; column < columns; column++) {
            x += weight[row * columns + column] * (double)column;
            y += weight[row * columns + column] * (double)row;
        }
    for (i64 row = 0; row < rows; row++)
        for (i64 column = 0; column < columns; column++) {
            const i64 cell = row * columns + column;
            if (weight[cell] == 0)
                continue;
            const i64 left = column > 0, right = column < columns - 1, up = row > 0, down = row < rows - 1;
            const double *here = moved + 2 * cell, *near = to_markers + (row * all_columns + first_column + column) * markers;
            double values[7] = {1, spacing * ((double)column - x), spacing * ((double)row - y), here[0], here[1]};
            for (int k = 0; k < 2; k++) {
                const double across = (here[2 * right + k] - here[-2 * left + k]) / (left + right == 2 ? 2 : 1);
                const double along = (here[2 * columns * down + k] - here[-2 * columns * up + k]) / (up + down == 2 ? 2 : 1);
                values[5 + k] = ((double)column - x) * across + ((double)row - y) * along;
            }
            for (int i = 0; i < 7; i++) {
                const double part = weight[cell] * values[i];
                for (int j = 0; j < 7; j++)
                    products[7 * i + j] += part * values[j];
                if (i < 3) {
                    double *restrict sums = to_region + i * markers;
                    planes[i * size + cell] = part;
                    for (i64 n = 0; n < markers; n++)
                        sums[n] += part * near[n];
                }
            }
        }
    /* Sums over pairs of cells; those over `other` above and below `row` are each other's transpose. */
    for (i64 row = 0; row < rows; row++)
        for (i64 column = 0; column < columns; column++) {
            if (weight[row * columns + column] == 0)
                continue;
            for (i64 other = 0; other <= row; other++) {
                const double *restrict line = between + (high / 2 + row - other) * wide + wide / 2 - column;
                const double *restrict ones = planes + other * columns, *restrict xs = ones + size, *restrict ys = xs + size;
                double sum[3] = {0, 0, 0};
                for (i64 n = 0; n < columns; n++) {
                    sum[0] += ones[n] * line[n];
                    sum[1] += xs[n] * line[n];
                    sum[2] += ys[n] * line[n];
                }
                for (int j = 0; j < 3; j++) {
                    const double part = planes[j * size + row * columns + column] * (other == row ? 0.5 : 1);
                    for (int i = 0; i < 3; i++)
                        prior[3 * i + j] += sum[i] * part;
                }
            }
        }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j <= i; j++)
            prior[3 * i + j] = prior[3 * j + i] = prior[3 * i + j] + prior[3 * j + i];
    free(planes);
    return 0;
}

/* ---- flow/registration.py ---------------------------------------------------------------------------------- */

LOOP compare_light(const Arg *a, double *out)
{
    const float *change = a[0].data, *away = a[3].data, *light = a[4].data, *by = a[5].data;
    const double *warp = a[1].data, gain = a[2].number;
    const i64 *patches = a[6].data, high = a[0].shape[0], wide = a[0].shape[1], n = a[3].shape[0];
    float *error = a[7].data;
    double *sums = a[8].data, patch[3] = {0, 0, 0};
    i64 count = 0;
    for (int k = 0; k < 10; k++)
        sums[k] = 0;
    for (i64 i = 0; i < n; i++) {
        float *mine = error + 3 * i;
        if (i > 0 && patches[i] != patches[i - 1])
            for (int c = 0; c < 3; c++) {
                sums[6] += patch[c] * patch[c];
                patch[c] = 0;
            }
        mine[0] = mine[1] = mine[2] = 0;
        const double x = warp[0] * away[2 * i] - warp[1] * away[2 * i + 1] + warp[2];
        const double y = warp[1] * away[2 * i] + warp[0] * away[2 * i + 1] + warp[3];
        if (!(0 <= x && x < (double)(wide - 1) && 0 <= y && y < (double)(high - 1)))
            continue;
        const i64 column = (i64)x, row = (i64)y;
        const float *upper = change + 4 * (row * wide + column), *lower = upper + 4 * wide;
        if (upper[3] < 1 || upper[7] < 1 || lower[3] < 1 || lower[7] < 1)
            continue;
        const double right = x - (double)column, down = y - (double)row;
        count++;
        for (int c = 0; c < 3; c++) {
            const double above = upper[c] + right * (upper[4 + c] - upper[c]);
            const double below = lower[c] + right * (lower[4 + c] - lower[c]);
            const double rest = above + down * (below - above) - gain * light[3 * i + c];
            const float *slope = by + (3 * i + c) * 5;
            mine[c] = (float)rest;
            patch[c] += rest;
            sums[5] += rest * rest;
            sums[7 + c] += rest;
            for (int k = 0; k < 5; k++)
                sums[k] += slope[k] * rest;
        }
    }
    for (int c = 0; c < 3; c++)
        sums[6] += patch[c] * patch[c];
    out[0] = (double)count;
    return 0;
}

/* ---- pose/align.py ----------------------------------------------------------------------------------------- */

LOOP compare_points(const Arg *a, double *out)
{
    const float *planes = a[0].data;
    const double *first = a[1].data, *cell = a[2].data, *m = a[3].data, *points = a[4].data, *by = a[5].data;
    const double middle = a[6].number;
    double *error = a[7].data, *weight = a[8].data, *normals = a[9].data, *height = a[10].data, *totals = a[11].data;
    const i64 high = a[0].shape[0], wide = a[0].shape[1], depth_of = a[0].shape[2];
    (void)out;
    for (i64 n = 0; n < a[4].shape[0]; n++) {
        const double *point = points + n * a[4].shape[1], *slope = by + n * a[5].shape[1] * a[5].shape[2];
        const double moved_x = m[0] * point[0] + m[1] * point[1] + m[2] * point[2];
        const double moved_y = m[4] * point[0] + m[5] * point[1] + m[6] * point[2];
        const double column = (moved_x + m[3] - first[0]) / cell[0], row = (moved_y + m[7] - first[1]) / cell[1];
        if (!(0 <= column && column < (double)(wide - 1) && 0 <= row && row < (double)(high - 1)))
            continue;
        const i64 left = (i64)column, top = (i64)row;
        const double right = column - (double)left, low = row - (double)top;
        const float *corner = planes + (top * wide + left) * depth_of;
        double seen[4], values[7];
        for (int k = 0; k < 4; k++) {
            const double above = (1 - right) * corner[k] + right * corner[depth_of + k];
            const double below = (1 - right) * corner[wide * depth_of + k] + right * corner[(wide + 1) * depth_of + k];
            seen[k] = (1 - low) * above + low * below;
        }
        const double share = point[5] * seen[3];
        if (share <= 0)
            continue;
        const double rest = 1 - seen[0] * seen[0] - seen[1] * seen[1], upright = sqrt(MAX(rest, 0));
        for (int k = 0; k < 2; k++) {
            error[2 * n + k] = m[k] * seen[0] + m[4 + k] * seen[1] + m[8 + k] * upright - point[3 + k];
            for (int i = 0; i < 6; i++)
                values[i] = slope[k * a[5].shape[2] + i];
            values[6] = error[2 * n + k];
            for (int i = 0; i < 7; i++)
                for (int j = 0; j <= i; j++)
                    normals[7 * i + j] += share * values[i] * values[j];
        }
        const double depth = seen[2] - middle - m[11];
        for (int i = 0; i < 6; i++)
            height[i] += share * slope[2 * a[5].shape[2] + i];
        height[6] += share * (m[2] * moved_x + m[6] * moved_y + m[10] * depth - point[2]);
        height[7] += share * (depth - point[2]);
        weight[n] = share;
        totals[0] += 1;
        totals[1] += share;
    }
    for (int i = 0; i < 7; i++)
        for (int j = 0; j < i; j++)
            normals[7 * j + i] = normals[7 * i + j];
    return 0;
}

/* ---- depth/slopes.py --------------------------------------------------------------------------------------- */

/* One part of a normal, by the degree of the terms of the colour (b, g, r). by : for each term, in the order of
 * `TERM_FACTORS`, a quadratic polynomial of x. */
#define COLOUR_TERMS 19
#define AT(term) (by[3 * (term)] + x * (by[3 * (term) + 1] + x * by[3 * (term) + 2]))
INLINE float linear_part(const float *by, float x, float b, float g, float r)
{
    return b * AT(0) + g * AT(1) + r * AT(2);
}

INLINE float quadratic_part(const float *by, float x, float b, float g, float r)
{
    return b * (b * AT(3) + g * AT(4) + r * AT(5)) + g * (g * AT(6) + r * AT(7)) + r * r * AT(8);
}

INLINE float whole_part(const float *by, float x, float b, float g, float r)
{
    const float bb = AT(3) + b * AT(9) + g * AT(10) + r * AT(11), bg = AT(4) + g * AT(12) + r * AT(13);
    const float br = AT(5) + r * AT(14), gg = AT(6) + g * AT(15) + r * AT(16), gr = AT(7) + r * AT(17);
    const float rr = AT(8) + r * AT(18);
    return b * (AT(0) + b * bb + g * bg + r * br) + g * (AT(1) + g * gg + r * gr) + r * (AT(2) + r * rr);
}

/* The normal in proportion to where, on the line of colours from no change, it is as steep as `steepest`. */
INLINE void bend_back(const float *by, float x, float b, float g, float r, float steepest, i64 halvings, float *right,
                      float *down)
{
    const float *also = by + 3 * COLOUR_TERMS;
    const float ax = linear_part(by, x, b, g, r), bx = quadratic_part(by, x, b, g, r), cx = *right - ax - bx;
    const float ay = linear_part(also, x, b, g, r), by_ = quadratic_part(also, x, b, g, r), cy = *down - ay - by_;
    float low = 0, high = 1;
    for (i64 k = 0; k < halvings; k++) {
        const float t = (low + high) / 2;
        *right = ax + t * (bx + t * cx);
        *down = ay + t * (by_ + t * cy);
        if (t * t * (*right * *right + *down * *down) > steepest * steepest)
            high = t;
        else
            low = t;
    }
}

LOOP slopes_of_colour(const Arg *a, double *out)
{
    const float *change = a[0].data, *coefficients = a[1].data, *x = a[2].data, *y = a[3].data;
    const u8 *near = a[4].data;
    const float steepest = (float)a[5].number, most = (float)a[9].number;
    float *slope = a[6].data, by[6 * COLOUR_TERMS];
    const i64 bands = a[7].whole, halvings = a[8].whole, wide = a[2].shape[0], high = a[3].shape[0];
    float *restrict blue = malloc(3 * (wide + 1) * sizeof(float)), *restrict green = blue + wide;
    float *restrict red = green + wide;
    (void)out;
    if (!blue)
        return OUT_OF_MEMORY;
    for (i64 row = 0; row < high; row++) {
        const u8 *band = near + row / bands * wide;
        i64 start = 0, end = wide;
        while (start < end && !band[start])
            start++;
        while (end > start && !band[end - 1])
            end--;
        const i64 count = end - start;
        const float v = y[row], *restrict pixels = change + 3 * (row * wide + start), *restrict places = x + start;
        float *restrict right = slope + row * wide + start, *restrict down = slope + (high + row) * wide + start;
        for (i64 i = 0; i < count; i++) {
            blue[i] = pixels[3 * i];
            green[i] = pixels[3 * i + 1];
            red[i] = pixels[3 * i + 2];
        }
        /* In a row a coefficient is a quadratic polynomial of x alone. */
        for (int k = 0; k < 2 * COLOUR_TERMS; k++) {
            const float *f = coefficients + 6 * k;
            by[3 * k] = f[0] + v * (f[2] + v * f[5]);
            by[3 * k + 1] = f[1] + v * f[4];
            by[3 * k + 2] = f[3];
        }
        for (i64 i = 0; i < count; i++)
            right[i] = whole_part(by, places[i], blue[i], green[i], red[i]);
        for (i64 i = 0; i < count; i++)
            down[i] = whole_part(by + 3 * COLOUR_TERMS, places[i], blue[i], green[i], red[i]);
        for (i64 i = 0; i < count; i++)
            if (right[i] * right[i] + down[i] * down[i] > steepest * steepest)
                bend_back(by, places[i], blue[i], green[i], red[i], steepest, halvings, right + i, down + i);
        for (i64 i = 0; i < count; i++) {
            const float length = sqrtf(right[i] * right[i] + down[i] * down[i]), normal = MIN(length, most);
            const float longer = normal / (MAX(length, 1e-9f) * sqrtf(1 - normal * normal));
            right[i] *= longer;
            down[i] *= longer;
        }
    }
    free(blue);
    return 0;
}

/* ---- depth/surroundings.py, depth/surface.py ----------------------------------------------------------------- */

LOOP light_around(const Arg *a, double *out)
{
    const float *change = a[0].data, *level = a[1].data, *distance = a[2].data;
    const float nearest = (float)a[3].number, least = (float)a[4].number;
    float *growth = a[5].data;
    double *profile = a[6].data, *counts = profile + a[6].shape[1];
    const i64 cells = a[2].shape[0] * a[2].shape[1];
    double *ratios = malloc((cells + 1) * sizeof(double));
    (void)out;
    if (!ratios)
        return OUT_OF_MEMORY;
    for (int k = 0; k < 3; k++) {
        i64 count = 0;
        for (i64 i = 0; i < cells; i++)
            if (distance[i] >= nearest && level[3 * i + k] >= least)
                ratios[count++] = change[3 * i + k] / level[3 * i + k];
        growth[k] = count ? (float)upper_median_of(ratios, count) : 0;
    }
    free(ratios);
    for (i64 i = 0; i < cells; i++) {
        const i64 ring = (i64)distance[i];
        float square = 0;
        for (int k = 0; k < 3; k++) {
            const float off = change[3 * i + k] - growth[k] * level[3 * i + k];
            square += off * off;
        }
        profile[ring] += sqrtf(square);
        counts[ring] += 1;
    }
    return 0;
}

LOOP relative_change(const Arg *a, double *out)
{
    const u8 *picture = a[0].data, *untouched = a[1].data;
    const float *gain = a[4].data, offset = (float)a[5].number;
    float *change = a[6].data;
    const i64 stride = a[1].shape[1], top = a[2].whole, left = a[3].whole, high = a[6].shape[0], wide = a[6].shape[1];
    float *restrict inverse = malloc((wide + 1) * sizeof(float));
    (void)out;
    if (!inverse)
        return OUT_OF_MEMORY;
    for (i64 i = 0; i < wide; i++)
        inverse[i] = 1 / gain[i % 3];
    for (i64 y = 0; y < high; y++) {
        const i64 start = (top + y) * stride + left;
        const u8 *restrict now = picture + start, *restrict light = untouched + start;
        float *restrict row = change + y * wide;
        for (i64 i = 0; i < wide; i++)
            row[i] = (now[i] * inverse[i] - light[i]) / (light[i] + offset);
    }
    free(inverse);
    return 0;
}

/* Adds the squares of the mean slope of two pixels, twice each, where the second is in contact; and of what the heights
 * leave of it, `step` apart. */
INLINE void add_misfit(const float *first, const float *second, const float *low, const float *high, const u8 *contact,
                       float step, i64 count, double *total, double *left)
{
    float whole = 0, rest = 0;
    for (i64 i = 0; i < count; i++) {
        const float inside = contact[i] != 0, slope = first[i] + second[i], off = slope + (high[i] - low[i]) / step;
        whole += inside * slope * slope;
        rest += inside * off * off;
    }
    *total += whole;
    *left += rest;
}

LOOP slope_misfit(const Arg *a, double *out)
{
    const float *right = a[0].data, *height = a[1].data;
    const u8 *contact = a[2].data;
    const i64 high = a[1].shape[0], wide = a[1].shape[1];
    const float *down = right + high * wide, across = (float)a[3].number, along = (float)a[4].number;
    for (i64 y = 0; y < high; y++) {
        const i64 k = y * wide, before = k - wide;
        add_misfit(right + k, right + k + 1, height + k, height + k + 1, contact + k + 1, across, wide - 1, out, out + 1);
        if (y > 0)
            add_misfit(down + before, down + k, height + before, height + k, contact + k, along, wide, out, out + 1);
    }
    return 0;
}

/* ---- depth/poisson.py -------------------------------------------------------------------------------------- */

LOOP divergence(const Arg *a, double *out)
{
    const float *right = a[0].data, across = (float)a[1].number / 2, along = (float)a[2].number / 2;
    const float ends[4] = {(float)a[3].number, (float)a[4].number, (float)a[5].number, (float)a[6].number};
    float *total = a[7].data;
    const i64 high = a[7].shape[0], wide = a[7].shape[1];
    const float *down = right + high * wide;
    (void)out;
    for (i64 y = 0; y < high; y++) {
        const float *restrict row = right + y * wide;
        const float *restrict above = down + MAX(y - 1, 0) * wide, *restrict below = down + MIN(y + 1, high - 1) * wide;
        /* The pixel beyond a side is the mirror image of the last one before it. */
        const float up = y > 0 ? along : -along * ends[2], low = y < high - 1 ? along : -along * ends[3];
        float *restrict sum = total + y * wide;
        for (i64 x = 0; x < wide; x++)
            sum[x] = low * below[x] - up * above[x];
        for (i64 x = 1; x < wide - 1; x++)
            sum[x] += across * (row[x + 1] - row[x - 1]);
        sum[0] += across * (row[1] + ends[0] * row[0]);
        sum[wide - 1] -= across * (row[wide - 2] + ends[1] * row[wide - 1]);
    }
    return 0;
}

LOOP solve_down(const Arg *a, double *out)
{
    float *plane = a[0].data;
    const float *shift = a[1].data;
    const double ends[2] = {a[2].number, a[3].number};
    const i64 high = a[0].shape[0], wide = a[0].shape[1];
    /* Of each row: the inverse of its pivot, and its right side with the rows above eliminated. */
    double *inverse = malloc(2 * high * wide * sizeof(double)), *side = inverse + high * wide;
    (void)out;
    if (!inverse)
        return OUT_OF_MEMORY;
    for (i64 y = 0; y < high; y++) {
        const double middle = -2 + (y == 0 ? ends[0] : 0) + (y == high - 1 ? ends[1] : 0);
        double *restrict pivot = inverse + y * wide, *restrict now = side + y * wide;
        const double *above = pivot - wide, *before = now - wide;
        const float *restrict row = plane + y * wide;
        if (y == 0)
            for (i64 x = 0; x < wide; x++) {
                pivot[x] = 1 / (middle + shift[x]);
                now[x] = row[x] * pivot[x];
            }
        else
            for (i64 x = 0; x < wide; x++) {
                pivot[x] = 1 / (middle + shift[x] - above[x]);
                now[x] = (row[x] - before[x]) * pivot[x];
            }
    }
    for (i64 y = high - 1; y >= 0; y--) {
        const double *restrict pivot = inverse + y * wide, *below = side + (y + 1) * wide;
        double *restrict now = side + y * wide;
        float *restrict row = plane + y * wide;
        for (i64 x = 0; x < wide; x++) {
            if (y < high - 1)
                now[x] -= pivot[x] * below[x];
            row[x] = (float)now[x];
        }
    }
    free(inverse);
    return 0;
}

/* ---- Python ------------------------------------------------------------------------------------------------ */

/* arguments : one word for each. A letter is the type of an array's elements (u1 ? i2 i4 i8 f4 f8), the digit after
 * it the number of dimensions, and `!` that it is written to; `n` is a whole number, `x` a real one.
 * result : what `out` becomes, `-` nothing, `?` a bool, `n` an int, `2` and `4` a tuple of as many floats. */
typedef struct {
    const char *name, *arguments;
    char result;
    int (*run)(const Arg *, double *);
} Loop;

static const Loop LOOPS[] = {
    {"halve", "B2 n n B2!", '-', halve},
    {"smooth_cells", "B2 f3!", '-', smooth_cells},
    {"sum_tiles", "B2 n q1 h3 q3 f3 f3! f3!", '-', sum_tiles},
    {"find_excess", "f2 f2 x f3 f3 f3", '2', find_excess},
    {"weigh_change", "f3 f2 f3 f2 f3! f3!", '4', weigh_change},
    {"window_change", "B2 n n f2 f3 ?2 f2 f3! x", '-', window_change},
    {"contact_cells", "f2 x x x ?2 n ?2!", 'n', contact_cells},
    {"smooth_range", "f2", '2', smooth_range},
    {"largest_nearby", "f2 x f2!", '-', largest_nearby},
    {"outline_level", "f2 x B2 f2!", '-', outline_level},
    {"draw_level", "f2 n n B2!", '-', draw_level},
    {"largest_deviations", "f3 B2 d2 n", '2', largest_deviations},
    {"fit_light", "f3 f2 f2 f3 f3 f3 f3 f1 f2! x n x x", '-', fit_light},
    {"grow_level_lines", "f2 B2 f1 n i2! f1! i2!", 'n', grow_level_lines},
    {"select_contacts", "i2 f1 i2 i2! i2! x x x x", '2', select_contacts},
    {"fill_region", "i2 n n n n ?2! B3!", '-', fill_region},
    {"sum_pixels", "B2 q1!", '-', sum_pixels},
    {"row_ends", "B2 i2!", 'n', row_ends},
    {"convex_hull", "i2 i2!", '2', convex_hull},
    {"sum_harmonics", "i2 d1 x n d2!", '-', sum_harmonics},
    {"cover_spots", "B3 n n B2!", '-', cover_spots},
    {"fill_masked", "B2! B2 B2 q1 q1 n x x x", '-', fill_masked},
    {"weigh_motion", "d2 f1 ?1 q2 d2 x d1! n x x", '?', weigh_motion},
    {"align_marks", "B3 d2 q1 q1 h3 f2 q1 x d2! f1! ?1! x x x n", '-', align_marks},
    {"rate_motion", "d2 ?1 d1 d2 q2 x x x d1! d1! n", '2', rate_motion},
    {"sum_cells", "d2 d3 x d3 n d2 d2! d2! d2!", '-', sum_cells},
    {"compare_light", "f3 d1 x f2 f2 f3 q1 f2! d1!", 'n', compare_light},
    {"compare_points", "f3 d1 d1 d2 d2 d3 x d2! d1! d2! d1! d1!", '-', compare_points},
    {"light_around", "f3 f3 f2 x x f1! d2!", '-', light_around},
    {"relative_change", "B2 B2 n n f1 x f2!", '-', relative_change},
    {"slope_misfit", "f3 f2 B2 x x", '2', slope_misfit},
    {"divergence", "f3 x x x x x x f2!", '-', divergence},
    {"solve_down", "f2! f1 x x", '-', solve_down},
    {"slopes_of_colour", "f3 f3 f1 f1 B2 x f3! n n x", '-', slopes_of_colour},
};
#define COUNT ((int)(sizeof LOOPS / sizeof *LOOPS))
#define MOST_ARGUMENTS 16

/* Whether the elements of a buffer are of the type that a letter names; the C types of int32 and int64 differ. */
static int is_of(const Py_buffer *buffer, char type)
{
    const char given = buffer->format ? buffer->format[0] : 'B';
    if (type == 'q')
        return buffer->itemsize == 8 && (given == 'l' || given == 'q');
    if (type == 'i')
        return buffer->itemsize == 4 && (given == 'l' || given == 'i');
    return given == type && !buffer->format[1];
}

static PyObject *result_of(char result, const double *out)
{
    switch (result) {
    case '?':
        return PyBool_FromLong(out[0] != 0);
    case 'n':
        return PyLong_FromDouble(out[0]);
    case '2':
        return Py_BuildValue("(dd)", out[0], out[1]);
    case '4':
        return Py_BuildValue("(dddd)", out[0], out[1], out[2], out[3]);
    default:
        Py_RETURN_NONE;
    }
}

static PyObject *call(PyObject *which, PyObject *const *given, Py_ssize_t count)
{
    const Loop *loop = LOOPS + PyLong_AsLong(which);
    Arg args[MOST_ARGUMENTS];
    Py_buffer views[MOST_ARGUMENTS];
    PyObject *result = NULL;
    int opened = 0, number = 0;
    const char *word = loop->arguments;
    for (; *word; number++) {
        if (number >= count)
            break;
        Arg *arg = args + number;
        if (*word == 'n') {
            arg->whole = PyLong_AsLongLong(given[number]);
        } else if (*word == 'x') {
            arg->number = PyFloat_AsDouble(given[number]);
        } else {
            Py_buffer *view = views + opened;
            const int flags = PyBUF_FORMAT | PyBUF_C_CONTIGUOUS | (word[2] == '!' ? PyBUF_WRITABLE : 0);
            if (PyObject_GetBuffer(given[number], view, flags) < 0)
                goto done;
            opened++;
            if (view->ndim != word[1] - '0' || !is_of(view, *word)) {
                PyErr_Format(PyExc_TypeError, "%s: argument %d: required an array of type %c and %c dimensions",
                             loop->name, number + 1, *word, word[1]);
                goto done;
            }
            arg->data = view->buf;
            for (int k = 0; k < view->ndim; k++)
                arg->shape[k] = view->shape[k];
        }
        if (PyErr_Occurred())
            goto done;
        while (*word && *word != ' ')
            word++;
        while (*word == ' ')
            word++;
    }
    if (*word || number != count) {
        PyErr_Format(PyExc_TypeError, "%s: required the arguments %s, got %zd", loop->name, loop->arguments, count);
        goto done;
    }
    double out[4] = {0, 0, 0, 0};
    int failed;
    Py_BEGIN_ALLOW_THREADS
    failed = loop->run(args, out);
    Py_END_ALLOW_THREADS
    result = failed ? PyErr_NoMemory() : result_of(loop->result, out);
done:
    while (opened)
        PyBuffer_Release(views + --opened);
    return result;
}

static PyMethodDef METHODS[COUNT];

static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT, "_kernels", "The loops of tactflow.vision in C.", -1, NULL, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__kernels(void)
{
    PyObject *module = PyModule_Create(&MODULE);
    for (int i = 0; module && i < COUNT; i++) {
        METHODS[i] = (PyMethodDef){LOOPS[i].name, (PyCFunction)(void (*)(void))call, METH_FASTCALL, NULL};
        PyObject *which = PyLong_FromLong(i), *loop = which ? PyCFunction_NewEx(METHODS + i, which, NULL) : NULL;
        Py_XDECREF(which);
        if (!loop || PyModule_AddObjectRef(module, LOOPS[i].name, loop) < 0) {
            Py_XDECREF(loop);
            Py_CLEAR(module);
            break;
        }
        Py_DECREF(loop);
    }
    return module;
}
