// The pixels' graph from slopes. Specification: links.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// MASK     1 if a mask is given
// WEIGHTS  weights of the slopes: 0 uniform, 1 a map, 2 a map for x and one for y, 3 maps for the links themselves
// HEIGHTS  known heights: 0 none, 1 with uniform weight, 2 with a map of weights
// KEEP     1 if the weights are output
//
// Optional arguments are left out: tests for null pointers made these loops 30 times slower. An item processes a
// piece of a row, or of ROWS rows. PoCL vectorises loops without branches and calls; pixels at the border of the
// maps are processed separately.

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define RIGHT 1
#define DOWN 2
#define SLOPE 4
#define KNOWN 8
#define LOST 16

#if TILE < 256
#define CHUNK TILE
#define ROWS 1
#else
#define CHUNK 256
#define ROWS 16
#endif

#define FINITE(value) ((value) - (value) == 0.0f)

#if MASK
#define MASK_MAP __global const uchar *restrict mask,
#define WANTED(p) (mask[p] != 0)
#else
#define MASK_MAP
#define WANTED(p) 1
#endif

#if WEIGHTS == 0
#define WEIGHT_MAPS
#define X_COUNTS(p) 1
#define Y_COUNTS(p) 1
#define X_WEIGHT(here, next) weight_x
#define Y_WEIGHT(here, next) weight_y
#elif WEIGHTS == 1
#define WEIGHT_MAPS MAP map_x,
#define map_y map_x
#else
#define WEIGHT_MAPS MAP map_x, MAP map_y,
#endif

#if WEIGHTS
#define X_COUNTS(p) (map_x[p] > 0.0f)
#define Y_COUNTS(p) (map_y[p] > 0.0f)
#endif
#if WEIGHTS == 3
#define X_WEIGHT(here, next) (weight_x * map_x[here])
#define Y_WEIGHT(here, next) (weight_y * map_y[here])
#elif WEIGHTS
#define X_WEIGHT(here, next) harmonic(weight_x * map_x[here], weight_x * map_x[next])
#define Y_WEIGHT(here, next) harmonic(weight_y * map_y[here], weight_y * map_y[next])
#endif

#if HEIGHTS == 0
#define HEIGHT_MAPS
#elif HEIGHTS == 1
#define HEIGHT_MAPS MAP heights,
#define ANCHOR(p) weight_z
#define IS_KNOWN(p) FINITE(heights[p])
#else
#define HEIGHT_MAPS MAP heights, MAP height_weights,
#define ANCHOR(p) (weight_z * height_weights[p])
#define IS_KNOWN(p) (FINITE(heights[p]) & (height_weights[p] > 0.0f))
#endif

// Starts a loop of an item: columns begin to end of the rows top to bottom.
#define PIECE(rows_of_it)                                                                              \
    const int across_all = (columns + CHUNK - 1) / CHUNK, item = get_global_id(0);                     \
    const int top = item / across_all * rows_of_it, bottom = LESSER(rows, top + rows_of_it);           \
    const int begin = item % across_all * CHUNK, end = LESSER(columns, begin + CHUNK);

float harmonic(const float a, const float b)
{
    return 2.0f * a * b / (a + b);
}

#if WEIGHTS < 3
#if HEIGHTS
#define KNOWN_FLAG(p) (-(WANTED(p) & IS_KNOWN(p)) & KNOWN)
#else
#define KNOWN_FLAG(p) 0
#endif

// State of a pixel alone: RIGHT and DOWN if its slopes count along these links.
#define CLASSIFY(p, state) {                                                                               \
    const int real = FINITE(dz_dx[p]) & FINITE(dz_dy[p]);                                              \
    const int x = WANTED(p) & X_COUNTS(p), y = WANTED(p) & Y_COUNTS(p);                                \
    const int slope = real ? SLOPE : LOST, links = (-x & RIGHT) | (-y & DOWN);                         \
    state = (-(x | y) & slope) | (-real & links) | KNOWN_FLAG(p);                                      \
}

__kernel void links_flags(
    const int rows, const int columns, MAP dz_dx, MAP dz_dy,
    MASK_MAP WEIGHT_MAPS HEIGHT_MAPS __global uchar *restrict flags)
{
    PIECE(ROWS)
    if (top >= rows) return;
    const int width = end - begin, more = end < columns;
    int here[CHUNK + 1], below[CHUNK + 1];
    for (int i = 0; i < width + more; ++i) CLASSIFY(top * columns + begin + i, here[i])
    if (!more) here[width] = 0;
    for (int row = top; row < bottom; ++row) {
        const int first = row * columns + begin, down = row + 1 < rows ? columns : 0;
        const int open = down ? RIGHT | DOWN : RIGHT;
        for (int i = 0; i < width + more; ++i) CLASSIFY(first + down + i, below[i])
        if (!more) below[width] = 0;
        for (int i = 0; i < width; ++i) {
            const int links = (here[i + 1] & RIGHT) | (below[i] & DOWN);
            flags[first + i] = here[i] & (links & open | ~(RIGHT | DOWN));
        }
        for (int i = 0; i <= width; ++i) here[i] = below[i];
    }
}
#endif

#define UNLIKE(a, b) ((dz_dx[a] - dz_dx[b]) * (dz_dx[a] - dz_dx[b]) + (dz_dy[a] - dz_dy[b]) * (dz_dy[a] - dz_dy[b]))

// The neighbour to which a pixel on an edge keeps its link: the most similar one off the edge, otherwise -1.
int kept(
    const int p, const int row, const int column, const int columns, __global const float *dz_dx,
    __global const float *dz_dy, __global const uchar *edges, __global const uchar *flags)
{
    const int neighbours[4] = {p + 1, p - 1, p + columns, p - columns};
    const int linked[4] = {
        flags[p] & RIGHT, column > 0 && flags[p - (column > 0)] & RIGHT,
        flags[p] & DOWN, row > 0 && flags[row > 0 ? p - columns : p] & DOWN,
    };
    int best = -1;
    float smallest = INFINITY;
    for (int side = 0; side < 4; ++side) {
        if (!linked[side] || edges[neighbours[side]]) continue;
        const float far = UNLIKE(neighbours[side], p);
        if (far < smallest) {
            smallest = far;
            best = neighbours[side];
        }
    }
    return best;
}

#define KEPT(p, row, column) kept(p, row, column, columns, dz_dx, dz_dy, edges, flags)

__kernel void links_cut(
    const int rows, const int columns, MAP dz_dx, MAP dz_dy, __global const uchar *restrict edges,
    __global const uchar *restrict flags, __global uchar *restrict cut)
{
    PIECE(1)
    if (top >= rows) return;
    const int first = top * columns;
    for (int p = first + begin; p < first + end; ++p) cut[p] = flags[p];
    const int down = top + 1 < rows ? columns : 0;
    for (int column = begin; column < end; ++column) {
        const int p = first + column, right = p + (column + 1 < columns), below = p + down;
        if (!(edges[p] | edges[right] | edges[below])) continue;
        const int joins = (!edges[p] || KEPT(p, top, column) == right)
            && (!edges[right] || KEPT(right, top, column + 1) == p);
        const int meets = (!edges[p] || KEPT(p, top, column) == below)
            && (!edges[below] || KEPT(below, top + 1, column) == p);
        cut[p] = flags[p] & ~((joins ? 0 : RIGHT) | (meets ? 0 : DOWN));
    }
}

// Slope of the link from here to next: from four pixels in line if links connect all of them (bit is 0
// otherwise), else the mean of two.
float link_slope(
    __global const float *slope, __global const uchar *flags, const int before, const int here, const int next,
    const int after, const int bit)
{
    const float near = slope[here] + slope[next], far = slope[before] + slope[after];
    const float four = 0.5f * near + (near - far) * (1.0f / 24);
    return (flags[before] & flags[here] & flags[next] & bit) ? four : 0.5f * near;
}

// A link's weight times its required rise. It is computed everywhere and selected afterwards, without
// branches and calls.
float required(const int linked, const float weight, const float size, const float slope, const float plane)
{
    const float all = weight * (size * (slope - plane));
    return linked ? all : 0.0f;
}

float chosen(const int linked, const float value)
{
    return linked ? value : 0.0f;
}

#define X_SLOPE(p, before, bit) link_slope(dz_dx, flags, before, p, (p) + 1, (p) + 2, bit)
#define Y_SLOPE(p) link_slope(dz_dy, flags, (p) - before, p, (p) + next, (p) + after, line)
#define X_RISE(p, before, bit)                                                                         \
    required(flags[p] & RIGHT, X_WEIGHT(p, (p) + 1), size_x, X_SLOPE(p, before, bit), plane_x)
#define Y_RISE(p) required(flags[p] & DOWN, Y_WEIGHT(p, (p) + next), -size_y, Y_SLOPE(p), plane_y)

// Offsets of a row's neighbours, and whether links downwards have pixels in line with them.
#define NEIGHBOURS(row)                                                                                \
    const int before = (row) > 0 ? columns : 0, next = (row) + 1 < rows ? columns : 0;                 \
    const int after = (row) + 2 < rows ? 2 * columns : next, line = (row) > 0 ? DOWN : 0;

#define LEVEL(row, column) (plane_z + (plane_x * size_x * (column) - plane_y * size_y * (row)))

#define GRAPH                                                                                          \
    const int rows, const int columns, MAP dz_dx,                           \
        MAP dz_dy, __global const uchar *restrict flags, WEIGHT_MAPS        \
        HEIGHT_MAPS const float weight_x, const float weight_y, const float weight_z,                  \
        const float size_x, const float size_y, const float plane_x, const float plane_y,              \
        const float plane_z

#if KEEP && HEIGHTS
#define KEPT_MAPS OUT right, OUT down, OUT anchor,
#elif KEEP
#define KEPT_MAPS OUT right, OUT down,
#else
#define KEPT_MAPS
#endif

// Rows of the output are `stride` apart, from `start` on.
__kernel void links_join(GRAPH, KEPT_MAPS OUT source, const long start, const int stride)
{
    PIECE(ROWS)
    if (top >= rows) return;
    const int width = end - begin;
    float from_left[CHUNK + 1], above[CHUNK];
    for (int i = 0; i < width; ++i) above[i] = 0.0f;
    if (top > 0) {
        NEIGHBOURS(top - 1)
        const int first = (top - 1) * columns + begin;
        for (int i = 0; i < width; ++i) above[i] = Y_RISE(first + i);
    }
    for (int row = top; row < bottom; ++row) {
        const int first = row * columns + begin;
#if CHUNK > 1  // no link starts or ends where no pixel counts
        int some = 0;
        for (int i = 0; i < width; ++i) some |= flags[first + i];
        if (!some) {
            const long at = start + (long)row * stride + begin;
            for (int i = 0; i < width; ++i) source[at + i] = above[i] = 0.0f;
#if KEEP
            for (int i = 0; i < width; ++i) right[at + i] = down[at + i] = 0.0f;
#if HEIGHTS
            for (int i = 0; i < width; ++i) anchor[at + i] = 0.0f;
#endif
#endif
            continue;
        }
#endif
        NEIGHBOURS(row)
        from_left[0] = begin > 0 ? X_RISE(first - 1, GREATER(first - 2, 0), begin > 1 ? RIGHT : 0) : 0.0f;
        from_left[1] = X_RISE(first, GREATER(first - 1, 0), begin > 0 ? RIGHT : 0);
        for (int i = 1; i < width; ++i) from_left[i + 1] = X_RISE(first + i, first + i - 1, RIGHT);
        for (int i = 0; i < width; ++i) {
            const int p = first + i;
            const long at = start + (long)row * stride + begin + i;
            const float below = Y_RISE(p);
            float sum = from_left[i] - from_left[i + 1] + above[i] - below;
            above[i] = below;
#if HEIGHTS
            const float weight = ANCHOR(p), rise = heights[p] - LEVEL(row, begin + i);
            sum += chosen(flags[p] & KNOWN, weight * rise);
#endif
            source[at] = sum;
#if KEEP
            right[at] = chosen(flags[p] & RIGHT, X_WEIGHT(p, p + 1));
            down[at] = chosen(flags[p] & DOWN, Y_WEIGHT(p, p + next));
#if HEIGHTS
            anchor[at] = chosen(flags[p] & KNOWN, weight);
#endif
#endif
        }
    }
}

#if HEIGHTS
#define HEIGHT_SQUARE(p, row, column)                                                                  \
    square(flags[p] & KNOWN, ANCHOR(p), relief[p] + LEVEL(row, column) - heights[p])
#else
#define HEIGHT_SQUARE(p, row, column) 0.0f
#endif
#define ADD_SQUARES(column, previous, bit) {                                                           \
    const int p = first + (column);                                                                    \
    const float x = relief[p + 1] - relief[p] - size_x * (X_SLOPE(p, previous, bit) - plane_x);        \
    const float y = relief[p + next] - relief[p] + size_y * (Y_SLOPE(p) - plane_y);                    \
    squares[(column) - begin] += square(flags[p] & RIGHT, X_WEIGHT(p, p + 1), x)                       \
        + square(flags[p] & DOWN, Y_WEIGHT(p, p + next), y) + HEIGHT_SQUARE(p, row, column);           \
}

float square(const int linked, const float weight, const float misfit)
{
    const float all = weight * misfit * misfit;
    return linked ? all : 0.0f;
}

// Sums per item or per group: squared residuals times their weights.
__kernel GROUP_SIZE void links_misfit(GRAPH, MAP reliefs, const int place, OUT sums)
{
    PIECE(ROWS)
    MAP relief = reliefs + (long)place * rows * columns;
    float squares[CHUNK];
    for (int i = 0; i < end - begin; ++i) squares[i] = 0.0f;
    for (int row = top; row < bottom; ++row) {
        const int first = row * columns;
        NEIGHBOURS(row)
        ADD_SQUARES(begin, GREATER(p - 1, 0), begin > 0 ? RIGHT : 0)
        for (int column = begin + 1; column < end; ++column) ADD_SQUARES(column, p - 1, RIGHT)
    }
    float sum = 0.0f;
    for (int i = 0; i < end - begin; ++i) sum += squares[i];
#if GROUP > 1
    __local float some[GROUP];
    some[get_local_id(0)] = sum;
    GROUP_SUM(some, GROUP)
    if (get_local_id(0) == 0) sums[get_group_id(0)] = some[0];
#else
    if (top < rows) sums[item] = sum;
#endif
}
