// Links that let go where the surface breaks. Specification: bilateral.py.
//
// TILE   pixels of one work-item; 1 where an item is a lane, many where it is a core's loop
// KNOWN  1 where heights are known, 0 where none is: the maps of them are left out then
//
// No pixel of the last column has a link to the right, and none of the last row one down: so the pixel before the
// first of a row, and the one above the first row, may be any of those. PoCL makes vector code of loops without
// branches, calls and sums.

#include "common.clh"

#define RIGHT 1
#define DOWN 2
#define SHARE 1e-6f
#define LN2 0.69314718f

#define CHUNK (TILE < 256 ? TILE : 256)

#define SIZE const int rows, const int columns
#define SLOPES __global const uchar *restrict flags, MAP slope_x, MAP slope_y

#if KNOWN
#define KNOWN_MAPS MAP anchor, MAP known,
#define HELD_MAPS MAP anchor, MAP known, MAP heights,
#define HELD(p) + anchor[p] * (heights[p] - known[p]) * (heights[p] - known[p])
#define HOLDS(p) + anchor[p] * (known[p] - heights[p])
#else
#define KNOWN_MAPS
#define HELD_MAPS
#define HELD(p)
#define HOLDS(p)
#endif

// An item has a piece of a row: what ACTION does to pixel p with those before, after, above and below.
#define PIECE(ACTION)                                                                            \
    const int pieces = (columns + CHUNK - 1) / CHUNK, item = get_global_id(0), row = item / pieces; \
    if (row >= rows) return;                                                                     \
    const int count = rows * columns, up = row > 0 ? -columns : count - columns;                 \
    const int next = row + 1 < rows ? columns : 0, first = row * columns + item % pieces * CHUNK; \
    const int stop = LESSER(first + CHUNK, (row + 1) * columns);                                 \
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

__kernel void bilateral_curl(SIZE, SLOPES, const float width, const float height, OUT curl)
{
#define ONE_CURL(p, before, after, above, below)                                                     \
    const int corner = LESSER(below + after - p, count - 1);                                         \
    const int closed = flags[p] & flags[below] & RIGHT && flags[p] & flags[after] & DOWN;            \
    const float across = slope_x[p] + slope_x[after] - (slope_x[below] + slope_x[corner]);           \
    const float along = slope_y[after] + slope_y[corner] - (slope_y[p] + slope_y[below]);            \
    curl[p] = closed ? 0.5f * (width * across + height * along) : 0;
    PIECE(ONE_CURL)
}

// e to the power of x, for x from -80 to 0, to a few units in the last place.
float power(const float x)
{
    const float steps = x * 1.44269504f - 0.5f;
    const int whole = (int)steps; // towards 0: the nearest
    const float rest = (x - whole * 0.693359375f) + whole * 2.12194440e-4f;
    const float tail = 0.5f + rest * (0.16666667f + rest * (0.041666668f + rest * (8.3333333e-3f
        + rest * (1.3888889e-3f + rest * 1.9841270e-4f))));
    return (1 + (rest + rest * rest * tail)) * as_float((whole + 127) << 23);
}

// The lesser of two squares and, over k, ln 2 - ln(1 + small); by a series where these are close to each other.
float saved(const float one, const float other, const float apart, const float small, const float inverse)
{
    const float least = one < other ? one : other;
    const float t = small / (2 + small), tt = t * t; // ln(1 + small) = 2 artanh t
    const float logarithm = 2 * t * (1 + tt * (1.0f / 3 + tt * (0.2f + tt * (1.0f / 7 + tt * (1.0f / 9 + tt / 11)))));
    const float h = 0.5f * apart, hh = h * h; // ln cosh h
    const float series = hh * (0.5f - hh * (1.0f / 12 - hh * (1.0f / 45 - hh * (17.0f / 2520))));
    return apart < 0.5f ? 0.5f * (one + other) - series * inverse : least + (LN2 - logarithm) * inverse;
}

// The share of a pixel's weight along an axis that goes to the link after it, and the pixel's cost.
#define AXIS(there, slope, to_after, to_before, over, share, cost)                                              \
    const float rise_##there = (heights[to_after] - heights[p]) * over - slope[p];                              \
    const float fall_##there = (heights[p] - heights[to_before]) * over - slope[p];                             \
    const int has_##there = flags[p] & there, had_##there = flags[to_before] & there;                           \
    const float one_##there = has_##there ? steep[p] * rise_##there * rise_##there : 0;                         \
    const float other_##there = had_##there ? steep[p] * fall_##there * fall_##there : 0;                       \
    const float more_##there = one_##there - other_##there;                                                     \
    const float apart_##there = k * (more_##there > 0 ? more_##there : -more_##there);                          \
    const float small_##there = power(apart_##there < 80 ? -apart_##there : -80.0f);                            \
    const float part_##there = small_##there / (1 + small_##there);                                             \
    const float minor_##there = part_##there < SHARE ? 0 : part_##there;                                        \
    const float soft_##there = more_##there > 0 ? minor_##there : 1 - minor_##there;                            \
    const float paid_##there = saved(one_##there, other_##there, apart_##there, small_##there, inverse);        \
    share[p] = had_##there ? has_##there ? soft_##there : 0 : 1;                                                \
    const float cost = had_##there && has_##there ? paid_##there : one_##there + other_##there;

__kernel void bilateral_shares(
    SIZE, SLOPES, MAP steep, MAP confidence_x, MAP confidence_y, KNOWN_MAPS MAP heights, const float k, const float width,
    const float height, OUT share_x, OUT share_y, OUT sums)
{
#define ONE_SHARE(p, before, after, above, below)                                                    \
    AXIS(RIGHT, slope_x, after, before, over_x, share_x, cost_x)                                     \
    AXIS(DOWN, slope_y, below, above, over_y, share_y, cost_y)                                       \
    costs[p - start] = confidence_x[p] * cost_x + confidence_y[p] * cost_y HELD(p);
    const float over_x = 1 / width, over_y = 1 / height, inverse = k > 0 ? 1 / k : 0;
    const int all = (columns + CHUNK - 1) / CHUNK, mine = get_global_id(0);
    const int start = mine / all * columns + mine % all * CHUNK;
    float costs[CHUNK];
    PIECE(ONE_SHARE)
    float sum = 0;
    for (int i = 0; i < stop - start; ++i) sum += costs[i];
    sums[mine] = sum;
}

__kernel void bilateral_links(
    SIZE, SLOPES, MAP steep, MAP confidence_x, MAP confidence_y, MAP share_x, MAP share_y, MAP heights, const float width,
    const float height, OUT right, OUT down, OUT pull_x, OUT pull_y)
{
#define LINK(there, to, sure, share, slope, over, unit, weight, pull)                                \
    const float here_##there = share[p] * steep[p] * sure[p];                                        \
    const float far_##there = (1 - share[to]) * steep[to] * sure[to];                                \
    const float rise_##there = (heights[to] - heights[p]) * over;                                    \
    const float from_##there = here_##there * (rise_##there - slope[p]);                             \
    const float asked_##there = from_##there + far_##there * (rise_##there - slope[to]);             \
    weight[p] = flags[p] & there ? (here_##there + far_##there) * over * unit : 0;                   \
    pull[p] = flags[p] & there ? asked_##there * unit : 0;
#define ONE_LINK(p, before, after, above, below)                                                     \
    LINK(RIGHT, after, confidence_x, share_x, slope_x, over_x, height, right, pull_x)                      \
    LINK(DOWN, below, confidence_y, share_y, slope_y, over_y, width, down, pull_y)
    const float over_x = 1 / width, over_y = 1 / height;
    PIECE(ONE_LINK)
}

__kernel void bilateral_open(SIZE, MAP curl, const float level, OUT right, OUT down, OUT pull_x, OUT pull_y)
{
#define KEPT(p) (1 / ((1 + curl[p] * curl[p] * inverse) * (1 + curl[p] * curl[p] * inverse)))
#define ONE_OPEN(p, before, after, above, below)                                                     \
    const float here = KEPT(p), over = KEPT(above), beside = KEPT(before);                           \
    const float x = LESSER(here, over), y = LESSER(here, beside);                                    \
    right[p] *= x;                                                                                   \
    down[p] *= y;                                                                                    \
    pull_x[p] *= x;                                                                                  \
    pull_y[p] *= y;
    const float inverse = 1 / (level * level);
    PIECE(ONE_OPEN)
}

__kernel void bilateral_residual(SIZE, MAP pull_x, MAP pull_y, HELD_MAPS OUT residual)
{
#define ONE_RESIDUAL(p, before, after, above, below) \
    residual[p] = pull_x[p] - pull_x[before] + (pull_y[p] - pull_y[above]) HOLDS(p);
    PIECE(ONE_RESIDUAL)
}

__kernel void bilateral_step(SIZE, MAP heights, MAP step, const float part, OUT stepped)
{
    const int begin = get_global_id(0) * TILE, end = LESSER(begin + TILE, rows * columns);
    for (int p = begin; p < end; ++p) stepped[p] = heights[p] + part * step[p];
}
