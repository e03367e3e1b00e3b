/* The change of the light under a contact, and its outline. */
#include "loop.h"

/* ---- contact/background_kernels.py ------------------------------------------------------------------------- */

#define MAX_GREY 255.0f

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
                const float more = line[x] - usual[x] - light, least = line[x] - MAX_GREY;
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
                const float more = value - usual[i] - light, least = value - MAX_GREY;
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
    if (!count)
        return 0;
    for (i64 i = 0; i < count; i++) {
        left = MIN(left, hull[2 * i]);
        right = MAX(right, hull[2 * i]);
        top = MIN(top, hull[2 * i + 1]);
        bottom = MAX(bottom, hull[2 * i + 1]);
    }
    for (i64 y = side * (i64)ceil(top / (double)side); y <= (i64)bottom; y += side)
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
    double *ratios = malloc(n * sizeof(double) + (wide + 6 * n) * sizeof(float));
    (void)out;
    if (!ratios)
        return OUT_OF_MEMORY;
    float *restrict line = (float *)(ratios + n);
    float *excess = line + wide, *limit = excess + 3 * n;
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
                    const float ratio = excess[at] * per_brightness[at];
                    ratios[count] = ratio;
                    most = MAX(most, ratio);
                    count += limit[at] > 0;
                }
            }
        }
        coefficients[4 * c] = count ? (float)upper_median_of(ratios, count) : most;
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
    free(ratios);
    return 0;
}
