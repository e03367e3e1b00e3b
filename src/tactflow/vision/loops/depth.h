/* Slopes and heights. */
#include "loop.h"

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
