// Displacement of the skin by friction. Specification: skin.py.
//
// TILE   pixels of one work-item: 1 on a GPU, many on a CPU
// TWIST  1 for a twist, 0 for a movement along the skin

#pragma OPENCL FP_CONTRACT OFF

#include "common.clh"

#define ROUNDS 200
#define CLOSE 1e-4f
#define FLAKES 512

#define FLOOR(x) ((int)(x) - ((x) < (int)(x)))

// Bilinear interpolation of a map.
#define BETWEEN(at) ((1 - down) * ((1 - right) * (at)[upper + west] + right * (at)[upper + east]) \
    + down * ((1 - right) * (at)[lower + west] + right * (at)[lower + east]))

// The displacement, mm, of the skin that is now at (x, y) from a pixel. For a twist, the position is cosine
// and sine of the angle. Positions are relative to the nearest grid pixel, in pixels: small numbers with
// small rounding errors.
float2 dragged(const float x, const float y, const int row, const int column, const int rows, const int columns,
    const int grid_rows, const int grid_columns, const float along_x, const float along_y, const float2 place,
    MAP shift)
{
#if TWIST
    const float seen_x = (column - 0.5f * (columns - 1)) * along_x + x;
    const float seen_y = (0.5f * (rows - 1) - row) * along_y + y;
    const float at_x = seen_x * place.x - seen_y * place.y, at_y = seen_x * place.y + seen_y * place.x;
    const float across = at_x / along_x + 0.5f * (grid_columns - 1) - column;
    const float along = 0.5f * (grid_rows - 1) - at_y / along_y - row;
#else
    const float per_x = 1 / along_x, per_y = 1 / along_y;
    const float across = (x + place.x) * per_x + 0.5f * (grid_columns - columns);
    const float along = 0.5f * (grid_rows - rows) - (y + place.y) * per_y;
#endif
    const int whole_x = FLOOR(across), whole_y = FLOOR(along);
    int west = column + whole_x, north = row + whole_y;
    float right = across - whole_x, down = along - whole_y;
    right = west < 0 ? 0 : west < grid_columns - 1 ? right : 1;
    down = north < 0 ? 0 : north < grid_rows - 1 ? down : 1;
    west = max(min(west, grid_columns - 2), 0);
    north = max(min(north, grid_rows - 2), 0);
    const int east = min(west + 1, grid_columns - 1), upper = north * grid_columns;
    const int lower = min(north + 1, grid_rows - 1) * grid_columns;
    const float shift_x = BETWEEN(shift), shift_y = BETWEEN(shift + grid_rows * grid_columns);
#if TWIST
    // From its original position to the point seen: seen (1 - (1 - away) exp(-i turn)), away + i turn = shift
    // / at.
    const float square = at_x * at_x + at_y * at_y;
    if (square > 0) {
        const float away = (shift_x * at_x + shift_y * at_y) / square;
        const float turn = (shift_y * at_x - shift_x * at_y) / square;
        const float half_sine = sin(0.5f * turn);
        const float real = 2 * (1 - away) * half_sine * half_sine + away, imaginary = (1 - away) * sin(turn);
        return (float2)(real * seen_x - imaginary * seen_y, imaginary * seen_x + real * seen_y);
    }
#endif
    return (float2)(shift_x, shift_y);
}

#if TWIST
#define PLACE (float2)(cos(place_x), sin(place_x))
#else
#define PLACE (float2)(place_x, place_y)
#endif

__kernel void skin_displacement(
    const int rows, const int columns, const int grid_rows, const int grid_columns, const float along_x,
    const float along_y, const float place_x, const float place_y, MAP shift, __global float *restrict displacement)
{
    const int pixels = rows * columns, first = get_global_id(0) * TILE, end = min(first + TILE, pixels);
    const float close = CLOSE * LESSER(along_x, along_y);
    const float2 place = PLACE;
    for (int p = first; p < end; ++p) {
        const int row = p / columns, column = p - row * columns;
        float x = displacement[p], y = displacement[pixels + p];
        int converged = x - x == 0 && y - y == 0;
        x = converged ? x : 0;
        y = converged ? y : 0;
        converged = 0;
        for (int round = 0; round < ROUNDS && !converged; ++round) {
            const float2 next = dragged(
                x, y, row, column, rows, columns, grid_rows, grid_columns, along_x, along_y, place, shift);
            const float step_x = next.x - x, step_y = next.y - y;
            converged = step_x * step_x + step_y * step_y <= close * close;
            x = next.x;
            y = next.y;
        }
        displacement[p] = converged ? x : NAN;
        displacement[pixels + p] = converged ? y : NAN;
    }
}

#define WRAPPED(cell) ((cell) & (FLAKES - 1))

// Weights of the coefficients of a cubic B-spline at -1, 0, 1 and 2, for a position from 0 to 1.
#define CUBIC(w, part) { \
    const float rest = 1 - (part); \
    w[0] = rest * rest * rest * (1.0f / 6); \
    w[1] = 2.0f / 3 - 0.5f * (part) * (part) * (2 - (part)); \
    w[2] = 2.0f / 3 - 0.5f * rest * rest * (2 - rest); \
    w[3] = (part) * (part) * (part) * (1.0f / 6); \
}

__kernel void skin_flakes(
    const int rows, const int columns, const int grid_rows, const int grid_columns, const float along_x,
    const float along_y, const float place_x, const float place_y, const float spacing, MAP shift, MAP visible,
    __global const uchar *restrict flakes, __global const int *restrict cell_x, __global const int *restrict cell_y,
    MAP part_x, MAP part_y, OUT fraction)
{
    const int pixels = rows * columns, first = get_global_id(0) * TILE, end = min(first + TILE, pixels);
    const float2 place = PLACE;
    for (int p = first; p < end; ++p) {
        const int row = p / columns, column = p - row * columns;
        const float x = visible[p], y = visible[pixels + p];
        const float2 drag = dragged(
            x, y, row, column, rows, columns, grid_rows, grid_columns, along_x, along_y, place, shift);
        const float across = part_x[column] + (x - drag.x) / spacing, along = part_y[row] + (y - drag.y) / spacing;
        const int whole_x = FLOOR(across), whole_y = FLOOR(along);
        const int west = cell_x[column] + whole_x - 1, south = cell_y[row] + whole_y - 1;
        float w_x[4], w_y[4], sum = 0;
        CUBIC(w_x, across - whole_x)
        CUBIC(w_y, along - whole_y)
        for (int i = 0; i < 4; ++i) {
            __global const uchar *restrict line = flakes + WRAPPED(west + i) * FLAKES;
            float inner = 0;
            for (int j = 0; j < 4; ++j) inner += w_y[j] * line[WRAPPED(south + j)];
            sum += w_x[i] * inner;
        }
        fraction[p] = sum;
    }
}
