// Errors of directions because of the blur of a lens. Specification: blur.py.
//
// PARTS    components of a vector: 3 in one map, or 2 in a map each
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define STRIP (TILE < 256 ? TILE : 256)  // pixels of a row that are processed together

#if PARTS == 3
#define PART_X(q) first[3 * (q)]
#define PART_Y(q) first[3 * (q) + 1]
#define PART_Z(q) first[3 * (q) + 2]
#else
#define PART_X(q) first[q]
#define PART_Y(q) second[q]
#define PART_Z(q) 0
#endif

// The unit direction of a pixel.
#define DIRECTION(name, q)                                                                                   \
    float name##_x = PART_X(q), name##_y = PART_Y(q), name##_z = PART_Z(q);                                  \
    const float name##_scale = 1 / sqrt(name##_x * name##_x + name##_y * name##_y + name##_z * name##_z);    \
    name##_x *= name##_scale;                                                                                \
    name##_y *= name##_scale;                                                                                \
    name##_z *= name##_scale;

__kernel void blur_bend(
    const int rows, const int columns, MAP first, MAP second, const int reach, OUT bend)
{
    const int pixels = rows * columns, low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    const float scale = 1.0f / (reach * reach);
    for (int p = low; p < end; ++p) {
        const int row = p / columns, column = p % columns;
        const int left = p - LESSER(reach, column), right = p + LESSER(reach, columns - 1 - column);
        const int up = p - columns * LESSER(reach, row), down = p + columns * LESSER(reach, rows - 1 - row);
        DIRECTION(here, p)
        DIRECTION(west, left)
        DIRECTION(east, right)
        DIRECTION(north, up)
        DIRECTION(south, down)
        const float x = (west_x + east_x + north_x + south_x - 4 * here_x) * scale;
        const float y = (west_y + east_y + north_y + south_y - 4 * here_y) * scale;
        const float z = (west_z + east_z + north_z + south_z - 4 * here_z) * scale;
        const float along = x * here_x + y * here_y + z * here_z, across = x * x + y * y + z * z - along * along;
        bend[p] = across != across ? NAN : GREATER(across, 0);
    }
}

__kernel void blur_add(
    const int rows, const int columns, MAP first, MAP bend, const int reach, const float factor,
    const float noise, const float base, const float rise, OUT sigma)
{
    const int pixels = rows * columns, low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    int width;
    for (int at = low; at < end; at += width) {
        const int row = at / columns, column = at % columns;
        width = min(min(STRIP, end - at), columns - column);
        float total[STRIP], count[STRIP];
        for (int i = 0; i < width; ++i) total[i] = count[i] = 0;
        for (int y = max(row - reach, 0); y <= min(row + reach, rows - 1); ++y)
            for (int x = -reach; x <= reach; ++x) {
                MAP other = bend + (size_t)y * columns + column + x;
                const int last = min(width, columns - column - x);
                for (int i = max(0, -column - x); i < last; ++i) {
                    const int usable = other[i] < INFINITY;
                    total[i] += usable ? other[i] : 0;
                    count[i] += usable ? 1 : 0;
                }
            }
        for (int i = 0; i < width; ++i) {
            const float mean = count[i] > 0 ? total[i] / count[i] : 0, before = sigma[at + i];
            const float clear = GREATER(mean - noise * before * before, 0);
            const float upright = PART_Z(at + i), more = base + rise * GREATER(1 - upright * upright, 0);
            const float bent = factor * factor * (clear == clear ? clear : 0);
            sigma[at + i] = sqrt(before * before + bent + more);
        }
    }
}
