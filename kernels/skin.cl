// Where friction drags the skin. Specification: skin.py.
//
// TILE   pixels of one work-item; 1 where an item is a lane, many where it is a core's loop
// TWIST  1 for a twist, 0 for a movement along the skin

#pragma OPENCL FP_CONTRACT OFF

#include "common.clh"

#define ROUNDS 200
#define CLOSE 1e-4f

// Of a map, bilinear.
#define BETWEEN(at) ((1 - down) * ((1 - right) * (at)[upper + west] + right * (at)[upper + east]) \
    + down * ((1 - right) * (at)[lower + west] + right * (at)[lower + east]))

__kernel void skin_displacement(
    const int rows, const int columns, const int grid_rows, const int grid_columns, const float along_x,
    const float along_y, const float place_x, const float place_y, MAP shift, __global float *restrict displacement)
{
    const int pixels = rows * columns, first = get_global_id(0) * TILE, end = min(first + TILE, pixels);
    const int nodes = grid_rows * grid_columns;
    const float close = CLOSE * LESSER(along_x, along_y);
#if TWIST
    const float cosine = cos(place_x), sine = sin(place_x);
#endif
    for (int p = first; p < end; ++p) {
        const int row = p / columns, column = p - row * columns;
        const float rest_x = (column - 0.5f * (columns - 1)) * along_x, rest_y = (0.5f * (rows - 1) - row) * along_y;
        float x = displacement[p], y = displacement[pixels + p];
        int found = x - x == 0 && y - y == 0;
        x = found ? x : 0;
        y = found ? y : 0;
        found = 0;
        for (int round = 0; round < ROUNDS && !found; ++round) {
            // Pixels from the one of the grid that is nearest to this one: small numbers, with small rounding errors.
#if TWIST
            const float seen_x = rest_x + x, seen_y = rest_y + y;
            const float at_x = seen_x * cosine - seen_y * sine, at_y = seen_x * sine + seen_y * cosine;
            const float across = at_x / along_x + 0.5f * (grid_columns - 1) - column;
            const float along = 0.5f * (grid_rows - 1) - at_y / along_y - row;
#else
            const float across = (x + place_x) / along_x + 0.5f * (grid_columns - columns);
            const float along = 0.5f * (grid_rows - rows) - (y + place_y) / along_y;
#endif
            const float whole_x = floor(across), whole_y = floor(along);
            int west = column + (int)whole_x, north = row + (int)whole_y;
            float right = across - whole_x, down = along - whole_y;
            right = west < 0 ? 0 : west < grid_columns - 1 ? right : 1;
            down = north < 0 ? 0 : north < grid_rows - 1 ? down : 1;
            west = max(min(west, grid_columns - 2), 0);
            north = max(min(north, grid_rows - 2), 0);
            const int east = min(west + 1, grid_columns - 1), upper = north * grid_columns;
            const int lower = min(north + 1, grid_rows - 1) * grid_columns;
            const float shift_x = BETWEEN(shift), shift_y = BETWEEN(shift + nodes);
#if TWIST
            // From the point seen to where it was: seen ((1 - away) exp(-i turn) - 1), away + i turn = shift / at.
            const float square = at_x * at_x + at_y * at_y;
            const float away = square > 0 ? (shift_x * at_x + shift_y * at_y) / square : 0;
            const float turn = square > 0 ? (shift_y * at_x - shift_x * at_y) / square : 0;
            const float half_sine = sin(0.5f * turn);
            const float real = -2 * (1 - away) * half_sine * half_sine - away, imaginary = -(1 - away) * sin(turn);
            const float next_x = square > 0 ? imaginary * seen_y - real * seen_x : shift_x;
            const float next_y = square > 0 ? -imaginary * seen_x - real * seen_y : shift_y;
#else
            const float next_x = shift_x, next_y = shift_y;
#endif
            const float step_x = next_x - x, step_y = next_y - y;
            found = step_x * step_x + step_y * step_y <= close * close;
            x = next_x;
            y = next_y;
        }
        displacement[p] = found ? x : NAN;
        displacement[pixels + p] = found ? y : NAN;
    }
}
