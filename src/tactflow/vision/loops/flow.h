/* Motion of the gel, and alignment of heights. */
#include "loop.h"

/* ---- flow/motion.py ---------------------------------------------------------------------------------------- */

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
