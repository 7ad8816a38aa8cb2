// Removal of links where the surface is discontinuous. Specification: breaks.py.
//
// TILE   pixels of one work-item: 1 on a GPU, many on a CPU
// GROUP  work-items that reduce the cost of links together, 1 if each item does so alone
//
// Pixels of the last column have no link to the right, and those of the last row none down: any such pixel can
// replace the missing neighbours of the first column and row. PoCL vectorises loops without branches, calls and
// reductions.

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define RIGHT 1
#define DOWN 2

#define CHUNK (TILE < 256 ? TILE : 256)

#define SIZE const int rows, const int columns

// An item processes a piece of a row: ACTION is applied to pixel p with its four neighbours.
#define PIECE(ACTION)                                                                            \
    const int pieces = (columns + CHUNK - 1) / CHUNK, item = get_global_id(0), row = item / pieces; \
    const int count = rows * columns, up = row > 0 ? -columns : count - columns;                 \
    const int next = row + 1 < rows ? columns : 0, first = row * columns + item % pieces * CHUNK; \
    const int stop = row < rows ? LESSER(first + CHUNK, (row + 1) * columns) : 0;                \
    for (int p = first + (first == 0); p < stop - (stop == count); ++p) {                        \
        ACTION(p, p - 1, p + 1, p + up, p + next)                                                \
    }                                                                                            \
    if (first == 0) {                                                                            \
        const int p = 0;                                                                         \
        ACTION(p, count - 1, LESSER(1, count - 1), up, next)                                     \
    }                                                                                            \
    if (stop == count && count > 1) {                                                            \
        const int p = count - 1;                                                                 \
        ACTION(p, p - 1, p, p + up, p + next)                                                    \
    }

__kernel void breaks_curl(
    SIZE, __global const uchar *restrict flags, MAP slope_x, MAP slope_y, const float width, const float height, OUT curl)
{
#define ONE_CURL(p, before, after, above, below)                                                     \
    const int corner = LESSER(below + after - p, count - 1);                                         \
    const int closed = flags[p] & flags[below] & RIGHT && flags[p] & flags[after] & DOWN;            \
    const float across = slope_x[p] + slope_x[after] - (slope_x[below] + slope_x[corner]);           \
    const float along = slope_y[after] + slope_y[corner] - (slope_y[p] + slope_y[below]);            \
    curl[p] = closed ? 0.5f * (width * across + height * along) : 0;
    PIECE(ONE_CURL)
}

#define SIZE_OF(x) ((x) > 0 ? (x) : -(x))

__kernel void breaks_sum(SIZE, MAP values, const int reach, const int downwards, OUT sums)
{
#define ONE_SUM(p, before, after, above, below)                                                      \
    const int place = downwards ? row : p - row * columns, end = downwards ? rows : columns;         \
    const int from = GREATER(-reach, -place), to = LESSER(reach, end - 1 - place);                   \
    float sum = 0;                                                                                   \
    for (int i = from; i <= to; ++i) sum += values[p + (downwards ? i * columns : i)];               \
    sums[p] = sum;
    PIECE(ONE_SUM)
}

__kernel void breaks_spread(SIZE, MAP curl, MAP sums, const int reach, const float noise, const int wide, OUT tears)
{
#define ONE_TEAR(p, before, after, above, below)                                                     \
    const float mean = SIZE_OF(sums[p]) / (2 * reach + 1), both = SIZE_OF(curl[p]) * mean + 1e-30f;  \
    const float excess = (wide ? mean : root(both)) - noise;                                         \
    tears[p] = excess > 0 && row + 1 < rows && p + 1 < (row + 1) * columns ? excess : 0;
    PIECE(ONE_TEAR)
}

__kernel void breaks_trust(
    SIZE, MAP right, MAP down, MAP slope_x, MAP slope_y, MAP facing, MAP tears, const float noise, const float bend,
    const float tear, const float min_trust, OUT weight_x, OUT weight_y, OUT rise_x, OUT rise_y)
{
#define LINK(to, other, slope, link, weight, rise)                                                   \
    const float sure_##slope = facing[to] * facing[to] * facing[to] * facing[to];                    \
    const float torn_##slope = tear * GREATER(tears[p], tears[other]);                               \
    const float bent_##slope = bend * (slope[p] - slope[to]);                                        \
    const float unsure_##slope = 0.5f * noise * (1 / sure + 1 / sure_##slope);                       \
    const float all_##slope = unsure_##slope + bent_##slope * bent_##slope + torn_##slope * torn_##slope; \
    weight[p] = link[p] * GREATER(noise / all_##slope, min_trust);                                                 \
    rise[p] = 0.5f * (slope[p] + slope[to]);
#define ONE_TRUST(p, before, after, above, below)                                                    \
    const float sure = facing[p] * facing[p] * facing[p] * facing[p];                                \
    LINK(after, above, slope_x, right, weight_x, rise_x)                                             \
    LINK(below, before, slope_y, down, weight_y, rise_y)
    PIECE(ONE_TRUST)
}

__kernel GROUP_SIZE void breaks_links(
    SIZE, MAP weight_x, MAP weight_y, MAP rise_x, MAP rise_y, MAP slope_x, MAP slope_y, MAP held, MAP heights, const float width, const float height,
    const float slack, const float sharpness, const float max_square, OUT right, OUT down, OUT source, OUT sums)
{
#define MISS(from, to, rise, slope, size)                                                              \
    GREATER(SIZE_OF((heights[to] - heights[from]) / size - rise[from]) - slack * SIZE_OF(slope[to] - slope[from]), 0)
#define KEEP(square) (square > max_square ? 0.0f : 1 / ((1 + square) * (1 + square)))
#define ONE_LINK(p, before, after, above, below)                                                     \
    const float x = MISS(p, after, rise_x, slope_x, width), y = MISS(p, below, rise_y, slope_y, height);               \
    const float excess = MISS(before, p, rise_x, slope_x, width), over = MISS(above, p, rise_y, slope_y, height);      \
    const float xx = sharpness * x * x, yy = sharpness * y * y;                                      \
    const float ll = sharpness * excess * excess, oo = sharpness * over * over;                      \
    const float to_x = weight_x[p] * KEEP(xx), to_y = weight_y[p] * KEEP(yy);                        \
    const float from_x = weight_x[before] * KEEP(ll), from_y = weight_y[above] * KEEP(oo);           \
    right[p] = to_x;                                                                                 \
    down[p] = to_y;                                                                                  \
    source[p] = width * (from_x * rise_x[before] - to_x * rise_x[p])                                 \
        + height * (from_y * rise_y[above] - to_y * rise_y[p]) + held[p];                            \
    costs[p - start] = (weight_x[p] > 0 ? xx / (1 + xx) : 0) + (weight_y[p] > 0 ? yy / (1 + yy) : 0);
    const int all = (columns + CHUNK - 1) / CHUNK, mine = get_global_id(0);
    const int start = mine / all * columns + mine % all * CHUNK;
    float costs[CHUNK];
    PIECE(ONE_LINK)
    float sum = 0;
    for (int i = 0; i < stop - start; ++i) sum += costs[i];
#if GROUP > 1
    __local float some[GROUP];
    some[get_local_id(0)] = sum;
    GROUP_SUM(some, GROUP)
    if (get_local_id(0) == 0) sums[get_group_id(0)] = some[0];
#else
    if (row < rows) sums[mine] = sum;
#endif
}
