// Slopes from normals that are seen along z, and their weights. Specification: facing.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// MASK     1 if there is a mask

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

__kernel void facing_slopes(
    const int pixels, MAP normals, const float edge_on, const float unit, OUT dz_dx, OUT dz_dy, OUT weight)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int p = low; p < end; ++p) {
        const float x = normals[3 * p], y = normals[3 * p + 1], z = normals[3 * p + 2];
        const float cosine_square = z * z / (x * x + y * y + z * z);
        const int visible = (z > 0) & (cosine_square > edge_on);
        const float factor = visible ? -1.0f / z : NAN;
        dz_dx[p] = x * factor;
        dz_dy[p] = y * factor;
        weight[p] = unit * (visible ? cosine_square : 1.0f);
    }
}

#define AROUND 2  // pixels on each side over which variances are averaged
#define CHUNK (TILE < 256 ? TILE : 256)

// A piece of a row per item: sums over the rows of the window are kept, and added up along the row.
__kernel void facing_weigh(
    const int rows, const int columns,
#if MASK
    __global const uchar *restrict mask,
#endif
    MAP dz_dx, MAP dz_dy, const float variance, const float unit, OUT unbiased_x, OUT unbiased_y, OUT weight_x, OUT weight_y)
{
    const int pieces = (columns + CHUNK - 1) / CHUNK, item = get_global_id(0), row = item / pieces;
    if (row >= rows) return;
    const int begin = item % pieces * CHUNK, width = LESSER(columns - begin, CHUNK);
    const int low = LESSER(begin, AROUND), right = begin + width, stop = width + low + LESSER(columns - right, AROUND);
    float count[CHUNK + 2 * AROUND], slant[CHUNK + 2 * AROUND];
    float across[CHUNK + 2 * AROUND], along[CHUNK + 2 * AROUND];
    for (int i = 0; i < CHUNK + 2 * AROUND; ++i) count[i] = slant[i] = across[i] = along[i] = 0.0f;
    for (int line = GREATER(row - AROUND, 0); line <= LESSER(row + AROUND, rows - 1); ++line) {
        const int first = line * columns + begin - low, shift = AROUND - low;
        for (int i = 0; i < stop; ++i) {
            const float p = dz_dx[first + i], q = dz_dy[first + i];
#if MASK
            const int defined = (p == p) & (q == q) & (mask[first + i] != 0);
#else
            const int defined = (p == p) & (q == q);
#endif
            const float steep = 1.0f + p * p + q * q;
            count[shift + i] += defined ? 1.0f : 0.0f;
            slant[shift + i] += defined ? steep : 0.0f;
            across[shift + i] += defined ? (1.0f + p * p) * steep : 0.0f;
            along[shift + i] += defined ? (1.0f + q * q) * steep : 0.0f;
        }
    }
    for (int i = 0; i < width; ++i) {
        const int at = row * columns + begin + i;
        float n = 0.0f, s = 0.0f, x = 0.0f, y = 0.0f;
        for (int k = 0; k <= 2 * AROUND; ++k) {
            n += count[i + k];
            s += slant[i + k];
            x += across[i + k];
            y += along[i + k];
        }
        const float each = n > 0.0f ? 1.0f / n : 1.0f;
        const float shorter = 1.0f / (1.0f + variance * (n > 0.0f ? s * each : 1.0f));
        unbiased_x[at] = dz_dx[at] * shorter;
        unbiased_y[at] = dz_dy[at] * shorter;
        weight_x[at] = unit / (n > 0.0f ? x * each : 1.0f);
        weight_y[at] = unit / (n > 0.0f ? y * each : 1.0f);
    }
}

__kernel void facing_clip(const int pixels, const float lowest, const float highest, OUT weight)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int p = low; p < end; ++p)
        weight[p] = weight[p] > 0 ? GREATER(lowest, LESSER(weight[p], highest)) : 0.0f;
}
