// Slopes from normals that are seen along z, and their weights. Specification: facing.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU

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

__kernel void facing_clip(const int pixels, const float lowest, const float highest, OUT weight)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int p = low; p < end; ++p)
        weight[p] = weight[p] > 0 ? GREATER(lowest, LESSER(weight[p], highest)) : 0.0f;
}
