/* Level lines of the heights under a contact. */
#include "loop.h"

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
