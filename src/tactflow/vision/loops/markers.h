/* Marks: mask, inpainting, templates, which of them move. */
#include "loop.h"

/* ---- markers/detection.py ---------------------------------------------------------------------------------- */

/* The step from a point to the centroid of what is darker than the plane through the ring around it. */
INLINE void step_to_centroid(const float *gray, i64 high, i64 wide, i64 reach, double inner, double outer,
                             double window, double least, const double *center, double *step)
{
    const i64 column = MAX(MIN((i64)rint(center[0]), wide - 1), 0), row = MAX(MIN((i64)rint(center[1]), high - 1), 0);
    double n = 0, sx = 0, sy = 0, xx = 0, xy = 0, yy = 0, g = 0, gx = 0, gy = 0;
    for (i64 v = row - reach; v <= row + reach; v++) {
        const float *line = gray + MAX(MIN(v, high - 1), 0) * wide;
        for (i64 u = column - reach; u <= column + reach; u++) {
            const double x = u - center[0], y = v - center[1], away = sqrt(x * x + y * y);
            const double weight = MAX(MIN(away - inner, 1), 0) * MAX(MIN(outer - away, 1), 0);
            const double light = weight * line[MAX(MIN(u, wide - 1), 0)];
            n += weight, sx += weight * x, sy += weight * y;
            xx += weight * x * x, xy += weight * x * y, yy += weight * y * y;
            g += light, gx += light * x, gy += light * y;
        }
    }
    /* Cramer's rule. */
    const double a = xx * yy - xy * xy, b = sy * xy - sx * yy, c = sx * xy - sy * xx;
    const double whole = n * a + sx * b + sy * c;
    const double level = (g * a + gx * b + gy * c) / whole;
    const double along_x = (g * b + gx * (n * yy - sy * sy) + gy * (sx * sy - n * xy)) / whole;
    const double along_y = (g * c + gx * (sx * sy - n * xy) + gy * (n * xx - sx * sx)) / whole;
    double total = 0, to_x = 0, to_y = 0;
    for (i64 v = row - reach; v <= row + reach; v++) {
        const float *line = gray + MAX(MIN(v, high - 1), 0) * wide;
        for (i64 u = column - reach; u <= column + reach; u++) {
            const double x = u - center[0], y = v - center[1], away = sqrt(x * x + y * y);
            const double darker = level + along_x * x + along_y * y - line[MAX(MIN(u, wide - 1), 0)];
            const double darkness = MAX(darker, 0) * MAX(MIN(window - away, 1), 0);
            total += darkness, to_x += darkness * x, to_y += darkness * y;
        }
    }
    step[0] = total > least ? to_x / total : 0;
    step[1] = total > least ? to_y / total : 0;
}

LOOP move_to_centroids(const Arg *a, double *out)
{
    const double *radii = a[1].data, *inner = a[2].data, *outer = a[3].data, *window = a[4].data;
    double *center = a[6].data, largest = 0;
    (void)out;
    for (i64 i = 0; i < a[1].shape[0]; i++)
        largest = MAX(largest, outer[i]);
    for (i64 i = 0; i < a[1].shape[0]; i++, center += 2) {
        for (int turn = 0; turn < 4; turn++) {
            double step[2];
            step_to_centroid(a[0].data, a[0].shape[0], a[0].shape[1], (i64)ceil(largest), inner[i], outer[i],
                             window[i], a[5].number, center, step);
            for (int axis = 0; axis < 2; axis++)
                center[axis] += MAX(MIN(step[axis], radii[i]), -radii[i]);
        }
    }
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
