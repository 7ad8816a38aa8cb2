// Slopes and their weights from normals. Specification: slopes.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// WIDTH    pixels in a vector: 8 on a CPU, 1 on a GPU
//
// Vectors, sigma and contact are those of a picture with rows of `stride` pixels; all other maps, those of a part of
// it that starts at pixel `start`. If the part is narrower than the picture, its width is a multiple of WIDTH. Whole
// vectors of maps may be read and written.

#include "common.clh"

#define LANES WIDTH
#include "lanes.clh"

#define STEEPEST 0.17364818f  // cosine of the zenith at which slopes are limited
// radians^2: variance of the azimuth up to which the shortening by its mean cosine is corrected
#define WIDEST 0.25f
#define AROUND 2  // pixels on each side that determine the meridian's direction
#define LEAST 1.1754944e-38f

#if WIDTH == 8
typedef float8 __attribute__((aligned(4))) Loose;  // unaligned
typedef uchar8 __attribute__((aligned(1))) Bytes;
#define READ(map, p) (*(__global const Loose *)((map) + (p)))
#define WRITE(map, p, values) (*(__global Loose *)((map) + (p)) = (values))
#define GET(line, i) (*(const Loose *)((line) + (i)))
#define PUT(line, i, values) (*(Loose *)((line) + (i)) = (values))
#define FLAGS(map, p) convert_int8(*(__global const Bytes *)((map) + (p)))
#define READ_VECTORS                                                                                   \
    const F a = READ(vectors, 3 * q), b = READ(vectors, 3 * q + 8), c = READ(vectors, 3 * q + 16);      \
    F x = (F)(a.s0, a.s3, a.s6, b.s1, b.s4, b.s7, c.s2, c.s5);                                         \
    F y = (F)(a.s1, a.s4, a.s7, b.s2, b.s5, c.s0, c.s3, c.s6);                                         \
    F z = (F)(a.s2, a.s5, b.s0, b.s3, b.s6, c.s1, c.s4, c.s7);
#else
#define READ(map, p) ((map)[p])
#define WRITE(map, p, values) ((map)[p] = (values))
#define GET(line, i) ((line)[i])
#define PUT(line, i, values) ((line)[i] = (values))
#define FLAGS(map, p) ((int)(map)[p])
#define READ_VECTORS F x = vectors[3 * q], y = vectors[3 * q + 1], z = vectors[3 * q + 2];
#endif

// Exponential function from 0 to 1/2, accurate to 1e-7.
#define EXPONENTIAL(x)                                                                                 \
    (1.0f + (x) * (1.0f + (x) * (0.5f + (x) * (0.16666667f + (x) * (0.041666668f + (x) * (0.0083333338f \
     + (x) * (0.0013888889f + (x) * 0.0001984127f)))))))

// The variance of the azimuth, radians^2, within bounds, and the share of the angular variance along the
// meridian.
#define UNSURE(flat, variance)                                                                         \
    const F outside = GREATER(flat, (F)flat_limit), fraction = 0.5f * flat_limit / outside;            \
    const F wide = (1.0f - fraction) * (variance) / outside, turned = LESSER(wide, (F)WIDEST);

// Slopes, and the squares of the normal's components along x and y. Without a normal slopes are NaN, and the
// squares 0.
__kernel void slopes_find(
    const int pixels, const int columns, const int start, const int stride, const float flat_limit, MAP vectors,
    MAP sigma, __global const uchar *restrict contact, OUT dz_dx, OUT dz_dy, OUT squares_x, OUT squares_y)
{
    const int first = (int)get_global_id(0) * TILE;
    int row = first / columns;
    for (int p = first; p < LESSER(first + TILE, pixels); p += WIDTH) {
        row += p >= (row + 1) * columns;
        const int q = start + p + row * (stride - columns);
        const I touches = FLAGS(contact, q) != 0;
        if (!any_of(touches)) {
            WRITE(dz_dx, p, (F)NAN);
            WRITE(dz_dy, p, (F)NAN);
            WRITE(squares_x, p, (F)0.0f);
            WRITE(squares_y, p, (F)0.0f);
            continue;
        }
        READ_VECTORS
        const F s = READ(sigma, q);
        const I valid = touches & (z > 0.0f) & (s > 0.0f) & (s < INFINITY);
        x = valid ? x : (F)0.0f;
        y = valid ? y : (F)0.0f;
        const F flat = x * x + y * y, slant = 1.0f / GREATER(z, (F)STEEPEST);
        UNSURE(flat, s * s)
        const F half_of = 0.5f * turned, longer = EXPONENTIAL(half_of);
        WRITE(dz_dx, p, valid ? -longer * x * slant : (F)NAN);
        WRITE(dz_dy, p, valid ? -longer * y * slant : (F)NAN);
        WRITE(squares_x, p, x * x);
        WRITE(squares_y, p, y * y);
    }
}

#if TILE < 256
#define CHUNK TILE
#define ROWS 1
#else
#define CHUNK 256
#define ROWS 16
#endif

// One of five rows around another: its start, minus the columns on the left, and 0 if there is none.
#define ROW(k, by)                                                                                     \
    const int is_there_##k = row + by >= 0 && row + by < rows;                                         \
    const int at_##k = (is_there_##k ? row + by : row) * columns + begin - AROUND;                     \
    const float there_##k = is_there_##k ? 1.0f : 0.0f;

#define FIVE(line) ((GET(line, i) + GET(line, i + 1)) + (GET(line, i + 2) + GET(line, i + 3)) + GET(line, i + 4))
#define DOWN_FIVE(map)                                                                                 \
    ((there_0 * READ(map, at_0 + i) + there_1 * READ(map, at_1 + i))                                   \
     + (there_3 * READ(map, at_3 + i) + there_4 * READ(map, at_4 + i)) + READ(map, at_2 + i))

// Inverse variances of slopes along x and y, within bounds; 0 without a normal.
__kernel void slopes_weigh(
    const int rows, const int columns, const int start, const int stride, const float flat_limit, const float lowest,
    const float highest, MAP sigma, MAP dz_dx, MAP squares_x, MAP squares_y, OUT weight_x, OUT weight_y)
{
    const int across_all = (columns + CHUNK - 1) / CHUNK, item = get_global_id(0);
    const int top = item / across_all * ROWS, bottom = LESSER(rows, top + ROWS);
    if (top >= rows) return;
    const int begin = item % across_all * CHUNK, end = LESSER(columns, begin + CHUNK);
    const int width = end - begin;  // of lines that include the available pixels on the left
    const int from = AROUND - LESSER(begin, AROUND), to = width + AROUND + LESSER(columns - end, AROUND);
    float x[CHUNK + 2 * AROUND + WIDTH], y[CHUNK + 2 * AROUND + WIDTH];
    for (int i = 0; i < from; ++i) x[i] = y[i] = 0.0f;
    for (int row = top; row < bottom; ++row) {
        const int line = row * columns + begin, in_picture = start + row * stride + begin;
        I some = 0;
        for (int i = 0; i < width; i += WIDTH) {
            const F slope = READ(dz_dx, line + i);
            some |= slope == slope;
        }
        if (!any_of(some)) {
            for (int i = 0; i < width; ++i) weight_x[line + i] = weight_y[line + i] = 0.0f;
            continue;
        }
        ROW(0, -2) ROW(1, -1) ROW(2, 0) ROW(3, 1) ROW(4, 2)
        for (int i = from; i < to; i += WIDTH) {
            PUT(x, i, DOWN_FIVE(squares_x));
            PUT(y, i, DOWN_FIVE(squares_y));
        }
        for (int i = to; i < width + 2 * AROUND + WIDTH; ++i) x[i] = y[i] = 0.0f;
        for (int i = 0; i < width; i += WIDTH) {
            const int p = line + i;
            const F slope = READ(dz_dx, p);
            const I valid = slope == slope;
            F in_x = 0.0f, in_y = 0.0f;
            if (any_of(valid)) {
                const F sum_x = FIVE(x), sum_y = FIVE(y), s = READ(sigma, in_picture + i);
                const F variance = valid ? s * s : (F)1.0f, flat = READ(squares_x, p) + READ(squares_y, p);
                const F upright = 1.0f - flat, steep = 1.0f / GREATER(upright, (F)(STEEPEST * STEEPEST));
                UNSURE(flat, variance)
                const F here = fraction * variance * steep * steep + 0.5f * flat * steep * turned * turned;
                const F orthogonal = (1.0f - fraction) * variance * steep, twice = 2.0f * turned;
                const F east_of = (sum_x + LEAST) / (sum_x + sum_y + 2.0f * LEAST) - 0.5f;
                const F share_x = 0.5f + east_of * EXPONENTIAL(twice);
                const F high = LESSER(share_x, (F)1.0f), east = GREATER(high, (F)0.0f), north = 1.0f - east;
                const F one = GREATER(1.0f / (east * here + north * orthogonal), (F)lowest);
                const F two = GREATER(1.0f / (north * here + east * orthogonal), (F)lowest);
                in_x = valid ? LESSER(one, (F)highest) : (F)0.0f;
                in_y = valid ? LESSER(two, (F)highest) : (F)0.0f;
            }
            if (i + WIDTH <= width) {
                WRITE(weight_x, p, in_x);
                WRITE(weight_y, p, in_y);
            } else {  // the next pixels belong to another item
                PUT(x, 0, in_x);
                PUT(y, 0, in_y);
                for (int lane = 0; lane < width - i; ++lane) {
                    weight_x[p + lane] = x[lane];
                    weight_y[p + lane] = y[lane];
                }
                for (int lane = 0; lane < from; ++lane) x[lane] = y[lane] = 0.0f;
            }
        }
    }
}
