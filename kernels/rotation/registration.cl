// Registration of frames: each pixel's sample is interpolated at the position to which its point has moved.
// Specification: registration.py.
//
// FRAME   type of a sample
// TOP     largest count of an integer type; undefined for floats
// LEVELS  1 if each pixel has its own counts for the same light, 0 if all are equal
// CURVED  1 if shifts also contain the squares of column and row, and their product; otherwise undefined
// TILE    pixels of one work-item, all in one row: 1 on a GPU, many on a CPU
//
// A missing sample is a NaN, and so is the border around a padded frame: every result of one is then a NaN
// without a test.

#include "common.clh"

#define BORDER 2

#define CHUNK (TILE < 64 ? TILE : 64)  // pixels whose positions are computed together

#ifdef TOP
#define USABLE(counts) ((counts) > 0 & (counts) < TOP)
#else
#define USABLE(counts) ((counts) - (counts) == 0)  // neither infinite nor NaN
#endif

// Weights of the samples at -1, 0, 1 and 2, for a position from 0 to 1.
#define BEFORE(part) (((-1.0f / 6 * (part) + 0.5f) * (part) - 1.0f / 3) * (part))
#define HERE(part) (((0.5f * (part) - 1) * (part) - 0.5f) * (part) + 1)
#define NEXT(part) (((-0.5f * (part) + 0.5f) * (part) + 1) * (part))
#define BEYOND(part) ((1.0f / 6 * (part) * (part) - 1.0f / 6) * (part))

#define LINE(at, a, b, c, d) ((a) * (at)[0] + (b) * (at)[1] + (c) * (at)[2] + (d) * (at)[3])

// Values outside low ... high are clipped; NaN becomes low, because no comparison with it is true.
#define HOLD(value, low, high) { \
    value = value > (low) ? value : (low); \
    value = value < (high) ? value : (high); \
}

__kernel void registration_admit(
    const int rows, const int columns, __global const FRAME *restrict frame, MAP offset, MAP gain, OUT padded)
{
    const int pieces = (columns + TILE - 1) / TILE, row = get_global_id(0) / pieces;
    if (row >= rows) return;
    const int first = (get_global_id(0) - row * pieces) * TILE, end = min(first + TILE, columns);
    const int to = (row + BORDER) * (columns + 2 * BORDER) + BORDER, from = row * columns;
    for (int column = first; column < end; ++column) {
        const FRAME counts = frame[from + column];
#if LEVELS
        const float value = ((float)counts - offset[from + column]) / gain[from + column];
#else
        const float value = counts;
#endif
        padded[to + column] = USABLE(counts) ? value : NAN;
    }
}

// Each of `places` has five numbers: a location in the padded frame, and the locations of the four samples to
// be averaged.
__kernel void registration_mend(const int count, __global const int *restrict places, OUT padded)
{
    const int first = get_global_id(0) * TILE, end = min(first + TILE, count);
    for (int i = first; i < end; ++i) {
        __global const int *place = places + 5 * i;
        const float horizontal = padded[place[1]] + padded[place[2]], above = padded[place[3]] + padded[place[4]];
        padded[place[0]] = 0.25f * (horizontal + above);
    }
}

__kernel void registration_resample(
    const int rows, const int columns, MAP padded, MAP height, MAP shift, MAP offset, MAP gain, OUT registered,
    OUT noise)
{
    const int pieces = (columns + TILE - 1) / TILE, row = get_global_id(0) / pieces;
    if (row >= rows) return;
    const int first = (get_global_id(0) - row * pieces) * TILE, end = min(first + TILE, columns);
    const int pixels = rows * columns, stride = columns + 2 * BORDER;
#if CURVED
    const float right = shift[0] + (shift[2] + shift[6] * row) * row, right_column = shift[1] + shift[5] * row;
    const float down = shift[7] + (shift[9] + shift[13] * row) * row, down_column = shift[8] + shift[12] * row;
    const float right_curve = shift[4], right_height = shift[3], down_curve = shift[11], down_height = shift[10];
#else
    const float right = shift[0] + shift[2] * row, right_column = shift[1], right_height = shift[3];
    const float down = shift[4] + shift[6] * row, down_column = shift[5], down_height = shift[7];
#endif

    for (int base = first; base < end; base += CHUNK) {
        const int width = min(CHUNK, end - base), start = row * columns + base;
        int corner[CHUNK];  // first of the 16 samples
        float x_1[CHUNK], x0[CHUNK], x1[CHUNK], x2[CHUNK], y_1[CHUNK], y0[CHUNK], y1[CHUNK], y2[CHUNK], value[CHUNK];

        for (int i = 0; i < width; ++i) {
            const int column = base + i;
#if CURVED
            float x = right + (right_column + right_curve * column) * column + right_height * height[start + i];
            float y = down + (down_column + down_curve * column) * column + down_height * height[start + i];
#else
            float x = right + right_column * column + right_height * height[start + i];
            float y = down + down_column * column + down_height * height[start + i];
#endif
            HOLD(x, -1 - column, columns - 1 - column)
            HOLD(y, -1 - row, rows - 1 - row)
            int west = (int)x, north = (int)y;
            west -= x < west;
            north -= y < north;
            x -= west;
            y -= north;
            x_1[i] = BEFORE(x);
            x0[i] = HERE(x);
            x1[i] = NEXT(x);
            x2[i] = BEYOND(x);
            y_1[i] = BEFORE(y);
            y0[i] = HERE(y);
            y1[i] = NEXT(y);
            y2[i] = BEYOND(y);
            corner[i] = (row + north - 1 + BORDER) * stride + column + west - 1 + BORDER;
        }

        for (int i = 0; i < width; ++i) {
            const float a = x_1[i], b = x0[i], c = x1[i], d = x2[i];
            __global const float *at = padded + corner[i], *at0 = at + stride, *at1 = at0 + stride, *at2 = at1 + stride;
            value[i] = y_1[i] * LINE(at, a, b, c, d) + y0[i] * LINE(at0, a, b, c, d) + y1[i] * LINE(at1, a, b, c, d)
                + y2[i] * LINE(at2, a, b, c, d);
        }

        for (int i = 0; i < width; ++i) {
            const int p = start + i;
            const float counts = LEVELS ? offset[p] + gain[p] * value[i] : value[i];
            const int defined = counts == counts;
            const float square_x = x_1[i] * x_1[i] + x0[i] * x0[i] + x1[i] * x1[i] + x2[i] * x2[i];
            const float square_y = y_1[i] * y_1[i] + y0[i] * y0[i] + y1[i] * y1[i] + y2[i] * y2[i];
            registered[p] = counts;
            noise[p] += defined ? square_x * square_y : 0;
            noise[pixels + p] += defined;
        }
    }
}
