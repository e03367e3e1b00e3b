/* Regions and their outlines. */
#include "loop.h"

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
