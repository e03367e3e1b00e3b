/* Pictures and what changes at rest. */
#include "loop.h"

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


LOOP sum_tiles(const Arg *a, double *out)
{
    const u8 *picture = a[0].data;
    const i64 left = a[1].whole, *used = a[2].data, *at_rest = a[4].data, stride = a[0].shape[1];
    const i16 *slopes = a[3].data;
    const float *factors = a[5].data;
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
        const float *restrict factor = factors + row * columns;
        for (i64 x = 0; x < columns; x++) {
            float total = 0;
            for (int y = 0; y < 3; y++)
                total += sums[y * padded + x] + sums[y * padded + x + 1] + sums[y * padded + x + 2];
            shift[row * columns + x] = total * factor[x] / 9;
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
